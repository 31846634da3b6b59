"""Recompute a recorded mission with the functions of the nodes, and compare bit for bit.

A check compares the steps of one namespace in order. A step whose inputs the bag lacks is counted with its
reason. The next step starts from recorded values.
"""

from collections import Counter
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple, TypeAlias

import numpy as np

from uav_dc_ros import payloads
from uav_dc_ros.agents.agent import Agent, state_of
from uav_dc_ros.agents.policy_search import PolicySearch
from uav_dc_ros.core import world
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.mobility import WalkingUsers
from uav_dc_ros.core.objective import DEFAULT_WEIGHT
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import MessageError
from uav_dc_ros.messages import Mission, Phase, Rates, Stepped
from uav_dc_ros.recordings.recorded_step import RecordedStep, differ_in_time_only, with_progress_of

FIELDS = {"users": "users", "rates": "rates", "mission": "status", "move": "move"}
COLUMNS = ("sinr", "rate_bps", "served", "sum_rate_bps", "data_bits", "collected")  # causes before effects
Collection: TypeAlias = tuple[Array, Array]  # data of each user, bit, and whether it is collected, `[U]` each


class Difference(NamedTuple):
    """A recorded value that is not the recomputed one."""

    column: str
    text: str


def difference(
    step: RecordedStep, topic: str, column: str, recorded: Any, recomputed: Any, user: int | None = None
) -> Difference:
    """A difference in a step; `user`: index in a column with an entry per user."""
    flight = f"flight {step.flight}, " if step.flight else ""
    of_user = "" if user is None else f", user {user}"
    where = f"{topic}: {flight}mission {step.mission}, step {step.step}{of_user}, {column}"
    return Difference(column, f"{where}: recorded {recorded!r}, recomputed {recomputed!r}")


@dataclass(kw_only=True)
class Check:
    """One aspect of a bag, compared step by step."""

    title: ClassVar[str]
    tolerance: float = 0.0  # greatest relative difference of two equal numbers
    compared: int = 0  # recomputed steps
    differing: int = 0  # recomputed steps with a difference
    skipped: Counter[str] = field(default_factory=Counter)  # steps that cannot be recomputed, by reason
    first: Difference | None = None
    within: int = 0  # values that are equal only within the tolerance

    def count(self, found: list[Difference]) -> None:
        """Count a recomputed step with its differences."""
        self.compared += 1
        self.differing += bool(found)
        if found and self.first is None:
            self.first = found[0]

    def compare(
        self, step: RecordedStep, topic: str, name: str, recorded: Any, recomputed: Any
    ) -> list[Difference]:
        """Compare a column with an entry per user, or one value; the first difference, if any."""
        ours, theirs = np.atleast_1d(recomputed), np.atleast_1d(recorded)
        if ours.shape != theirs.shape:
            return [difference(step, topic, f"length of {name}", theirs.shape[0], ours.shape[0])]
        floats = ours.dtype == np.float64
        wrong = ours.view(np.uint64) != theirs.view(np.uint64) if floats else ours != theirs
        if floats and self.tolerance and wrong.any():
            near = np.abs(ours - theirs) <= self.tolerance * np.abs(ours)
            self.within += int((wrong & near).sum())
            wrong &= ~near
        if not wrong.any():
            return []
        i = int(wrong.argmax())
        user = i if np.ndim(recorded) > 0 else None
        return [difference(step, topic, name, theirs[i].item(), ours[i].item(), user)]

    def lines(self) -> list[str]:
        """The result as text."""
        total = self.compared + self.skipped.total()
        if not total:
            return [f"{self.title}: the bag holds no step to recompute"]
        summary = f"{self.title}: {self.compared} of {total} steps recomputed"
        if self.first:
            lines = [f"{summary}, {self.differing} differ; first:", f"  {self.first.text}"]
        else:
            lines = [f"{summary}, equal {'within the tolerance' if self.within else 'to the last bit'}"]
        if self.within:
            lines.append(f"  {self.within} values are equal within the tolerance only")
        return lines + [f"  {n} not recomputed: {reason}" for reason, n in self.skipped.most_common()]


