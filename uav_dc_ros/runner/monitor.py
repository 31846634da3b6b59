"""run_all's own eyes: follows the missions, for the progress display and the summary."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import rclpy
from rclpy.context import Context

from uav_dc_ros import messages, payloads
from uav_dc_ros.core import world as core
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import MessageError
from uav_dc_ros.mission_summary import Summary
from uav_dc_ros.nodes.framework import other_publishers
from uav_dc_ros.nodes.framework.mission_node import MissionNode
from uav_dc_ros.nodes.framework.step_synchronizer import StepSynchronizer

ALONE_S = 1.0  # nobody else was found for so long, before any node of this mission may begin,
STARTED_S = 0.5  # and for so long since all nodes of this run_all have started
LOOK_S = 0.1  # for others, until this mission has begun
LOOK_LATER_S = 1.0  # for others, afterwards
TELL_S = 3.0  # both who publishes and for which run are told, if they are known within this time


@dataclass(kw_only=True)
class MissionProgress:
    """A mission so far. What few ask for is worked out when it is asked for.

    Attributes:
        scenario: the world that is flown.
        mission, seed, step: index of the mission, seed of its users, steps flown.
        cell: where the UAV is.
        rates: what was measured last.
        distance_m: length of the path flown, metres.
        over: has it come to its end?
        reason, steps_not_reached: what the vehicle said of that.
        sum_of_sum_rates_bps: sum-rates of all measured steps, added up, bit/s.
        unheard_steps: that were flown while nobody measured them.
    """

    scenario: Scenario
    mission: int = 0
    seed: int
    step: int = 0
    cell: tuple[int, int, int] | None = None
    rates: messages.Rates | None = None
    distance_m: float = 0.0
    over: bool = False
    reason: str = ""
    steps_not_reached: int = 0
    sum_of_sum_rates_bps: float = 0.0
    unheard_steps: int = 0

    def hear(self, status: messages.Mission) -> None:
        """Take in the vehicle's last word on it."""
        self.reason, self.steps_not_reached = status.reason, status.steps_not_reached

    @property
    def users_collected(self) -> int:
        """Users who have given enough data."""
        return sum(self.rates.collected) if self.rates else 0

    @property
    def data_bits(self) -> float:
        """Data collected from all users, bit."""
        return float(np.sum(self.rates.data_bits)) if self.rates else 0.0

    @property
    def sum_rate_bps(self) -> float:
        """Sum-rate of the last step, bit/s."""
        return self.rates.sum_rate_bps if self.rates else 0.0

    @property
    def dock_distance_m(self) -> float:
        """Distance to the dock, metres."""
        cell = np.asarray(self.cell or self.scenario.start_cell)
        return float(core.dock_distance_m(self.scenario, cell, like=np.zeros(1)))

    @property
    def reward(self) -> float:
        """r^t (eq. 7); 0 before the first step."""
        if self.rates is None or not self.step:
            return 0.0
        data_bits, _ = payloads.collection(self.rates, self.scenario)
        return float(core.total_reward(self.scenario, np.asarray(self.cell), data_bits))


