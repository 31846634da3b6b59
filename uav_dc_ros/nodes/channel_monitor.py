"""The channel and rate monitor: SINR and rate of each user, and the data collected from them.

It subscribes to positions only, so it is the same with a simulated and a real vehicle. The users' positions
come with the seeds of a random channel. A monitor that was killed restores the collected data from its
journal.
"""

from collections import deque

import numpy as np

from uav_dc_ros import cdr, messages, payloads, scenarios
from uav_dc_ros.core import world as core
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.errors import MessageError, NodeError
from uav_dc_ros.nodes.framework import node_main
from uav_dc_ros.nodes.framework.acknowledgements import AcknowledgementWindow
from uav_dc_ros.nodes.framework.journal import Journal
from uav_dc_ros.nodes.framework.mission_node import MissionNode

USER_BYTES = 60  # of `rates`, for each user
WAITING_MAX = 256  # poses without users, and users without a pose


class ChannelMonitorNode(MissionNode):
    """Publishes the `rates` of each step whose `users` and `pose` it has received."""

    def __init__(self) -> None:
        super().__init__("channel_monitor")

    def configure(self) -> None:
        """Load the scenario and the journal."""
        self.scenario = scenarios.load(self.values["scenario"])
        self.message_bytes = {"rates": USER_BYTES * self.scenario.n_users}
        self.journal = Journal(self.values["journal"])
        self._last: messages.Rates | None = None
        self._reset()
        self._restore()
        start_m, users_m = map(np.asarray, (self.scenario.mission.start_m, self.scenario.user_centres_m))
        core.measure(self.scenario, start_m, users_m, self._collected)  # the first call is the slowest

    def activate(self) -> None:
        """Begin with no pose and no users; the collected data stay."""
        self._poses: deque[tuple[cdr.Pose, int]] = deque(maxlen=WAITING_MAX)  # and its publication time
        self._users: deque[tuple[messages.Users, Array, int]] = deque(maxlen=WAITING_MAX)
        self._measured_ns = 0  # publication time of the last users that were measured
        self._unacknowledged = AcknowledgementWindow([self.publishers_of["rates"]])

    def deactivate(self) -> None:
        """Close the journal."""
        self.journal.close()

    def _reset(self) -> None:
        """Begin a mission: nothing is collected."""
        self._data_bits = np.zeros(self.scenario.n_users)
        self._collected = np.zeros(self.scenario.n_users, dtype=bool)

    def _restore(self) -> None:
        """Restore the collected data; raises NodeError for the journal of another node or scenario."""
        lines = self.journal.lines()
        if not lines:
            return
        try:
            self._last = messages.decode(lines[-1], messages.Rates)
            self._data_bits, self._collected = payloads.collection(self._last, self.scenario)
        except MessageError as error:
            raise NodeError(
                f"journal {self.values['journal']}: not that of a channel monitor in scenario "
                f"{self.scenario.name!r}: {error}"
            ) from None
        self.get_logger().warning(f"resumes mission {self._last.mission} after step {self._last.step}")

    def on_pose(self, pose: cdr.Pose) -> None:
        """Keep a pose, and measure the users that wait for it."""
        self._poses.append((pose, self.published_ns))
        self._measure_pairs()

    def on_users(self, payload: messages.Users) -> None:
        """Keep users until a pose of their step has arrived."""
        self._users.append((payload, payloads.users_m(payload, self.scenario), self.published_ns))
        self._measure_pairs()

    def _measure_pairs(self) -> None:
        """Measure each step that has users and a pose: the first pose within the step's time.

        Users whose pose is missing do not block later steps.
        """
        for waiting in tuple(self._users):
            users, users_m, published_ns = waiting
            begun_ns, step_ns = users.stamp_ns, self.scenario.step_ns
            poses = [entry for entry in self._poses if 0 <= entry[0].stamp_ns - begun_ns < step_ns]
            if not poses:
                continue
            while (skipped := self._users.popleft()) is not waiting:
                why = (
                    f"step {skipped[0].step} of mission {skipped[0].mission}: no pose of the step's "
                    f"{self.scenario.mission.step_s:g} s came before a later step had both"
                )
                self.reject("users", MessageError("no_pose", why))
            for entry in [entry for entry in self._poses if entry[0].stamp_ns < begun_ns]:
                self._poses.remove(entry)  # older than any users to come
            # A pose names no run. Of several with one stamp, our vehicle's was published with the users.
            pose, _ = min(poses, key=lambda entry: (entry[0].stamp_ns, abs(entry[1] - published_ns)))
            try:
                self._measure(users, users_m, np.asarray(pose.position_m), published_ns)
            except MessageError as error:
                self.reject("users", error)

    def _measure(self, users: messages.Users, users_m: Array, uav_m: Array, published_ns: int) -> None:
        last = self._last if self._last is not None and self._last.run == users.run else None
        step, last_step = (users.mission, users.step), (last.mission, last.step) if last else (-1, 0)
        if last is not None and step == last_step:
            self.publish_payload("rates", last)  # a repeated step collects no data
            return
        if step < last_step and published_ns <= self._measured_ns:
            raise MessageError(
                "stale_step", f"mission, step {step} after {last_step}: the middleware sent it again"
            )
        measured_ns, self._measured_ns = self._measured_ns, published_ns
        if step < last_step or users.mission != last_step[0]:
            if users.step > 0:
                raise MessageError(
                    "joined_late",
                    f"step {users.step} of mission {users.mission}, whose first steps were not received: the "
                    "data collected in them are not known; expected a mission from its step 0",
                )
            self._reset()
            if last is None or step < last_step:  # of another run: its stamps repeat those of earlier poses
                poses = (entry for entry in self._poses if entry[1] > measured_ns)
                self._poses = deque(poses, maxlen=WAITING_MAX)
        elif users.step != last_step[1] + 1:
            gap = (
                f"step {users.step} of mission {users.mission} after step {last_step[1]}; expected "
                f"{last_step[1] + 1}: no data are collected in the missing steps"
            )
            self.reject("users", MessageError("gap", gap))
        data_bits, collected = self._data_bits, self._collected
        drawn = payloads.realization(users, self.scenario)
        link = core.measure(self.scenario, uav_m, users_m, collected, drawn=drawn)
        if users.step > 0:  # step 0 is the start: no time has passed to collect in
            data_bits, collected = core.collect(self.scenario, link, data_bits, collected)
        rates = payloads.rates(
            link, data_bits, collected, mission=users.mission, step=users.step, run=users.run
        )
        text = messages.encode(rates)  # rejects numbers that are not finite before they are kept
        self._last, self._data_bits, self._collected = rates, data_bits, collected
        write = self.journal.append if users.step else self.journal.begin
        write(text)  # before it is published: published data are never lost
        self._unacknowledged.step()
        self.publish_encoded("rates", text)


if __name__ == "__main__":
    node_main.main(ChannelMonitorNode)