class ChannelCheck(Check):
    """Recomputes rates as the channel monitor does.

    Where rates are missing, the monitor may have counted the step or missed it. The next step is compared
    with both. If neither fits, only the columns that do not depend on the collected data are compared. The
    monitor may miss a pose that the recorder receives, so rates may fit a later pose of a step.
    """

    title = "channel"

    def __init__(self, scenario: Scenario, tolerance: float = 0.0) -> None:
        super().__init__(tolerance=tolerance)
        self._later_poses = 0  # steps that fit a later pose than the first
        self._scenario = scenario
        self._last = (-1, -1, -1)  # flight, mission and number of the last step
        self._possible: list[Collection] = []  # after it
        self._certain = False

    def add(self, step: RecordedStep) -> None:
        """Recompute the rates of a step."""
        self._start(step)
        try:
            users_m = None if step.users is None else payloads.users_m(step.users, self._scenario)
        except MessageError:
            users_m = None  # WorldCheck reports the difference
        if step.rates is None:
            self.skipped["no rates recorded"] += 1
            measured = []
            if users_m is not None and step.poses:
                uav_m = step.poses[0].position_m
                measured = [self._measure(step, uav_m, users_m, one)[1] for one in self._possible]
            self._possible = measured[:1] + self._possible[-1:]
            self._certain = False
            return
        possible, certain = self._possible, self._certain
        try:
            self._possible = [payloads.collection(step.rates, self._scenario)]
            self._certain = True
        except MessageError:
            self._possible, self._certain = [], False
        if users_m is None or not step.poses:
            missing = "pose" if users_m is not None else "users of this scenario"
            self.skipped[f"no {missing} recorded"] += 1
        elif not possible:
            self.skipped["its mission is not recorded from the start"] += 1
        else:
            self._compare(step, step.rates, users_m, possible, certain)

    def _start(self, step: RecordedStep) -> None:
        """Start with the data collected before a step, as far as it is known."""
        *mission, number = self._last
        self._last = (step.flight, step.mission, step.step)
        if step.step == 0:
            n_users = self._scenario.n_users
            self._possible, self._certain = [(np.zeros(n_users), np.zeros(n_users, dtype=bool))], True
        elif mission != [step.flight, step.mission]:
            self._possible, self._certain = [], False
        elif number != step.step - 1:
            self._certain = False

    def _measure(
        self, step: RecordedStep, uav_m: Array, users_m: Array, before: Collection
    ) -> tuple[world.Link, Collection]:
        assert step.users is not None, "the caller has its positions"
        drawn = payloads.realization(step.users, self._scenario)
        link = world.measure(self._scenario, uav_m, users_m, before[1], drawn=drawn)
        return link, world.collect(self._scenario, link, *before) if step.step else before

    def _compare(
        self, step: RecordedStep, rates: Rates, users_m: Array, known: list[Collection], certain: bool
    ) -> None:
        first: list[Difference] | None = None
        for i, pose in enumerate(step.poses):
            for before in known:
                link, after = self._measure(step, pose.position_m, users_m, before)
                ours = payloads.rates(link, *after, mission=step.mission, step=step.step)
                within = self.within
                found: list[Difference] = []
                for name in COLUMNS:
                    found += self.compare(step, "rates", name, getattr(rates, name), getattr(ours, name))
                if not found:
                    self._later_poses += i > 0
                    self.count([])
                    return
                self.within = within
                first = found if first is None else first
        assert first is not None, "a pose and a possible collection"
        if not certain:
            independent = self._scenario.radio.interference != "associated"
            first = [one for one in first if independent and one.column in ("sinr", "rate_bps")]
            if not first:
                self.skipped["what was collected before it is not recorded"] += 1
                return
        self.count(first)

    def lines(self) -> list[str]:
        """The result as text."""
        lines = super().lines()
        if self._later_poses:
            lines.append(f"  {self._later_poses} steps fit a later pose than the first one recorded")
        return lines