class MissionMonitor(MissionNode):
    """Follows `mission` and `rates`.

    Args:
        scenario: the world that is flown.
        seed: seed of the first mission; none: whatever the vehicle says.
        run: identity of the run that is flown; empty: that of the vehicle, which is started elsewhere.
        peers: nodes of the mission.
        here: those of the nodes that this run_all starts; they publish only once it is alone.
        on_status: called with each word of the vehicle.
        on_step: called after each step.
        on_end: called when a mission has come to its end, with how.
        on_note: called with what the user should know.
        context: of ROS; None: the process's own.

    Attributes:
        is_alone: was nobody found who publishes for another mission, for long enough to begin this one.
        restarts_of: how often each node was started again, for the diagnostics.
    """

    pause_s = 0.01  # nobody waits for it

    def __init__(
        self,
        scenario: Scenario,
        seed: int | None,
        run: str,
        peers: list[str],
        here: list[str],
        on_status: Callable[[messages.Mission], None],
        on_step: Callable[[MissionProgress], None],
        on_end: Callable[[MissionProgress, messages.Phase], None],
        on_note: Callable[[str], None],
        context: Context | None = None,
    ) -> None:
        given = {"peers": peers, "run": run}
        overrides = [rclpy.Parameter(name, value=value) for name, value in given.items()]
        super().__init__("mission_monitor", overrides, context)
        self.scenario = scenario
        self.seed = seed
        self.mission: MissionProgress | None = None
        self.restarts_of: dict[str, int] = {}
        self.is_alone = False
        self._on_status, self._on_step, self._on_end = on_status, on_step, on_end
        self._here, self._on_note = here, on_note

    def activate(self) -> None:
        """Follow from here on."""
        self.is_alone = False
        self._has_begun = False  # a mission of this run
        self._other_run: str | None = None  # of which a message came before that
        self._since_s = self._look_s = time.monotonic()
        self._started_s = math.inf  # when all nodes of this run_all had started
        self._found_s: float | None = None  # when another mission was noticed
        self._noted: set[str] = set()  # nodes that publish for nobody of this mission
        self._steps = StepSynchronizer()
        self._position_m: list[float] = []  # before the first step
        self._ended: dict[int, messages.Mission] = {}  # missions that are over, and how, until it is told
        self._ended_s = 0.0  # when the last one was
        self._told = -1  # the last mission whose end was told

    def look(self, have_started: bool) -> None:
        """Look for others who publish this mission's topics. Once it has begun they are told, and ignored.

        Args:
            have_started: have the nodes of this run_all started? On a machine with much to do, others are
                found as late as those.

        Raises:
            AnotherMissionError: this mission has not begun, and must not.
        """
        now_s = time.monotonic()
        if now_s < self._look_s:
            return
        begun = self.is_alone and self._has_begun
        self._look_s = now_s + (LOOK_LATER_S if begun else LOOK_S)
        # The graph still tells of a node that was killed, for a while.
        again = self.rows if begun else [name for name, n in self.restarts_of.items() if n]
        absent = () if self.is_alone and self._other_run is None else self._here
        found = other_publishers.find(
            other_publishers.publishers(self), self.get_namespace(), self.rows, again, absent
        )
        if not begun and (found or self._other_run is not None):
            self._found_s = self._found_s or now_s
            if (found and self._other_run is not None) or now_s - self._found_s >= TELL_S:
                raise other_publishers.AnotherMissionError(found.description(self._other_run or ""))
            return
        if found.foreign.keys() - self._noted:
            self._noted |= found.foreign.keys()
            self._on_note(f"{found.description()}; its payloads are ignored, its poses may be recorded")
        if have_started:
            self._started_s = min(self._started_s, now_s)
        self.is_alone |= now_s - self._since_s >= ALONE_S and now_s - self._started_s >= STARTED_S

    def _find_peers(self) -> None:
        if self.is_alone:  # otherwise another mission's nodes of these names would do
            super()._find_peers()

    def _publish_diagnostics(self) -> None:
        if self.is_alone:
            super()._publish_diagnostics()

    def check_run(self, topic: str, run: str) -> None:
        """Note another run whose messages come before this mission has begun.

        Raises:
            MessageError: the message belongs to another run.
        """
        try:
            super().check_run(topic, run)
        except MessageError:
            if not self._has_begun:
                self._other_run = run
            raise

    def on_mission(self, payload: messages.Mission) -> None:
        """Follow the vehicle."""
        payloads.check(payload, self.scenario)
        if self.seed is not None and payload.seed != self.seed + payload.mission:
            raise MessageError(
                "seed",
                f"mission {payload.mission} has seed {payload.seed}; expected {self.seed + payload.mission}",
            )
        self._has_begun = True
        self._on_status(payload)
        if payload.phase.is_over and payload.mission > self._told and payload.mission not in self._ended:
            self._ended[payload.mission] = payload
            self._ended_s = time.monotonic()
        self._hear(payload)
        now = self.mission
        if now is not None and (now.mission, now.step) == (payload.mission, payload.step):
            self.close(before=now.mission + 1)  # if this is its end, all of it was heard

    def on_rates(self, payload: messages.Rates) -> None:
        """Follow the collection."""
        payloads.check(payload, self.scenario)
        self._hear(payload)

    def _hear(self, payload: messages.Mission | messages.Rates) -> None:
        pair = self._steps.add(payload)
        if pair is not None:
            self._follow(*pair)

    def _follow(self, mission: messages.Mission, rates: messages.Rates) -> None:
        now = self.mission
        if now is not None and (mission.mission, mission.step) <= (now.mission, now.step):
            return  # a repeated step
        if mission.mission <= self._told:
            return  # it was given up, and told so: its rates came too late
        position_m = self.scenario.grid.centre_m(np.asarray(mission.cell), like=np.zeros(1)).tolist()
        if now is None or mission.mission > now.mission:
            self.close(before=mission.mission)
            now = MissionProgress(scenario=self.scenario, mission=mission.mission, seed=mission.seed)
            now.unheard_steps = mission.step
        else:
            now.sum_of_sum_rates_bps += rates.sum_rate_bps
            now.distance_m += math.dist(position_m, self._position_m)
            now.unheard_steps += mission.step - now.step - 1
        self.mission, self._position_m = now, position_m
        now.step, now.cell, now.rates = mission.step, mission.cell, rates
        now.over = mission.phase.is_over
        self._on_step(now)
        if now.over:
            self._tell_end(now, mission)

    def close(self, waited_s: float = 0.0, before: int | None = None) -> None:
        """End the missions that are over since `waited_s`: their last rates may never come.

        Args:
            waited_s: since the last of them was over.
            before: only those before this one.
        """
        if not self._ended or time.monotonic() - self._ended_s < waited_s:
            return
        for mission in sorted(self._ended):
            if before is not None and mission >= before:
                return
            end = self._ended[mission]
            if self.mission is None or self.mission.mission < mission:  # it was over before its first rates
                self.mission = MissionProgress(scenario=self.scenario, mission=mission, seed=end.seed)
            self.mission.over = True
            self._tell_end(self.mission, end)

    def _tell_end(self, now: MissionProgress, end: messages.Mission) -> None:
        now.hear(end)
        self._told = now.mission
        self._ended.pop(now.mission, None)
        self._on_end(now, end.phase)

    def diagnose(self) -> tuple[list[str], dict[str, str]]:
        """How often nodes were started again."""
        return [], {f"restarts of {name}": str(n) for name, n in self.restarts_of.items()}


def summary(
    now: MissionProgress, outcome: messages.Phase, scenario: Scenario, policy: str, bag: str | None
) -> Summary:
    """The mission in numbers."""
    return Summary(
        scenario=scenario.name,
        policy=policy,
        seed=now.seed,
        outcome=outcome,
        steps=now.step,
        steps_not_reached=now.steps_not_reached,
        users_collected=now.users_collected,
        users_total=scenario.n_users,
        data_bits=now.data_bits,
        sum_rate_bps=now.sum_of_sum_rates_bps / max(now.step - now.unheard_steps, 1),
        distance_m=now.distance_m,
        reward=now.reward,
        reason=now.reason,
        bag=bag,
    )
