"""Public functions that combine several parts; `uav_dc_ros` re-exports them."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from uav_dc_ros.agents.agent import greedy_act
from uav_dc_ros.agents.policy import Policy
from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.core.world import Act
from uav_dc_ros.experiments.evaluate.evaluation import TEST_SEEDS
from uav_dc_ros.experiments.evaluate.rollout import Missions, roll_out
from uav_dc_ros.recordings import step_reader
from uav_dc_ros.recordings.recorded_step import RecordedStep


def rollout(act: Policy | Act, scenario: Scenario, seeds: Sequence[int] = TEST_SEEDS) -> Missions:
    """Fly one mission per seed of the users in parallel, in numpy, without ROS: results `[S]` each.

    `act` is a policy, or a function from the missions' state (`core.world.State`, `[S, ...]`) to their
    actions, integers `[S]`. Raises PolicyError if the policy does not fit the scenario.
    """
    return roll_out(scenario, greedy_act(act, scenario) if isinstance(act, Policy) else act, seeds)


def read_steps(bag: str | Path, namespace: str | None = None) -> Iterator[RecordedStep]:
    """The steps of the missions in a bag (a folder, or one of its files), in order, with bounded memory.

    `namespace` is that of the missions; None: the only one in the bag. Raises BagError if the bag cannot be
    read, or has no such missions, and ScenarioError if its scenario cannot be read.
    """
    with BagReader(Path(bag)) as reader:
        name = step_reader.namespace(reader, namespace)
        yield from step_reader.Steps(reader, name, step_reader.scenario(reader, name).step_ns)