class WorldCheck(Check):
    """Recomputes the cell of the vehicle, the state of the mission, the users, and poses in simulation.

    `seed` is that of the bag's metadata; without it, no simulated world made the users. The seeds of a
    flight's missions follow from that of its first one. Without `lockstep`, a simulated vehicle hovers if no
    move comes in time.
    """

    title = "world"

    def __init__(
        self, scenario: Scenario, *, seed: str | None, lockstep: bool, real: bool, tolerance: float = 0.0
    ) -> None:
        super().__init__(tolerance=tolerance)
        self._hovered = 0  # steps whose move was not flown
        self._seeds: dict[int, int] = {}  # of mission 0, by flight
        self._scenario, self._seed, self._real = scenario, seed, real
        self._lockstep = lockstep or real
        self._before: RecordedStep | None = None
        self._users: WalkingUsers | None = None
        self._users_seed = -1

    def add(self, step: RecordedStep) -> None:
        """Recompute a step's status, and in simulation its pose and users."""
        found = [
            difference(step, topic, *_first_unequal(getattr(step, FIELDS[topic]), other))
            for topic, other in step.conflicts.items()
            # A real vehicle that is ready for a step again has the same users at another time.
            if not (self._real and step.users and differ_in_time_only(step.users, other))
        ]
        before, self._before = self._before, step
        reason = "no mission recorded"
        if step.status is not None:
            of_status, reason = self._status(step, step.status, before)
            found += of_status
            if self._seed is not None:
                found += self._simulation(step, step.status)
        if found or not reason:
            self.count(found)
        else:
            self.skipped[reason] += 1

    def _status(
        self, step: RecordedStep, status: Mission, before: RecordedStep | None
    ) -> tuple[list[Difference], str]:
        """Differences, and why the cell cannot be recomputed."""
        scenario = self._scenario
        remaining = max(scenario.mission.max_steps - step.step, 0)
        found = self.compare(step, "mission", "fingerprint", status.fingerprint, scenario.fingerprint)
        found += self.compare(step, "mission", "remaining_steps", status.remaining_steps, remaining)
        found += self._battery(step, status, before)
        number, at = np.asarray(step.step), np.asarray(status.cell)
        used_j = payloads.energy_used_j(status)
        terminated, truncated, landed = world.end_of_mission(scenario, number, at, used_j)
        phase = Phase.READY
        if step.step and (terminated or truncated):
            phase = Phase.LANDED if landed else Phase.TIMEOUT
        aborted = (status.phase, phase) == (Phase.ABORTED, Phase.READY)
        if self._real:  # it may also abort during the landing, or the bag ends there
            aborted = status.phase not in (Phase.READY, Phase.LANDED, Phase.TIMEOUT)
        if status.phase is not phase and not aborted:
            found.append(difference(step, "mission", "phase", status.phase.value, phase.value))
        cell = list(status.cell)
        if step.step == 0:
            return found + _cell(step, cell, [list(scenario.start_cell)]), ""
        if before is None or not step.follows(before) or before.status is None:
            return found, "the cell before it is not recorded"
        actions = [Action[before.move.action.upper()]] if before.move else list(Action)
        if before.move and not self._lockstep:
            actions.append(Action.HOVER)
        left = np.asarray(before.status.cell)
        reached = [world.move(scenario, left, np.asarray(int(action))).tolist() for action in actions]
        wrong = _cell(step, cell, reached)
        if not wrong and reached[0] != cell and before.move:
            self._hovered += 1
        hovers = not self._lockstep and list(before.status.cell) == cell  # as without a move in time
        return found + wrong, "" if before.move or hovers else "the move before it is not recorded"

    def _battery(self, step: RecordedStep, status: Mission, before: RecordedStep | None) -> list[Difference]:
        """Differences of the energy used from that of the recorded cells, and of the state of charge."""
        scenario, used_j = self._scenario, payloads.energy_used_j(status)
        if step.step == 0:
            used_j = np.asarray(0.0)
        elif before is not None and step.follows(before) and before.status is not None:
            left, cell = np.asarray(before.status.cell), np.asarray(status.cell)
            if np.abs(cell - left).sum() <= 1:  # otherwise the cell is the difference
                used_j = world.energy_after(scenario, payloads.energy_used_j(before.status), left, cell)
        return [
            one
            for name, recomputed in payloads.battery(scenario, used_j).items()
            for one in self.compare(step, "mission", name, getattr(status, name), recomputed)
        ]

    def _simulation(self, step: RecordedStep, status: Mission) -> list[Difference]:
        """Differences of seed, poses and users from those of the simulated world."""
        scenario = self._scenario
        first = self._seeds.setdefault(step.flight, status.seed - step.mission)
        found = self.compare(step, "mission", "seed", status.seed, first + step.mission)
        time_ns = scenario.time_ns(step.mission, step.step)
        if not self._real:
            centre_m = scenario.grid.centre_m(np.asarray(status.cell), like=np.zeros(3))
            for pose in step.poses:
                found += self.compare(step, "pose", "stamp_ns", pose.stamp_ns, time_ns)
                for i, axis in enumerate(("x_m", "y_m", "z_m")):
                    found += self.compare(step, "pose", axis, float(pose.position_m[i]), float(centre_m[i]))
        if step.users is not None:
            seed = max(first, 0) + step.mission
            if self._users is None or self._users_seed != seed or self._users.step > step.step:
                self._users, self._users_seed = WalkingUsers(scenario, seed), seed
            self._users.walk(step.step - self._users.step)
            at: dict[str, Any] = {"mission": step.mission, "step": step.step, "time_ns": time_ns}
            users = payloads.users(scenario, self._users.positions_m, seeds=self._users.seeds, **at)
            names = ("cluster", "x_m", "y_m", "shadowing_seed", "link_seed")
            for name in names if self._real else ("stamp_ns", *names):
                found += self.compare(step, "users", name, getattr(step.users, name), getattr(users, name))
        return found

    def lines(self) -> list[str]:
        """The result as text."""
        lines = super().lines()
        if self._hovered:
            lines.append(f"  {self._hovered} moves came too late and were not flown: the vehicle hovered")
        if self._seed is None:
            what = "users" if self._real else "poses and users"
            lines.append(f"  the bag names no seed of a simulated world: {what} are not recomputed")
        elif any(str(seed) != self._seed for seed in self._seeds.values()):
            seeds = ", ".join(map(str, self._seeds.values()))
            lines.append(f"  flown with seed {seeds}; the bag's metadata names seed {self._seed}")
        return lines


