"""The visualizer: publishes `path` and `markers`, with which RViz and Foxglove draw the mission, and its
numbers as standard messages, which any tool plots.

It decodes every pose, for the path: see `PathHistory`. Of the other topics it keeps the newest message,
serialised, until it draws: a lockstep of a thousand steps a second is drawn a few times a second.
"""

from typing import Any, TypeVar

import msgspec
import numpy as np
from msgspec import UNSET

from uav_dc_ros import cdr, messages, payloads, scenarios
from uav_dc_ros.errors import MessageError
from uav_dc_ros.nodes.framework import node_main
from uav_dc_ros.nodes.framework.mission_node import MissionNode
from uav_dc_ros.nodes.framework.node_table import NUMERIC
from uav_dc_ros.nodes.ros import numeric_messages
from uav_dc_ros.nodes.view import markers
from uav_dc_ros.nodes.view.path_history import PathHistory
from uav_dc_ros.nodes.view.rate_limiter import RateLimiter
from uav_dc_ros.topics import Topic

P = TypeVar("P", bound=messages.Payload)


class _UsersHeader(msgspec.Struct):
    """The fields of `users` without its long columns."""

    mission: int
    step: int
    stamp_ns: int


class VisualizerNode(MissionNode):
    """Draws what changed, at most `rate` times a second, and publishes numbers, at most `numeric_rate`."""

    drain_quiet_s = 0.1  # it draws the end of a mission, too
    pause_s = 0.05  # no node waits for it

    def __init__(self) -> None:
        super().__init__("visualizer")

    def configure(self) -> None:
        """Load the scenario whose clusters and dock are drawn."""
        self.scenario = scenarios.load(self.values["scenario"])
        has_model = self.scenario.energy is not None and "bridge" not in self.values["peers"]
        applies = {"battery": has_model, "tf": self.values["tf"], **dict.fromkeys(NUMERIC, True)}
        is_on = self.values["numeric_rate"] > 0
        self.not_published = {name for name, does in applies.items() if not (does and is_on)}

    def activate(self) -> None:
        """Start drawing."""
        self._path = PathHistory(self.scenario)
        self._newest: dict[str, tuple[int, bytes]] = {}  # by topic: publication time and message
        self._has_changed = False
        self._drawn_version = -1  # of the path
        self._pose: cdr.Pose | None = None  # published last as `odom`
        self._numbers = RateLimiter(self.values["numeric_rate"], self._publish_numbers)
        self.timer(1.0 / self.values["rate"], self._draw)

    def deactivate(self) -> None:
        """Publish the last state."""
        self._numbers.flush(at_once=True)
        self._draw()

    def subscribe(self, topic: Topic) -> Any:
        """Subscribe to a topic of the row, serialised."""

        def handle(data: bytes, info: Any) -> None:
            published_ns = info["source_timestamp"]
            if topic.name == "pose":
                self._path.add_pose(cdr.Pose(data), published_ns)
            elif topic.name == "target":
                self._path.add_target(cdr.Pose(data))
            else:
                if topic.name == "users":
                    self._add_users(data, published_ns)
                self._newest[topic.name] = (published_ns, data)
            self._has_changed = True
            self._numbers.request(topic.name)

        return self.subscribe_serialised(topic, handle)

    def _add_users(self, data: bytes, published_ns: int) -> None:
        try:
            header = msgspec.json.decode(cdr.decode_string(data), type=_UsersHeader)
        except (msgspec.DecodeError, RecursionError) as error:
            raise MessageError("malformed", str(error)) from None
        began_ns = self._path.add_users(
            mission=header.mission, step=header.step, stamp_ns=header.stamp_ns, published_ns=published_ns
        )
        if began_ns is not None:
            self._pose = None  # no velocity from the end of one mission to the start of the next
        if began_ns is not None and self._newest.get("rates", (began_ns + 1, b""))[0] <= began_ns:
            del self._newest["rates"]  # of another mission, maybe with the same number

    def _payload(self, topic: str, kind: type[P]) -> P | None:
        """The newest payload of a topic; None if there is none, or it is invalid."""
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

    def _publish_numbers(self, topic: str) -> None:
        """Publish the numbers of a topic's newest message."""
        if topic == "pose" and (pose := self._path.newest) is not None:
            self.publish("odom", numeric_messages.odometry(pose, self._pose))
            self._pose = pose
            if "tf" in self.publishers_of:
                self.publish("tf", numeric_messages.transform(pose))
        elif topic == "rates" and (rates := self._payload("rates", messages.Rates)) is not None:
            self.publish("sum_rate", numeric_messages.float64(rates.sum_rate_bps))
            self.publish("users_collected", numeric_messages.int32(sum(rates.collected)))
        elif topic == "mission" and (mission := self._payload("mission", messages.Mission)) is not None:
            self.publish("remaining_steps", numeric_messages.int32(mission.remaining_steps))
            if "battery" in self.publishers_of and mission.state_of_charge is not UNSET:
                now_ns: int = self.get_clock().now().nanoseconds
                self.publish("battery", numeric_messages.battery(mission.state_of_charge, now_ns))

    def _draw(self) -> None:
        self._numbers.flush()
        if not self._has_changed:
            return
        self._has_changed = False
        poses: list[cdr.Pose] = []
        if self._path.version != self._drawn_version:
            self._drawn_version, poses = self._path.version, self._path.poses
        if poses:  # otherwise the latched message is still valid
            self.publish("path", cdr.encode_path(poses))
        self.publish("markers", markers.markers(self.scenario, self._scene(self._path.newest)))

    def _scene(self, pose: cdr.Pose | None) -> markers.Scene:
        users = self._payload("users", messages.Users)
        rates = self._payload("rates", messages.Rates)
        if users is None or (rates is not None and rates.mission != users.mission):
            rates = None
        none = np.zeros(0 if users is None else self.scenario.n_users, dtype=bool)
        return markers.Scene(
            time_ns=pose.stamp_ns if pose else users.stamp_ns if users else 0,
            position_m=pose.position_m if pose else None,
            users_m=np.empty((0, 2)) if users is None else payloads.users_m(users, self.scenario),
            served=none if rates is None else np.asarray(rates.served),
            collected=none if rates is None else np.asarray(rates.collected),
            mission=self._payload("mission", messages.Mission),
            sum_rate_bps=None if rates is None else rates.sum_rate_bps,
        )


if __name__ == "__main__":
    node_main.main(VisualizerNode)
