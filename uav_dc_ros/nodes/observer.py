"""run_all's own eyes: follows the missions, for the progress display and the summary."""

from collections.abc import Callable
from dataclasses import dataclass

import msgspec
import numpy as np

from uav_dc_ros import messages
from uav_dc_ros.core import world as core
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import NodeError
from uav_dc_ros.nodes import convert, runtime
from uav_dc_ros.nodes.pairs import StepPairs


class Summary(msgspec.Struct, frozen=True, kw_only=True):
    """One mission, as `--summary` writes it.

    Attributes:
        scenario, policy: names.
        seed: seed of the mission's users.
        outcome: `landed`, `timeout` or `aborted`.
        steps: steps flown.
        users_collected, users_total: users.
        data_bits: data collected from all users, bit.
        sum_rate_bps: sum of the served users' rates, mean over the steps, bit/s.
        distance_m: length of the path flown, metres.
        reward: r^t at the end (eq. 7), as `evaluate` and the policies' cards have it.
        bag: folder of the bag, or null.
    """

    scenario: str
    policy: str
    seed: int
    outcome: messages.Phase
    steps: int
    users_collected: int
    users_total: int
    data_bits: float
    sum_rate_bps: float
    distance_m: float
    reward: float
    bag: str | None


@dataclass(kw_only=True)
class MissionSoFar:
    """A mission so far."""

    mission: int = 0
    seed: int
    step: int = 0
    users_collected: int = 0
    data_bits: float = 0.0
    sum_rate_bps: float = 0.0  # of this step
    dock_distance_m: float = 0.0
    distance_m: float = 0.0
    reward: float = 0.0
    over: bool = False
    sum_of_sum_rates_bps: float = 0.0


class Observer(runtime.MissionNode):
    """Follows `mission` and `rates`.

    Args:
        scenario: the world that is flown.
        seed: seed of the first mission.
        peers: nodes of the mission.
        on_step: called after each step.
        on_end: called when a mission has come to its end, with how.
    """

    def __init__(
        self,
        scenario: Scenario,
        seed: int,
        peers: list[str],
        on_step: Callable[[MissionSoFar], None],
        on_end: Callable[[MissionSoFar, messages.Phase], None],
    ) -> None:
        self._given_peers = peers
        super().__init__("observer")
        self.scenario = scenario
        self.seed = seed
        self._position_m: Array = None  # before the first step
        self.mission: MissionSoFar | None = None
        self._on_step, self._on_end = on_step, on_end
        self._steps = StepPairs()
        self.listen()

    def _peers_parameter(self) -> list[str]:
        return [peer for peer in self._given_peers if peer != "observer"]

    def on_mission(self, payload: messages.Mission) -> None:
        """Follow the vehicle.

        Raises:
            NodeError: it flies for somebody else, or a step was not heard.
        """
        convert.check_world(payload, self.scenario)
        if payload.seed != self.seed + payload.mission:
            raise NodeError(runtime.ANOTHER_MISSION)
        self._hear(payload)

    def on_rates(self, payload: messages.Rates) -> None:
        """Follow the collection."""
        convert.collection(payload, self.scenario)
        self._hear(payload)

    def _hear(self, payload: messages.Mission | messages.Rates) -> None:
        pair = self._steps.add(payload)
        if pair is not None:
            self._follow(*pair)

    def _follow(self, mission: messages.Mission, rates: messages.Rates) -> None:
        now = self.mission
        data_bits, collected = convert.collection(rates, self.scenario)
        cell = np.asarray(mission.cell)
        position_m = self.scenario.grid.centre_m(cell, like=data_bits)
        if now is not None and (mission.mission, mission.step) <= (now.mission, now.step):
            return  # a repeated step
        if now is None or now.over:
            expected = (0 if now is None else now.mission + 1, 0)
            now = MissionSoFar(mission=mission.mission, seed=mission.seed)
        else:
            expected = (now.mission, now.step + 1)
            now.sum_of_sum_rates_bps += rates.sum_rate_bps
            now.distance_m += float(np.linalg.norm(position_m - self._position_m))
        if (mission.mission, mission.step) != expected:
            raise NodeError(
                f"heard of step {mission.step} of mission {mission.mission}; expected step {expected[1]} of "
                f"mission {expected[0]}: the nodes cannot keep up; fly at a slower pace, or in lockstep"
            )
        self.mission, self._position_m = now, position_m
        now.reward = float(core.total_reward(self.scenario, cell, data_bits)) if mission.step else 0.0
        now.over = mission.phase.is_over
        now.step = mission.step
        now.users_collected = int(collected.sum())
        now.data_bits = float(data_bits.sum())
        now.sum_rate_bps = rates.sum_rate_bps
        now.dock_distance_m = float(core.dock_distance_m(self.scenario, cell, like=data_bits))
        self._on_step(now)
        if mission.phase.is_over:
            self._on_end(now, mission.phase)


def summary(
    now: MissionSoFar, outcome: messages.Phase, scenario: Scenario, policy: str, bag: str | None
) -> Summary:
    """The mission in numbers."""
    return Summary(
        scenario=scenario.name,
        policy=policy,
        seed=now.seed,
        outcome=outcome,
        steps=now.step,
        users_collected=now.users_collected,
        users_total=scenario.n_users,
        data_bits=now.data_bits,
        sum_rate_bps=now.sum_of_sum_rates_bps / max(now.step, 1),
        distance_m=now.distance_m,
        reward=now.reward,
        bag=bag,
    )