class DecisionCheck(Check):
    """Recomputes the decisions of a policy or a planner."""

    title = "decisions"

    def __init__(self, scenario: Scenario, agent: Agent, weight: float = DEFAULT_WEIGHT) -> None:
        super().__init__()
        self.agent, self._scenario = agent, scenario
        self._act = agent.act_in(scenario, weight)
        self.timed_out = 0  # recomputed steps whose search ran out of time: the move is the policy's own

    def add(self, step: RecordedStep) -> str | None:
        """Recompute the decision of a step; the label of the action if it differs."""
        status, move = step.status, step.move
        if status is None or status.phase not in (Phase.READY, Phase.LANDING, Phase.ABORTED):
            return None
        if move is None:
            if status.phase is Phase.READY:
                self.skipped["no move recorded"] += 1
            return None
        try:
            observed = step.observed(self._scenario)
            if observed is not None and self.agent.knows_positions:
                users = step.users
                observed["users_m"] = None if users is None else payloads.users_m(users, self._scenario)
        except MessageError:
            self.skipped["rates, users or mission of another world"] += 1
            return None
        if observed is None or observed.get("users_m", observed) is None:
            self.skipped[f"no {'rates' if observed is None else 'users'} recorded"] += 1
            return None
        state = state_of(self._scenario, **observed)
        if move.search_timed_out is True and isinstance(self._act, PolicySearch):
            self.timed_out += 1
            action = Action(self._act.own(state)).label
        else:
            action = Action(int(self._act(state))).label
        found = [difference(step, "move", "action", move.action, action)] if action != move.action else []
        self.count(found)
        return action if found else None

    def lines(self) -> list[str]:
        """The result as text."""
        lines = super().lines()
        if self.timed_out:
            lines.append(f"  {self.timed_out} searches ran out of time: their moves are the policy's own")
        return lines


def _cell(step: RecordedStep, cell: list[int], reached: list[list[int]]) -> list[Difference]:
    return [] if cell in reached else [difference(step, "mission", "cell", cell, reached[0])]


def _first_unequal(one: Stepped, other: Stepped) -> tuple[str, Any, Any]:
    """Name of the first field in which a payload and its repetition differ, and both values."""
    if isinstance(one, Mission) and isinstance(other, Mission):
        other = with_progress_of(other, one)
    for name in one.__struct_fields__:
        a, b = getattr(one, name), getattr(other, name)
        if a != b:
            if isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
                i = next(i for i in range(len(a)) if a[i] != b[i])
                return f"{name}[{i}], repeated", a[i], b[i]
            return f"{name}, repeated", a, b
    raise AssertionError("they differ")
