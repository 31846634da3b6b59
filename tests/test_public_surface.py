"""What users may rely on: these names, each typed, documented, and imported only when it is asked for."""

import ast
import importlib
import inspect
from pathlib import Path

import numpy as np
import pytest

import uav_dc_ros
from tests.test_import import loaded
from uav_dc_ros import RunConfig
from uav_dc_ros.errors import ParameterError

NAMES = {
    *("Action", "DataCollectionEnv", "DataCollectionVectorEnv", "Evaluation", "Missions", "Policy"),
    *("RecordedStep", "RunConfig", "Scenario", "Summary", "UavDcError", "evaluate_policy", "fly"),
    *("load_policy", "load_scenario", "policy_names", "read_steps", "rollout", "scenario_names"),
}


def test_these_are_all() -> None:
    assert set(uav_dc_ros.__all__) == set(uav_dc_ros._PUBLIC) == NAMES
    assert set(dir(uav_dc_ros)) >= NAMES
    with pytest.raises(AttributeError, match="has no attribute 'no_such'"):
        uav_dc_ros.no_such  # noqa: B018


def test_type_checkers_see_the_same() -> None:
    tree = ast.parse(Path(uav_dc_ros.__file__).read_text("utf-8"))
    (block,) = (
        node for node in tree.body if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)
    )
    told = {
        alias.asname: f"{node.module}:{alias.name}"
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert told == uav_dc_ros._PUBLIC


@pytest.mark.parametrize("name", sorted(NAMES))
def test_each_is_documented_and_typed(name: str) -> None:
    module, _, attribute = uav_dc_ros._PUBLIC[name].partition(":")
    found = getattr(uav_dc_ros, name)
    assert found is getattr(importlib.import_module(module), attribute)
    assert inspect.getdoc(found)
    if inspect.isfunction(found):
        signature = inspect.signature(found)
        assert signature.return_annotation is not signature.empty
        assert all(one.annotation is not one.empty for one in signature.parameters.values())


def test_a_config_brings_nothing_heavy() -> None:
    heavy = ("torch", "rclpy", "gymnasium", "matplotlib", "numpy", "msgspec")
    assert loaded("import uav_dc_ros; uav_dc_ros.RunConfig(), uav_dc_ros.fly", *heavy) == []


def test_a_policy_acts_rolls_out_and_is_evaluated() -> None:
    scenario = uav_dc_ros.load_scenario("three_clusters_hover")
    policy = uav_dc_ros.load_policy("three_clusters_hover_dueling")
    env = uav_dc_ros.DataCollectionEnv(scenario, policy.config.observation)
    observation, _ = env.reset(seed=3)
    assert uav_dc_ros.Action(int(policy.act(observation))) in uav_dc_ros.Action
    missions = uav_dc_ros.rollout(policy, scenario, range(3))
    assert missions.landed.all()
    evaluation = uav_dc_ros.evaluate_policy(policy, scenario, range(3))
    assert evaluation.users_collected.mean == pytest.approx(np.mean(missions.users_collected))
    hovering = uav_dc_ros.rollout(lambda state: np.full(state.step.shape, 6), scenario, range(2))
    assert not hovering.landed.any()


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"seed": -1}, "seed: -1; expected a whole number from 0"),
        ({"seed": True}, "seed: True; expected a whole number"),
        ({"missions": 0}, "missions: 0; expected a whole number from 1"),
        ({"pace": "fast"}, "pace: 'fast'; expected 'lockstep' or a number above 0"),
        ({"pace": 0}, "'0'; expected 'lockstep' or a number above 0"),
        ({"vehicle": "kite"}, "vehicle: 'kite'; expected one of simulated, mavlink, mavros, px4"),
        ({"system": 256}, "system: 256; expected a whole number from 1 to 255"),
        ({"live": 70000}, "live: 70000; expected a whole number from 0 to 65535"),
        ({"scenario": None}, "scenario: None; expected text or a path"),
        ({"namespace": "a//b"}, "namespace: 'a//b'; expected a ROS namespace"),
        ({"nodes": ("world", "world")}, r"nodes: \('world', 'world'\); expected names of nodes, each once"),
        ({"settings": {"then": "land"}}, "settings: 'then'; expected NODE.PARAMETER"),
        ({"record": False, "bag": "b"}, "bag: 'b', with record = False; expected one or the other"),
        ({"compose": "yes"}, "compose: 'yes'; expected True or False"),
    ],
)
def test_a_value_that_no_run_can_have(values: dict[str, object], told: str) -> None:
    with pytest.raises(ParameterError, match=told):
        RunConfig(**values)  # type: ignore[arg-type]
