"""The recorder: every recorded topic of the mission into a bag, serialised as it came.

A recorder that was killed goes on in the same bag, in a new part: latched topics tell it what it missed.
"""

import json
from pathlib import Path
from typing import Any

import msgspec
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

from uav_dc_ros import __version__, scenarios
from uav_dc_ros.agents import policy as policies
from uav_dc_ros.bags.write import BagWriter
from uav_dc_ros.core import pace
from uav_dc_ros.errors import ParameterError
from uav_dc_ros.nodes import convert, runtime
from uav_dc_ros.nodes.mission_node import MissionNode
from uav_dc_ros.topics import TOPICS, Topic


class Recorder(MissionNode):
    """Writes a bag; what it is about (scenario, policy and its hash, seed) goes inside."""

    drains = True
    rest_s = 0.005  # nobody waits for it

    def __init__(self) -> None:
        super().__init__("recorder")
        self.writer: BagWriter | None = None

    def configure(self) -> None:
        """Make the bag."""
        given = self.values
        if not given["bag"]:
            raise ParameterError("bag: ''; expected the folder of a new bag (-p bag:=FOLDER)")
        scenario = scenarios.load(given["scenario"])
        about = {
            "version": __version__,
            "scenario": scenario.name,
            "scenario_fingerprint": scenario.fingerprint,
            "scenario_values": json.dumps(msgspec.to_builtins(scenario)),
            "seed": str(given["seed"]),
            "missions": str(given["missions"]),
            "pace": pace.text(given["pace"]),
        }
        if given["policy"]:
            loaded = policies.load(given["policy"])
            about |= {"policy": loaded.name, "policy_sha256": loaded.sha256}
        folder = Path(given["bag"])
        self.writer = BagWriter(folder, about, resume=given["resume"] and folder.exists())
        self._names: dict[str, str] = {}

    def deactivate(self) -> None:
        """Close the bag."""
        self.cleanup()

    def cleanup(self) -> None:
        """Close the bag."""
        if self.writer is not None:
            self.writer.close()
            self.writer = None

    def activate(self) -> None:
        """Record.

        Raises:
            ParameterError: the bag of this configuration is closed.
        """
        if self.writer is None:
            raise ParameterError(
                f"bag: {self.values['bag']} is closed; clean the node up, and configure it with a new folder"
            )

    def subscribe(self, topic: Topic) -> Any:
        """Subscribe to a topic of the row, for its bytes."""

        def hear(data: bytes, info: Any) -> None:
            assert self.writer is not None, "subscriptions end with the bag"
            if topic.name not in self._names:
                self._announce(topic)
            name = self._names[topic.name]
            published_ns, received_ns = info["source_timestamp"], info["received_timestamp"]
            self.meter.heard(topic.name, received_ns - published_ns)
            if published_ns > self.writer.already_written.get(name, -1):
                self.writer.write(name, data, log_time_ns=received_ns, publish_time_ns=published_ns)

        return self.create_raw_subscription(topic, hear)

    def _announce(self, topic: Topic) -> None:
        """Enter a topic into the bag with the QoS that its publishers offer by now."""
        name = self.resolve_topic_name(topic.name)
        self._names[topic.name] = name
        offers = {
            (end.qos_profile.reliability, end.qos_profile.durability)
            for end in self.get_publishers_info_by_topic(name)
        }
        assert self.writer is not None, "subscriptions end with the bag"
        self.writer.add_topic(
            name,
            topic.type,
            [
                # Discovery does not carry the depth: it is the topic table's.
                convert.offered_qos(
                    depth=topic.depth,
                    reliable=reliability == ReliabilityPolicy.RELIABLE,
                    latched=durability == DurabilityPolicy.TRANSIENT_LOCAL,
                )
                for reliability, durability in sorted(offers)
            ],
        )

    def on_peers(self) -> None:
        """Enter every topic, also those that will stay silent; then say ready."""
        for name in self.row.subscribes:
            if name not in self._names:
                self._announce(TOPICS[name])
        super().on_peers()


if __name__ == "__main__":
    runtime.main(Recorder)
