"""The channel and rate monitor: SINR and rates of every user, and the data collected from them.

It hears positions only, so it works the same around a simulated and a real vehicle. Its books are what
has been collected; a monitor that was killed finds them in its journal.
"""

from collections import deque

import numpy as np

from uav_dc_ros import cdr, messages, payloads, scenarios
from uav_dc_ros.core import world as core
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.errors import MessageError, NodeError
from uav_dc_ros.nodes.framework import node_main
from uav_dc_ros.nodes.framework.journal import Journal
from uav_dc_ros.nodes.framework.mission_node import MissionNode

USER_BYTES = 60  # of `rates`, for each user
WAITING_MAX = 256  # poses without users, and users without a pose


class ChannelMonitorNode(MissionNode):
    """Answers each `users` with the `rates` of that step."""

    def __init__(self) -> None:
        super().__init__("channel_monitor")

    def configure(self) -> None:
        """Load the world, and the books of a monitor that was killed."""
        self.scenario = scenarios.load(self.values["scenario"])
        self.message_bytes = {"rates": USER_BYTES * self.scenario.n_users}
        self.journal = Journal(self.values["journal"])
        self._said: messages.Rates | None = None
        self._forget()
        self._restore()
        core.measure(  # the first time takes longest
            self.scenario,
            np.asarray(self.scenario.mission.start_m),
            np.asarray(self.scenario.user_centres_m),
            self._collected,
        )

    def activate(self) -> None:
        """Begin with empty hands, and the books as they are."""
        self._poses: deque[tuple[cdr.Pose, int]] = deque(maxlen=WAITING_MAX)  # and when it was published
        self._users: deque[tuple[messages.Users, Array, int]] = deque(maxlen=WAITING_MAX)
        self._heard_ns = 0  # when the users measured last were published

    def deactivate(self) -> None:
        """Fall silent."""
        self.journal.close()

    def _forget(self) -> None:
        """Begin a mission: nothing is collected."""
        self._data_bits = np.zeros(self.scenario.n_users)
        self._collected = np.zeros(self.scenario.n_users, dtype=bool)

    def _restore(self) -> None:
        """Open the books where they were left.

        Raises:
            NodeError: they are the books of something else.
        """
        lines = self.journal.lines()
        if not lines:
            return
        try:
            self._said = messages.decode(lines[-1], messages.Rates)
            self._data_bits, self._collected = payloads.collection(self._said, self.scenario)
        except MessageError as error:
            raise NodeError(
                f"journal {self.values['journal']}: not that of a channel monitor in scenario "
                f"{self.scenario.name!r}: {error}"
            ) from None
        self.get_logger().warning(f"goes on after step {self._said.step} of mission {self._said.mission}")

    def on_pose(self, pose: cdr.Pose) -> None:
        """Keep a pose; users may have waited for it."""
        self._poses.append((pose, self.published_ns))
        self._pair()

    def on_users(self, payload: messages.Users) -> None:
        """Keep users until their pose is there."""
        self._users.append((payload, payloads.users_m(payload, self.scenario), self.published_ns))
        self._pair()

    def _pair(self) -> None:
        """Measure every step whose pose has come: the first one of the step's own time.

        A stamp of another time, true or not, keeps nobody waiting.
        """
        for waiting in tuple(self._users):
            users, users_m, published_ns = waiting
            begun_ns = users.stamp_ns
            poses = [
                heard for heard in self._poses if 0 <= heard[0].stamp_ns - begun_ns < self.scenario.step_ns
            ]
            if not poses:
                continue
            while (passed := self._users.popleft()) is not waiting:
                self.reject("users", self._no_pose(passed[0]))
            for heard in [heard for heard in self._poses if heard[0].stamp_ns < begun_ns]:
                self._poses.remove(heard)  # older than any users to come
            # A pose names no run. Of several with one stamp, our vehicle's was published with the users.
            found, _ = min(poses, key=lambda heard: (heard[0].stamp_ns, abs(heard[1] - published_ns)))
            try:
                self._measure(users, users_m, np.asarray(found.position_m), published_ns)
            except MessageError as error:
                self.reject("users", error)

    def _no_pose(self, users: messages.Users) -> MessageError:
        return MessageError(
            "no_pose",
            f"step {users.step} of mission {users.mission}: no pose of the step's "
            f"{self.scenario.mission.step_s:g} s came before a later step had both",
        )

    def _measure(self, users: messages.Users, users_m: Array, uav_m: Array, published_ns: int) -> None:
        said = self._said if self._said is not None and self._said.run == users.run else None
        now, before = (users.mission, users.step), (said.mission, said.step) if said else (-1, 0)
        if said is not None and now == before:
            self.publish_payload("rates", said)  # a repeated step is measured, and booked, once
            return
        if now < before and published_ns <= self._heard_ns:
            raise MessageError(
                "stale_step",
                f"mission, step {now} after {before}: a middleware that lost its peer for a while, and found "
                "it again, repeats what it had said",
            )
        heard_ns, self._heard_ns = self._heard_ns, published_ns
        if now < before or users.mission != before[0]:
            if users.step > 0:
                raise MessageError(
                    "joined_late",
                    f"step {users.step} of mission {users.mission}, whose start was not heard: what has been "
                    "collected before is not known; expected a mission from its step 0",
                )
            self._forget()
            if said is None or now < before:  # another run: its time begins again, and meets earlier stamps
                of_this_flight = (heard for heard in self._poses if heard[1] > heard_ns)
                self._poses = deque(of_this_flight, maxlen=WAITING_MAX)
        elif users.step != before[1] + 1:
            self.reject(
                "users",
                MessageError(
                    "gap",
                    f"step {users.step} of mission {users.mission} after step {before[1]}; expected "
                    f"{before[1] + 1}: nothing is booked for what was not heard",
                ),
            )
        data_bits, collected = self._data_bits, self._collected
        link = core.measure(self.scenario, uav_m, users_m, collected)
        if users.step > 0:  # step 0 is the moment of the start: no time has passed to collect in
            data_bits, collected = core.collect(self.scenario, link, data_bits, collected)
        rates = payloads.rates(
            link, data_bits, collected, mission=users.mission, step=users.step, run=users.run
        )
        text = messages.encode(rates)  # refuses what is no number, before it comes into the books
        self._said, self._data_bits, self._collected = rates, data_bits, collected
        keep = self.journal.append if users.step else self.journal.begin
        keep(text)  # before it is said: what others know is never forgotten
        self.publish_encoded("rates", text)


if __name__ == "__main__":
    node_main.main(ChannelMonitorNode)
