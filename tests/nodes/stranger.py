"""A stranger on the network who fires garbage at every topic, and loses none of it unnoticed.

python -m tests.nodes.stranger SCENARIO SEED PER_TOPIC OVERSIZED MISSION PEERS

Waits until MISSION is flown, so that the garbage's idea of the past is right. Each burst is sent when the
burst before has been received by all; the readers must keep all (`qos_overrides`). With each burst goes a
message of another type on the same topic.

Prints, as JSON: what was sent, by topic and reason; how long that took; what each node of PEERS counts in
its diagnostics; and how many readers there were for the other type.
"""

import itertools
import json
import sys
import time
from collections import Counter

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from std_msgs.msg import Int32, String

from tests.nodes.garbage import JSON_TOPICS, TOPICS, garbage, oversized
from uav_dc_ros import scenarios
from uav_dc_ros.nodes.framework.node_table import NODES
from uav_dc_ros.nodes.ros import fastdds, qos
from uav_dc_ros.topics import TOPICS as ROWS

BURST = 500
PATIENCE_S = 200.0
SETTLED_S = 1.5  # longer than from one word of diagnostics to the next


class Stranger(Node):
    """Hears the missions and the diagnostics, and has publishers that keep whole bursts."""

    def __init__(self, peers: list[str]) -> None:
        super().__init__("stranger")
        self.mission = -1
        self.diagnosed: dict[str, dict[str, int]] = {}
        self.publishers_of: dict[str, Publisher] = {}
        self.hearing = {name: sum(name in NODES[peer].subscribes for peer in peers) for name in TOPICS}
        self.listening = self.create_subscription(
            String, "mission", self.on_mission, qos.requested(ROWS["mission"], keep_all=True)
        )
        self.create_subscription(
            DiagnosticArray,
            "diagnostics",
            self.on_diagnostics,
            qos.requested(ROWS["diagnostics"], keep_all=True),
        )

    def on_mission(self, message: String) -> None:
        self.mission = json.loads(message.data)["mission"]

    def on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            told = {entry.key: entry.value for entry in status.values}
            self.diagnosed[status.name] = {
                key.replace(" rejected: ", " "): int(value)
                for key, value in told.items()
                if " rejected: " in key
            }

    def enter(self) -> None:
        """Make the publishers. A world does not start where somebody else publishes `mission`."""
        for name in TOPICS:
            profile = qos.offered(ROWS[name])
            profile.depth = 2 * BURST
            self.publishers_of[name] = self.create_publisher(
                qos.MESSAGE_TYPES[ROWS[name].type], name, profile
            )
        # No participant may know one topic by two types.
        self.elsewhere = rclpy.Context()
        rclpy.init(context=self.elsewhere)
        other = rclpy.create_node("other_types", context=self.elsewhere)
        self.others = {name: other.create_publisher(Int32, name, qos.offered(ROWS[name])) for name in TOPICS}

    def all_hear(self) -> bool:
        return all(
            publisher.get_subscription_count() >= self.hearing[name]
            for name, publisher in self.publishers_of.items()
        )

    def fire(self, name: str, burst: list[bytes]) -> None:
        for data in burst:
            self.publishers_of[name].publish(data)
        self.others[name].publish(Int32(data=len(burst)))

    def received(self) -> None:
        for name, publisher in self.publishers_of.items():
            if not publisher.wait_for_all_acked(Duration(seconds=PATIENCE_S)):
                raise TimeoutError(f"{name}: a burst was not received within {PATIENCE_S} s")


def wait_until(node: Node, condition: object) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not condition():
        rclpy.spin_once(node, timeout_sec=0.1)
        if time.monotonic() > deadline_s:
            raise TimeoutError("the mission did not come so far, or not all nodes were found")


def main() -> None:
    scenario, seed, per_topic, n_oversized, mission, peers = sys.argv[1:]
    fastdds.select_transports()
    rclpy.init()
    stranger = Stranger(peers.split(","))
    wait_until(stranger, lambda: stranger.mission >= int(mission))
    stranger.destroy_subscription(stranger.listening)  # it would hear itself
    stranger.enter()
    wait_until(stranger, stranger.all_hear)

    sources = {name: garbage(name, scenarios.load(scenario), int(seed)) for name in TOPICS}
    sent: Counter[str] = Counter()
    began_s = time.monotonic()
    for start in range(0, int(per_topic), BURST):
        for name, source in sources.items():
            burst = list(itertools.islice(source, min(BURST, int(per_topic) - start)))
            sent.update(f"{name} {one.reason}" for one in burst)
            stranger.fire(name, [one.data for one in burst])
        stranger.received()
    for name in JSON_TOPICS * int(n_oversized):
        sent[f"{name} oversized"] += 1
        stranger.fire(name, [oversized().data])
        stranger.received()
    fired_s = time.monotonic() - began_s

    # What was received is not yet read. Who has read all of it counts no more.
    before: dict[str, dict[str, int]] = {"": {}}
    while before != stranger.diagnosed or len(before) < len(peers.split(",")):
        before = dict(stranger.diagnosed)
        until_s = time.monotonic() + SETTLED_S
        while time.monotonic() < until_s:
            rclpy.spin_once(stranger, timeout_sec=0.1)
    told = {"sent": sent, "fired_s": fired_s, "diagnosed": stranger.diagnosed}
    told["other_type_heard"] = sum(each.get_subscription_count() for each in stranger.others.values())
    print(json.dumps(told), flush=True)
    rclpy.shutdown(context=stranger.elsewhere)
    rclpy.shutdown()


if __name__ == "__main__":
    main()
