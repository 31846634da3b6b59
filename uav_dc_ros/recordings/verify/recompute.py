"""Recompute what a recorded mission tells, with the functions that told it, and compare bit for bit.

Three books, each over the steps of one namespace in their order:

Channel    SINR, rates, data and collected flags from recorded users and poses, as the monitor does it
World      cells from recorded moves, the mission's books, users from the seed; in simulation poses, too
Decisions  every move from the recorded observation, by the policy that flew

A step that cannot be recomputed, since the bag lacks what it stands on, is counted with its reason; what
follows goes on from what was recorded. A number may differ by `tolerance`, relatively; 0 is to the last bit.
"""

from typing import Any, TypeAlias

import numpy as np

from uav_dc_ros import messages, payloads
from uav_dc_ros.agents.policy import Policy
from uav_dc_ros.core import world
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.core.users import WalkingUsers
from uav_dc_ros.errors import MessageError
from uav_dc_ros.messages import Phase
from uav_dc_ros.recordings.recorded_step import RecordedStep, is_later_only, with_standing_of
from uav_dc_ros.recordings.verify.differences import Book, Difference, difference

COLUMNS = ("sinr", "rate_bps", "served", "sum_rate_bps", "data_bits", "collected")  # causes before effects
FIELDS = {"users": "users", "rates": "rates", "mission": "status", "move": "move"}
Books: TypeAlias = tuple[Array, Array]  # data of each user, bit, and whether it is collected, `[U]` each


class Channel(Book):
    """The monitor's work done again.

    Where rates are missing, the monitor may have booked the step, or not have heard it. What follows is
    compared with both; where neither fits, only the columns that no books enter are.

    Attributes:
        later_poses: steps that fit a later pose than the first of their time: a pose may get lost on its way
            to the monitor, and not on its way to the recorder.
    """

    def __init__(self, scenario: Scenario, tolerance: float = 0.0) -> None:
        super().__init__(tolerance=tolerance)
        self.later_poses = 0
        self._scenario = scenario
        self._last = (-1, -1, -1)  # flight, mission and number of the last step
        self._possible: list[Books] = []  # after it
        self._certain = False

    def add(self, step: RecordedStep) -> None:
        """Recompute the rates of a step."""
        self._begin(step)
        try:
            users_m = None if step.users is None else payloads.users_m(step.users, self._scenario)
        except MessageError:
            users_m = None  # the world's book tells what is wrong with them
        if step.rates is None:
            self.skip("no rates recorded")
            measured = []
            if users_m is not None and step.poses:
                measured = [self._measure(step, step.poses[0].position_m, users_m, b) for b in self._possible]
            self._possible = [books for _, books in measured[:1]] + self._possible[-1:]
            self._certain = False
            return
        possible, certain = self._possible, self._certain
        try:
            self._possible = [payloads.collection(step.rates, self._scenario)]
            self._certain = True
        except MessageError:
            self._possible, self._certain = [], False
        if users_m is None or not step.poses:
            self.skip("no pose recorded" if users_m is not None else "no users of this scenario recorded")
        elif not possible:
            self.skip("its mission is not recorded from the start")
        else:
            self._compare(step, step.rates, users_m, possible, certain)

    def _begin(self, step: RecordedStep) -> None:
        """Turn the books to a step."""
        flight, mission, number = self._last
        self._last = (step.flight, step.mission, step.step)
        if step.step == 0:
            n_users = self._scenario.n_users
            self._possible, self._certain = [(np.zeros(n_users), np.zeros(n_users, dtype=bool))], True
        elif (flight, mission) != self._last[:2]:
            self._possible, self._certain = [], False
        elif number != step.step - 1:
            self._certain = False

    def _measure(
        self, step: RecordedStep, uav_m: Array, users_m: Array, books: Books
    ) -> tuple[world.Link, Books]:
        link = world.measure(self._scenario, uav_m, users_m, books[1])
        return link, world.collect(self._scenario, link, *books) if step.step else books

    def _compare(
        self, step: RecordedStep, rates: messages.Rates, users_m: Array, possible: list[Books], certain: bool
    ) -> None:
        first: list[Difference] | None = None
        for i, pose in enumerate(step.poses):
            for books in possible:
                link, after = self._measure(step, pose.position_m, users_m, books)
                within = self.within
                found = self._differences(step, rates, link, after)
                if not found:
                    self.later_poses += i > 0
                    self.enter([])
                    return
                self.within = within
                first = found if first is None else first
        assert first is not None, "there is a pose, and a past"
        if not certain:
            bookless = () if self._scenario.radio.interference == "associated" else ("sinr", "rate_bps")
            first = [one for one in first if one.column in bookless]
            if not first:
                self.skip("what was collected before it is not recorded")
                return
        self.enter(first)

    def _differences(
        self, step: RecordedStep, rates: messages.Rates, link: world.Link, after: Books
    ) -> list[Difference]:
        ours = payloads.rates(link, *after, mission=step.mission, step=step.step)
        return [
            one
            for name in COLUMNS
            for one in self.column(step, "rates", name, getattr(rates, name), getattr(ours, name))
        ]


