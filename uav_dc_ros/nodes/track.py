"""Which poses belong to the mission now, whatever order the topics arrive in."""

from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.nodes.cdr import Pose


class Track:
    """The way of the UAV in the mission now.

    A pose tells its time only. `users` tells which step of which mission a time is, and comes on another
    topic: some poses of a mission arrive before its first users, some poses of the last one after them.

    Who joins late has missed poses, since they are not latched. The targets are, and in simulation they are
    the same: they stand in for the poses before the first that was heard.

    Args:
        scenario: of the mission.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._step_ns = round(scenario.mission.step_s * 1e9)
        self._poses: list[tuple[int, Pose]] = []  # with the time of publication
        self._targets: list[Pose] = []
        self._start_ns = -1  # time of the mission's start
        self._now: tuple[int, int] = (-1, 0)  # mission and step, as `users` told last
        self._told_ns = -1  # when that was published

    def pose(self, pose: Pose, published_ns: int) -> None:
        """Add a pose; a step that is repeated repeats its pose."""
        if not self._poses or self._poses[-1][1].stamp_ns != pose.stamp_ns:
            self._poses.append((published_ns, pose))

    def target(self, target: Pose) -> None:
        """Add a target of before the first pose."""
        if target.stamp_ns >= self._start_ns and not (self._poses and target.stamp_ns >= self._first_ns):
            self._targets.append(target)

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
        self._poses = [
            (at_ns, pose)
            for at_ns, pose in self._poses
            if at_ns > before_ns and pose.stamp_ns >= self._start_ns
        ]
        self._targets = [target for target in self._targets if target.stamp_ns >= self._start_ns]
        return before_ns

    @property
    def poses(self) -> list[Pose]:
        """Its poses so far, in order."""
        if not self._poses:
            return self._targets
        missed = [target for target in self._targets if target.stamp_ns < self._first_ns]
        return missed + [pose for _, pose in self._poses]

    @property
    def _first_ns(self) -> int:
        """Time of the first pose that was heard."""
        return self._poses[0][1].stamp_ns
