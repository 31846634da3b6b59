"""The visualizer: the mission as RViz and Foxglove draw it, on `path` and `markers`.

It hears every pose, for the path: see `PathHistory`. Of everything else it keeps the newest, as it came, and
decodes that only when it draws: a lockstep of a thousand steps a second is drawn a few times a second.
"""

from typing import Any, TypeVar

import msgspec
import numpy as np

from uav_dc_ros import cdr, messages, payloads, scenarios
from uav_dc_ros.errors import MessageError
from uav_dc_ros.nodes.framework import node_main
from uav_dc_ros.nodes.framework.mission_node import MissionNode
from uav_dc_ros.nodes.view import markers
from uav_dc_ros.nodes.view.path_history import PathHistory
from uav_dc_ros.topics import Topic

P = TypeVar("P", bound=messages.Payload)


class _Heading(msgspec.Struct):
    """What `users` says before its long columns."""

    mission: int
    step: int
    stamp_ns: int


class VisualizerNode(MissionNode):
    """Draws what changed, at most `rate` times a second."""

    drains = True  # the end of a mission is drawn, too
    pause_s = 0.05  # nobody waits for it

    def __init__(self) -> None:
        super().__init__("visualizer")

    def configure(self) -> None:
        """Load the world whose clusters and dock are drawn."""
        self.scenario = scenarios.load(self.values["scenario"])

    def activate(self) -> None:
        """Draw from here on."""
        self._track = PathHistory(self.scenario)
        self._newest: dict[str, tuple[int, bytes]] = {}  # by topic: time of publication, and the message
        self._changed = False
        self._drawn = -1  # version of the track
        self.timer(1.0 / self.values["rate"], self._draw)

    def deactivate(self) -> None:
        """Draw the last state."""
        self._draw()

    def subscribe(self, topic: Topic) -> Any:
        """Subscribe to a topic of the row, for its bytes."""
        take = {"pose": self._take_pose, "target": self._take_target, "users": self._take_users}.get(
            topic.name, self._keep
        )

        def hear(data: bytes, info: Any) -> None:
            if self.is_of_another_run(topic.name, data):
                return
            published_ns = info["source_timestamp"]
            try:
                take(topic.name, data, published_ns)
            except MessageError as error:
                self.reject(topic.name, error)
            else:
                self._changed = True
            self.statistics.count_received(topic.name, info)

        return self.create_raw_subscription(topic, hear)

    def _take_pose(self, name: str, data: bytes, published_ns: int) -> None:
        self._track.add_pose(cdr.Pose(data), published_ns)

    def _take_target(self, name: str, data: bytes, published_ns: int) -> None:
        self._track.add_target(cdr.Pose(data))

    def _take_users(self, name: str, data: bytes, published_ns: int) -> None:
        try:
            heading = msgspec.json.decode(cdr.decode_string(data), type=_Heading)
        except (msgspec.DecodeError, RecursionError) as error:
            raise MessageError("malformed", str(error)) from None
        began_ns = self._track.add_users(
            mission=heading.mission, step=heading.step, stamp_ns=heading.stamp_ns, published_ns=published_ns
        )
        if began_ns is not None and self._newest.get("rates", (began_ns + 1, b""))[0] <= began_ns:
            del self._newest["rates"]  # of another mission, maybe of the same number
        self._keep(name, data, published_ns)

    def _keep(self, name: str, data: bytes, published_ns: int) -> None:
        self._newest[name] = (published_ns, data)

    def _payload(self, topic: str, kind: type[P]) -> P | None:
        """The newest payload of a topic; None if there is none, or it is no good."""
        if topic not in self._newest:
            return None
        try:
            payload = messages.decode(cdr.decode_string(self._newest[topic][1]), kind)
            payloads.check(payload, self.scenario)
        except MessageError as error:
            self.reject(topic, error)
            del self._newest[topic]
            return None
        return payload

    def _draw(self) -> None:
        if not self._changed:
            return
        self._changed = False
        poses: list[cdr.Pose] = []
        if self._track.version != self._drawn:
            self._drawn, poses = self._track.version, self._track.poses
        if poses:  # it is latched: who comes later has it, too
            self.publish("path", cdr.encode_path(poses))
        self.publish("markers", markers.markers(self.scenario, self._scene(self._track.newest)))

    def _scene(self, pose: cdr.Pose | None) -> markers.Scene:
        """What is known now."""
        users = self._payload("users", messages.Users)
        rates = self._payload("rates", messages.Rates)
        if users is None or (rates is not None and rates.mission != users.mission):
            rates = None
        nobody = np.zeros(0 if users is None else self.scenario.n_users, dtype=bool)
        return markers.Scene(
            time_ns=pose.stamp_ns if pose else users.stamp_ns if users else 0,
            position_m=pose.position_m if pose else None,
            users_m=np.empty((0, 2)) if users is None else payloads.users_m(users, self.scenario),
            served=nobody if rates is None else np.asarray(rates.served),
            collected=nobody if rates is None else np.asarray(rates.collected),
            mission=self._payload("mission", messages.Mission),
            sum_rate_bps=None if rates is None else rates.sum_rate_bps,
        )


if __name__ == "__main__":
    node_main.main(VisualizerNode)