class World(Book):
    """The world's work done again: where the vehicle is, how the mission stands, where the users are.

    Args:
        seeded: did our own world make the users? Then they follow from the seed, and the seeds of a flight's
            missions from that of its first one.
        real: was it a real vehicle? Otherwise poses and times follow from cells and steps.
        lockstep: was every move awaited? Without it, a vehicle that gets no move in time hovers; a real one
            waits.

    Attributes:
        hovered: steps with a move that was not flown.
        seeds: of mission 0, by flight.
    """

    def __init__(
        self,
        scenario: Scenario,
        *,
        seeded: bool,
        lockstep: bool,
        real: bool = False,
        tolerance: float = 0.0,
    ) -> None:
        super().__init__(tolerance=tolerance)
        self.hovered = 0
        self.seeds: dict[int, int] = {}
        self._scenario, self._seeded, self._real = scenario, seeded, real
        self._lockstep = lockstep or real
        self._before: RecordedStep | None = None
        self._crowd: WalkingUsers | None = None
        self._crowd_of = -1  # seed

    def add(self, step: RecordedStep) -> None:
        """Recompute a step's status, and in simulation its pose and users."""
        found = [
            difference(step, topic, *_first_unlike(getattr(step, FIELDS[topic]), other))
            for topic, other in step.others.items()
            # A real vehicle that is ready for a step again has the same users around it, at another time.
            if not (self._real and step.users and is_later_only(step.users, other))
        ]
        before, self._before = self._before, step
        reason = ""
        if step.status is None:
            reason = "no mission recorded"
        else:
            told, reason = self._status(step, step.status, before)
            found += told
            if self._seeded:
                found += self._made(step, step.status)
        if found or not reason:
            self.enter(found)
        else:
            self.skip(reason)

    def _status(
        self, step: RecordedStep, status: messages.Mission, before: RecordedStep | None
    ) -> tuple[list[Difference], str]:
        """Differences, and why the cell could not be recomputed."""
        scenario = self._scenario
        remaining = max(scenario.mission.max_steps - step.step, 0)
        found = self.column(step, "mission", "fingerprint", status.fingerprint, scenario.fingerprint)
        found += self.column(step, "mission", "remaining_steps", status.remaining_steps, remaining)
        cell = np.asarray(status.cell)
        ends = world.ends(scenario, np.asarray(step.step), cell)
        terminated, truncated, landed = (bool(one) for one in ends)
        phase = Phase.READY
        if step.step and (terminated or truncated):
            phase = Phase.LANDED if landed else Phase.TIMEOUT
        stopped = (status.phase, phase) == (Phase.ABORTED, Phase.READY)
        if self._real:  # it may be stopped on its way down, too; or the bag ends on the way
            stopped = status.phase not in (Phase.READY, Phase.LANDED, Phase.TIMEOUT)
        if status.phase is not phase and not stopped:
            found.append(difference(step, "mission", "phase", status.phase.value, phase.value))
        if step.step == 0:
            return found + self._cell(step, status, [scenario.start_cell]), ""
        follows = before is not None and (before.flight, before.mission, before.step + 1) == (
            (step.flight, step.mission, step.step)
        )
        if not follows or before is None or before.status is None:
            return found, "the cell before it is not recorded"
        flown = [Action[before.move.action.upper()]] if before.move else list(Action)
        if before.move and not self._lockstep:
            flown.append(Action.HOVER)
        reached = [
            scenario.grid.move(np.asarray(before.status.cell), np.asarray(int(action))).tolist()
            for action in flown
        ]
        wrong = self._cell(step, status, reached)
        if not wrong and reached[0] != cell.tolist() and before.move:
            self.hovered += 1
        hovers = not self._lockstep and list(before.status.cell) == cell.tolist()  # as without a move in time
        return found + wrong, "" if before.move or hovers else "the move before it is not recorded"

    def _cell(self, step: RecordedStep, status: messages.Mission, reached: Any) -> list[Difference]:
        if list(status.cell) in [list(one) for one in reached]:
            return []
        return [difference(step, "mission", "cell", list(status.cell), list(reached[0]))]

    def _made(self, step: RecordedStep, status: messages.Mission) -> list[Difference]:
        """What our own world makes beyond what any vehicle does."""
        scenario = self._scenario
        first = self.seeds.setdefault(step.flight, status.seed - step.mission)
        found = self.column(step, "mission", "seed", status.seed, first + step.mission)
        time_ns = scenario.time_ns(step.mission, step.step)
        if not self._real:
            found += self._poses(step, status, time_ns)
        if step.users is not None:
            users_m = self._users_m(max(first, 0) + step.mission, step.step)
            users = payloads.users(scenario, users_m, mission=step.mission, step=step.step, time_ns=time_ns)
            for name in (*(() if self._real else ("stamp_ns",)), "cluster", "x_m", "y_m"):
                found += self.column(step, "users", name, getattr(step.users, name), getattr(users, name))
        return found

    def _poses(self, step: RecordedStep, status: messages.Mission, time_ns: int) -> list[Difference]:
        """A simulated vehicle is at the centre of its cell, at the time of its step."""
        found = []
        centre_m = self._scenario.grid.centre_m(np.asarray(status.cell), like=np.zeros(3))
        for pose in step.poses:
            found += self.column(step, "pose", "stamp_ns", pose.stamp_ns, time_ns)
            for i, axis in enumerate(("x_m", "y_m", "z_m")):
                found += self.column(step, "pose", axis, float(pose.position_m[i]), float(centre_m[i]))
        return found

    def _users_m(self, seed: int, step: int) -> Array:
        """Users of the mission with a seed after some steps, metres, `[U, 2]`."""
        if self._crowd is None or self._crowd_of != seed or self._crowd.step > step:
            self._crowd, self._crowd_of = WalkingUsers(self._scenario, seed), seed
        self._crowd.walk(step - self._crowd.step)
        return self._crowd.positions_m


