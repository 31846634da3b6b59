"""The node of run_all that follows the missions, for the console and the summary."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import rclpy
from rclpy.context import Context

from uav_dc_ros import messages, payloads
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import MessageError
from uav_dc_ros.mission_summary import Summary
from uav_dc_ros.nodes.framework import other_publishers
from uav_dc_ros.nodes.framework.mission_node import MissionNode
from uav_dc_ros.nodes.framework.step_synchronizer import StepSynchronizer
from uav_dc_ros.recordings.recorded_step import MissionTotals

# A mission begins after this time without another one (participants announce themselves every 0.2 s), ...
ALONE_S = 0.5  # ... from the activation of the monitor on, and ...
STARTED_S = 0.1  # ... from the start of all nodes of this run_all on: a busy machine delays both.
CHECK_S = 0.1  # period of checks for other publishers before the mission begins
CHECK_BEGUN_S = 1.0  # and afterwards
IDENTIFY_S = 3.0  # longest wait for both the nodes and the run of another mission


@dataclass(kw_only=True)
class MonitoredMission(MissionTotals):
    """A mission in progress."""

    index: int  # in its run
    cell: tuple[int, int, int] | None = None  # of the last step
    rates: messages.Rates | None = None  # of the last step
    distance_m: float = 0.0  # from cell to cell, metres
    sum_of_sum_rates_bps: float = 0.0  # over the measured steps, bit/s
    unmeasured_steps: int = 0  # flown without rates

    def add_without_rates(self, status: messages.Mission) -> None:
        """Add a status whose rates, or those of steps before it, were not received."""
        self.unmeasured_steps += max(status.step - self.steps, 0)
        self.add(status.step, status, None)

    def summary(self, scenario: Scenario, policy: str, bag: str | None) -> Summary:
        """The result of a mission that is over."""
        return Summary(
            scenario=scenario.name,
            policy=policy,
            seed=self.seed or 0,
            outcome=messages.Phase(self.outcome),
            steps=self.steps,
            steps_not_reached=self.steps_not_reached,
            users_collected=self.collected or 0,
            users_total=scenario.n_users,
            data_bits=self.data_bits or 0.0,
            sum_rate_bps=self.sum_of_sum_rates_bps / max(self.steps - self.unmeasured_steps, 1),
            distance_m=self.distance_m,
            reward=self.reward or 0.0,
            reward_data=scenario.reward.data,
            reason=self.reason,
            bag=bag,
            **self.service_figures(scenario),
            **({} if scenario.energy is None else self._battery()),
        )

    def _battery(self) -> dict[str, Any]:
        return {"energy_used_j": self.energy_used_j or 0.0, "energy_per_mbit_j": self.energy_per_mbit_j}


class MissionMonitor(MissionNode):
    """Follows `mission` and `rates`."""

    pause_s = 0.01  # no node waits for the monitor

    def __init__(
        self,
        scenario: Scenario,
        seed: int | None,  # of the first mission; None: any
        run: str,  # its identity; empty: that of the vehicle, which is started elsewhere
        peers: list[str],  # nodes of the mission
        local_nodes: list[str],  # those that this run_all starts; they publish only after `is_alone`
        on_status: Callable[[messages.Mission], None],
        on_step: Callable[[MonitoredMission], None],
        on_end: Callable[[MonitoredMission], None],
        on_note: Callable[[str], None],
        context: Context | None = None,
    ) -> None:
        overrides = [rclpy.Parameter("peers", value=peers), rclpy.Parameter("run", value=run)]
        super().__init__("mission_monitor", overrides, context)
        self.scenario, self.seed = scenario, seed
        self.mission: MonitoredMission | None = None
        self.restarts_of: dict[str, int] = {}  # number by node name
        self.is_alone = False  # whether the mission may begin: no other one was found for long enough
        self._on_status, self._on_step, self._on_end = on_status, on_step, on_end
        self._local_nodes, self._on_note = local_nodes, on_note

    def activate(self) -> None:
        """Start following."""
        self.is_alone = False
        self._has_begun = False  # a mission of this run
        self._other_run: str | None = None  # of a message from before that
        self._activated_s = self._check_s = time.monotonic()
        self._started_s = math.inf  # when all nodes of this run_all had started
        self._found_s: float | None = None  # when another mission was found
        self._noted: set[str] = set()  # nodes outside this mission
        self._steps = StepSynchronizer(messages.Mission, messages.Rates)
        self._position_m: list[float] = []
        self._unreported: dict[int, messages.Mission] = {}  # final states of missions
        self._ended_s = 0.0  # time of the last one
        self._last_reported = -1  # mission

    def check_publishers(self, have_started: bool) -> None:
        """Check periodically for other publishers. After the mission has begun they are noted and ignored.

        Before, another mission raises AnotherMissionError. `have_started`: whether the nodes of this run_all
        have started, since discovery takes as long on a busy machine.
        """
        now_s = time.monotonic()
        if now_s < self._check_s:
            return
        begun = self.is_alone and self._has_begun
        self._check_s = now_s + (CHECK_BEGUN_S if begun else CHECK_S)
        # The graph shows killed nodes for a while.
        restarted = self.rows if begun else [name for name, n in self.restarts_of.items() if n]
        absent = () if self.is_alone and self._other_run is None else self._local_nodes
        publishers = other_publishers.publishers(self)
        found = other_publishers.find(publishers, self.get_namespace(), self.rows, restarted, absent)
        if not begun and (found or self._other_run is not None):
            self._found_s = self._found_s or now_s
            if (found and self._other_run is not None) or now_s - self._found_s >= IDENTIFY_S:
                raise other_publishers.AnotherMissionError(found.description(self._other_run or ""))
            return
        if found.foreign.keys() - self._noted:
            self._noted |= found.foreign.keys()
            self._on_note(f"{found.description()}; its payloads are ignored, its poses may be recorded")
        if have_started:
            self._started_s = min(self._started_s, now_s)
        self.is_alone |= now_s - self._activated_s >= ALONE_S and now_s - self._started_s >= STARTED_S

    def _find_peers(self) -> None:
        if self.is_alone:  # before, another mission's nodes of these names may be found
            super()._find_peers()

    def _publish_diagnostics(self) -> None:
        if self.is_alone:
            super()._publish_diagnostics()

    def check_run(self, topic: str, run: str) -> None:
        """Note another run before this mission has begun; raises MessageError for it."""
        try:
            super().check_run(topic, run)
        except MessageError:
            if not self._has_begun:
                self._other_run = run
            raise

    def on_mission(self, payload: messages.Mission) -> None:
        """Follow the vehicle."""
        payloads.check(payload, self.scenario)
        seed = payload.seed if self.seed is None else self.seed + payload.mission
        if payload.seed != seed:
            raise MessageError("seed", f"mission {payload.mission} has seed {payload.seed}; expected {seed}")
        self._has_begun = True
        self._on_status(payload)
        is_reported = payload.mission <= self._last_reported or payload.mission in self._unreported
        if payload.phase.is_over and not is_reported:
            self._unreported[payload.mission] = payload
            self._ended_s = time.monotonic()
        self._add(payload)
        now = self.mission
        if now is not None and (now.index, now.steps) == (payload.mission, payload.step):
            self.report_ends(before=now.index + 1)  # the rates of its last step came first

    def on_rates(self, payload: messages.Rates) -> None:
        """Follow the data collection."""
        payloads.check(payload, self.scenario)
        self._add(payload)

    def _add(self, payload: messages.Mission | messages.Rates) -> None:
        """Update the mission, once both payloads of a step are complete."""
        pair = self._steps.add(payload)
        if pair is None:
            return
        status, rates = pair
        now = self.mission
        is_repeated = now is not None and (status.mission, status.step) <= (now.index, now.steps)
        if is_repeated or status.mission <= self._last_reported:
            return
        position_m = self.scenario.grid.centre_m(np.asarray(status.cell), like=np.zeros(1)).tolist()
        if now is None or status.mission > now.index:
            self.report_ends(before=status.mission)
            now = MonitoredMission(index=status.mission, unmeasured_steps=status.step)
        else:
            now.sum_of_sum_rates_bps += rates.sum_rate_bps
            now.distance_m += math.dist(position_m, self._position_m)
            now.unmeasured_steps += status.step - now.steps - 1
        self.mission, self._position_m = now, position_m
        now.cell, now.rates = status.cell, rates
        now.add(status.step, status, rates)
        if status.step:
            now.add_reward(payloads.total_reward(status, rates, self.scenario), self.scenario.reward.data)
        self._on_step(now)
        if now.is_over:
            self._report_end(now)

    def report_ends(self, waited_s: float = 0.0, before: int | None = None) -> None:
        """Report missions `before` this one that are over since `waited_s`, even without their last rates."""
        if not self._unreported or time.monotonic() - self._ended_s < waited_s:
            return
        for index in sorted(self._unreported):
            if before is not None and index >= before:
                return
            if self.mission is None or self.mission.index < index:
                self.mission = MonitoredMission(index=index)
            status, last = self._unreported[index], self.mission.rates
            if last is None or last.step < status.step:
                at = "unknown" if last is None else f"those of step {last.step}"
                missed = f"mission {index}: rates of step {status.step} were not received"
                self._on_note(f"{missed}; its users and data are {at}")
            self.mission.add_without_rates(status)
            self._report_end(self.mission)

    def _report_end(self, mission: MonitoredMission) -> None:
        self._last_reported = mission.index
        self._unreported.pop(mission.index, None)
        self._on_end(mission)

    def diagnose(self) -> tuple[list[str], dict[str, str]]:
        """Numbers of restarts."""
        return [], {f"restarts of {name}": str(n) for name, n in self.restarts_of.items()}
