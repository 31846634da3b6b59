"""A UAV collects data from IoT users on the ground, steered by a dueling DQN, on ROS 2.

`__all__` is the public API. Each name is imported on first access: flying needs no torch, and learning no
ROS.
"""

import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from uav_dc_ros.agents.policy import Policy as Policy
    from uav_dc_ros.agents.policy import load as load_policy
    from uav_dc_ros.agents.policy import names as policy_names
    from uav_dc_ros.api import read_steps as read_steps
    from uav_dc_ros.api import rollout as rollout
    from uav_dc_ros.core.grid import Action as Action
    from uav_dc_ros.core.scenario import Scenario as Scenario
    from uav_dc_ros.env.gym_env import DataCollectionEnv as DataCollectionEnv
    from uav_dc_ros.env.vector_env import DataCollectionVectorEnv as DataCollectionVectorEnv
    from uav_dc_ros.errors import UavDcError as UavDcError
    from uav_dc_ros.experiments.evaluate.evaluation import Evaluation as Evaluation
    from uav_dc_ros.experiments.evaluate.evaluation import evaluate as evaluate_policy
    from uav_dc_ros.experiments.evaluate.rollout import Missions as Missions
    from uav_dc_ros.mission_summary import Summary as Summary
    from uav_dc_ros.recordings.recorded_step import RecordedStep as RecordedStep
    from uav_dc_ros.run_all import fly as fly
    from uav_dc_ros.run_config import RunConfig as RunConfig
    from uav_dc_ros.scenarios import load as load_scenario
    from uav_dc_ros.scenarios import names as scenario_names

__version__ = "0.2.0"

# Where each public name is defined; a test compares it with the imports for type checkers above.
_PUBLIC = {
    "Action": "uav_dc_ros.core.grid:Action",
    "DataCollectionEnv": "uav_dc_ros.env.gym_env:DataCollectionEnv",
    "DataCollectionVectorEnv": "uav_dc_ros.env.vector_env:DataCollectionVectorEnv",
    "Evaluation": "uav_dc_ros.experiments.evaluate.evaluation:Evaluation",
    "Missions": "uav_dc_ros.experiments.evaluate.rollout:Missions",
    "Policy": "uav_dc_ros.agents.policy:Policy",
    "RecordedStep": "uav_dc_ros.recordings.recorded_step:RecordedStep",
    "RunConfig": "uav_dc_ros.run_config:RunConfig",
    "Scenario": "uav_dc_ros.core.scenario:Scenario",
    "Summary": "uav_dc_ros.mission_summary:Summary",
    "UavDcError": "uav_dc_ros.errors:UavDcError",
    "evaluate_policy": "uav_dc_ros.experiments.evaluate.evaluation:evaluate",
    "fly": "uav_dc_ros.run_all:fly",
    "load_policy": "uav_dc_ros.agents.policy:load",
    "load_scenario": "uav_dc_ros.scenarios:load",
    "policy_names": "uav_dc_ros.agents.policy:names",
    "read_steps": "uav_dc_ros.api:read_steps",
    "rollout": "uav_dc_ros.api:rollout",
    "scenario_names": "uav_dc_ros.scenarios:names",
}
__all__ = list(_PUBLIC)


def __getattr__(name: str) -> Any:
    """Import a public name on first access."""
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, attribute = _PUBLIC[name].partition(":")
    value = getattr(importlib.import_module(module), attribute)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """All names, including the public ones that are not imported yet."""
    return sorted({*globals(), *__all__})


_REGISTRATION = "uav_dc_ros.env.registration"


class _RegisterAfterGymnasium(importlib.abc.MetaPathFinder):
    """Registers the environment when Gymnasium is imported, which has no plug-ins since its 1.0."""

    def find_spec(self, name: str, path: Any, target: Any = None) -> importlib.machinery.ModuleSpec | None:
        """The spec of Gymnasium, extended by the registration."""
        if name != "gymnasium":
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(name)
        if spec is None or spec.loader is None:
            return spec
        execute = spec.loader.exec_module

        def execute_and_register(module: Any) -> None:
            execute(module)
            importlib.import_module(_REGISTRATION)

        spec.loader.exec_module = execute_and_register  # type: ignore[method-assign]
        return spec


if sys.modules.get("gymnasium"):
    importlib.import_module(_REGISTRATION)
else:
    sys.meta_path.insert(0, _RegisterAfterGymnasium())
