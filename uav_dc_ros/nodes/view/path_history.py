"""Which poses belong to the mission now, whatever order the topics arrive in."""

import math

from uav_dc_ros.cdr import Pose
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.recordings.thinning import Apart

APART_CELLS = 0.05  # poses that lie nearer together than this, and come sooner than that, ...
APART_NS = 2 * 10**9  # ... are one: a real vehicle tells twenty a second
POSES_MAX = 1000  # of a path: more nobody sees, and each picture holds all of them


class PathHistory:
    """The way of the UAV in the mission now.

    A path of any length is kept in bounded memory: one that grows too long loses every second of its poses,
    and from then on they are to be twice as far apart.

    A pose tells its time only. `users` tells which step of which mission a time is, and comes on another
    topic: some poses of a mission arrive before its first users, some poses of the last one after them.

    Who joins late has missed poses, since they are not latched. The targets are, and in simulation they are
    the same: they stand in for the poses before the first that was heard.

    Args:
        scenario: of the mission.

    Attributes:
        version: another number whenever the poses are others.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._step_ns = scenario.step_ns
        self._apart_m = APART_CELLS * scenario.grid.cell_m
        self.version = 0
        self._way: Apart[tuple[int, Pose]] = Apart(POSES_MAX)  # with the time of publication
        self._last: tuple[int, Pose] | None = None  # the newest one, kept or not
        self._targets: list[Pose] = []
        self._start_ns = -1  # time of the mission's start
        self._now: tuple[int, int] = (-1, 0)  # mission and step, as `users` told last
        self._told_ns = -1  # when that was published

    def pose(self, pose: Pose, published_ns: int) -> None:
        """Add a pose; a step that is repeated repeats its pose."""
        self._last = published_ns, pose
        if self._poses and not self._is_apart(pose, self._poses[-1][1]):
            return
        self._way.add(self._last)
        self.version += 1

    def _is_apart(self, pose: Pose, last: Pose) -> bool:
        passed_ns = pose.stamp_ns - last.stamp_ns
        if passed_ns == 0:
            return False
        if not 0 < passed_ns < APART_NS * self._way.factor:
            return True
        return math.dist(pose.position_m, last.position_m) >= self._apart_m * self._way.factor

    def target(self, target: Pose) -> None:
        """Add a target of before the first pose."""
        if target.stamp_ns >= self._start_ns and not (self._poses and target.stamp_ns >= self._first_ns):
            self._targets.append(target)
            self.version += 1

    def users(self, *, mission: int, step: int, stamp_ns: int, published_ns: int) -> int | None:
        """Note which step of which mission a time is.

        Returns:
            If it is a new mission: after which time of publication it began; else None.
        """
        before_ns, self._told_ns = self._told_ns, published_ns
        last, self._now = self._now, (mission, step)
        if mission == last[0] and step >= last[1]:
            return None
        self._start_ns = stamp_ns - step * self._step_ns
        self.version += 1
        before, self._way = self._way.kept, Apart(POSES_MAX)
        self._way.kept += (heard for heard in before if self._is_of_now(heard, before_ns))
        if self._last is not None and not self._is_of_now(self._last, before_ns):
            self._last = None
        self._targets = [target for target in self._targets if target.stamp_ns >= self._start_ns]
        return before_ns

    def _is_of_now(self, heard: tuple[int, Pose], before_ns: int) -> bool:
        at_ns, pose = heard
        return at_ns > before_ns and pose.stamp_ns >= self._start_ns

    @property
    def newest(self) -> Pose | None:
        """Where the UAV is, as far as is known."""
        if self._last is not None:
            return self._last[1]
        return self._targets[-1] if self._targets else None

    @property
    def poses(self) -> list[Pose]:
        """Its poses so far, in order."""
        if not self._poses:
            return self._targets
        missed = [target for target in self._targets if target.stamp_ns < self._first_ns]
        return missed + [pose for _, pose in self._poses]

    @property
    def _poses(self) -> list[tuple[int, Pose]]:
        return self._way.kept

    @property
    def _first_ns(self) -> int:
        """Time of the first pose that was heard."""
        return self._poses[0][1].stamp_ns