class Decisions(Book):
    """The policy's work done again."""

    def __init__(self, scenario: Scenario, policy: Policy) -> None:
        super().__init__()
        policy.check(scenario)
        self.policy = policy
        self._scenario = scenario

    def add(self, step: RecordedStep) -> Array | None:
        """Decide a step anew; the Q-values `[A]`, where the decision is another one."""
        status, move = step.status, step.move
        if status is None or status.phase not in (Phase.READY, Phase.LANDING, Phase.ABORTED):
            return None
        if move is None:
            if status.phase is Phase.READY:
                self.skip("no move recorded")
            return None
        try:
            if step.rates is None:
                raise MessageError("missing", "no rates recorded")
            data_bits, collected = payloads.collection(step.rates, self._scenario)
            payloads.check(status, self._scenario)
        except MessageError as error:
            self.skip("rates or mission of another world" if error.reason != "missing" else str(error))
            return None
        observation = self.policy.observe(
            self._scenario,
            cell=np.asarray(status.cell),
            step=np.asarray(self._scenario.mission.max_steps - status.remaining_steps),
            data_bits=data_bits,
            collected=collected,
        )
        q_values = self.policy.q_values(observation)
        action = Action(int(self.policy.act(observation))).label
        found = [difference(step, "move", "action", move.action, action)] if action != move.action else []
        self.enter(found)
        return q_values if found else None


def _first_unlike(one: messages.Stepped, other: messages.Stepped) -> tuple[str, Any, Any]:
    """Name of the first field in which two payloads differ, and both values.

    A vehicle may tell a step in many phases: what it says of the step itself is what does not change.
    """
    if isinstance(one, messages.Mission) and isinstance(other, messages.Mission):
        other = with_standing_of(other, one)
    for name in one.__struct_fields__:
        a, b = getattr(one, name), getattr(other, name)
        if a != b:
            if isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
                i = next(i for i in range(len(a)) if a[i] != b[i])
                return f"{name}[{i}], said again", a[i], b[i]
            return f"{name}, said again", a, b
    raise AssertionError("they differ")
