"""The recorder: every recorded topic of the mission into a bag, serialised as it came."""

import json
import time
from pathlib import Path
from typing import Any

import msgspec
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

from uav_dc_ros import __version__
from uav_dc_ros.agents import policy as policies
from uav_dc_ros.bags.write import BagWriter
from uav_dc_ros.errors import ParameterError
from uav_dc_ros.nodes import convert, runtime
from uav_dc_ros.topics import TOPICS, Topic


class Recorder(runtime.MissionNode):
    """Writes a bag; what it is about (scenario, policy and its hash, seed) goes inside."""

    drains = True

    def __init__(self) -> None:
        super().__init__("recorder")
        folder = self.parameter("bag", "", "folder of the new bag")
        if not folder:
            raise ParameterError("bag: ''; expected the folder of a new bag (-p bag:=FOLDER)")
        scenario = self.scenario_parameter()
        policy = self.parameter("policy", "", "policy that flies, by name or folder; empty: not known")
        about = {
            "version": __version__,
            "scenario": scenario.name,
            "scenario_fingerprint": scenario.fingerprint,
            "scenario_values": json.dumps(msgspec.to_builtins(scenario)),
            "seed": str(self.whole_number("seed", 0, 0, "seed of the first mission's users")),
            "missions": str(self.whole_number("missions", 1, 1, "missions that will be flown")),
            "pace": self.parameter("pace", "", "pace of the mission"),
        }
        if policy:
            loaded = policies.load(policy)
            about |= {"policy": loaded.name, "policy_sha256": loaded.sha256}
        self.writer = BagWriter(Path(folder), about)
        self._names: dict[str, str] = {}
        self.listen()

    def _subscribe(self, topic: Topic) -> Any:
        def hear(data: Any, info: Any) -> None:
            received_ns = time.time_ns()
            if topic.name not in self._names:
                self._announce(topic)
            self.writer.write(
                self._names[topic.name],
                data,
                log_time_ns=received_ns,
                publish_time_ns=info["source_timestamp"],
            )

        # rclpy sees by the signature that `hear` takes the message's information, too; its types do not.
        callback: Any = hear
        return self.create_subscription(
            runtime.MESSAGE_TYPES[topic.type],
            topic.name,
            callback,
            runtime.requested_qos(topic, all=self.row.hears_all),
            raw=True,
        )

    def _announce(self, topic: Topic) -> None:
        """Enter a topic into the bag with the QoS that its publishers offer by now."""
        name = self.resolve_topic_name(topic.name)
        self._names[topic.name] = name
        offers = {
            (end.qos_profile.reliability, end.qos_profile.durability)
            for end in self.get_publishers_info_by_topic(name)
        }
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

    def on_stop(self) -> None:
        """Close the bag."""
        self.writer.close()


if __name__ == "__main__":
    runtime.main(Recorder)
