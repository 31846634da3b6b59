"""The path of the UAV in the current mission, whatever the order in which topics arrive."""

import math

from uav_dc_ros.cdr import Pose
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.recordings.thinning import SpacedSeries

MIN_DISTANCE_CELLS = 0.05  # a pose that is nearer than this to the last one, and sooner than ...
MIN_PERIOD_NS = 2 * 10**9  # ... this after it, is left out: a real vehicle publishes twenty a second
POSES_MAX = 1000  # every path message holds all poses


class PathHistory:
    """Poses of the current mission, in bounded memory: a path that grows too long is thinned out.

    A pose carries a time only. `users`, on another topic, assigns a mission and a step to a time: some poses
    of a mission arrive before its first users, and some poses of the last mission after them.

    Poses are not latched. Targets are, so they replace the poses that a late subscriber missed; in simulation
    both are equal.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self._min_distance_m = MIN_DISTANCE_CELLS * scenario.grid.cell_m
        self.version = 0  # changes with the path
        self._path: SpacedSeries[tuple[int, Pose]] = SpacedSeries(POSES_MAX)  # with the time of publication
        self._last: tuple[int, Pose] | None = None  # also if the path leaves it out
        self._targets: list[Pose] = []
        self._start_ns, self._end_ns = -1, math.inf  # of the mission; the end is known in simulation only
        self._current: tuple[int, int] = (-1, 0)  # last mission and step in `users`
        self._before_ns = -1  # time of publication of the last `users` before the mission
        self._users_ns = -1  # time of publication of the last `users`

    def add_pose(self, pose: Pose, published_ns: int) -> None:
        """Add a pose, unless it is of an earlier mission, repeats the last one or is too near to it."""
        if not self._is_current((published_ns, pose)):
            return
        self._last = published_ns, pose
        if not self._path.kept or self._is_apart(pose, self._path.kept[-1][1]):
            self._path.add(self._last)
            self.version += 1

    def _is_apart(self, pose: Pose, last: Pose) -> bool:
        passed_ns = pose.stamp_ns - last.stamp_ns
        if passed_ns == 0:
            return False
        if not 0 < passed_ns < MIN_PERIOD_NS * self._path.factor:
            return True
        return math.dist(pose.position_m, last.position_m) >= self._min_distance_m * self._path.factor

    def add_target(self, target: Pose) -> None:
        """Add a target from before the first pose."""
        if target.stamp_ns >= self._start_ns and self._is_before_poses(target):
            self._targets.append(target)
            self.version += 1

    def _is_before_poses(self, target: Pose) -> bool:
        return not self._path.kept or target.stamp_ns < self._path.kept[0][1].stamp_ns

    def add_users(self, *, mission: int, step: int, stamp_ns: int, published_ns: int) -> int | None:
        """Assign mission and step to a time; returns when the last `users` before a new mission were sent."""
        before_ns, self._users_ns = self._users_ns, published_ns
        last, self._current = self._current, (mission, step)
        if mission == last[0] and step >= last[1]:
            return None
        self._start_ns, self._before_ns = stamp_ns - step * self._scenario.step_ns, before_ns
        is_simulated = stamp_ns == self._scenario.time_ns(mission, step)
        self._end_ns = self._scenario.time_ns(mission + 1, 0) if is_simulated else math.inf
        self.version += 1
        before, self._path = self._path.kept, SpacedSeries(POSES_MAX)
        self._path.kept += (each for each in before if self._is_current(each))
        if self._last is not None and not self._is_current(self._last):
            self._last = None
        self._targets = [target for target in self._targets if target.stamp_ns >= self._start_ns]
        return before_ns

    def _is_current(self, received: tuple[int, Pose]) -> bool:
        """Whether a pose is not of an earlier mission; it may be of the next one."""
        published_ns, pose = received
        return published_ns > self._before_ns and pose.stamp_ns >= self._start_ns

    @property
    def newest(self) -> Pose | None:
        """The last known pose."""
        if self._last is not None:
            return self._last[1]
        return self._targets[-1] if self._targets else None

    @property
    def poses(self) -> list[Pose]:
        """The path, in order. The poses of the next mission wait for its users."""
        missed = [target for target in self._targets if self._is_before_poses(target)]
        known = missed + [pose for _, pose in self._path.kept]
        return [pose for pose in known if pose.stamp_ns < self._end_ns]
