"""A stranger on the network: publishes what it is told to, and prints what it hears.

An argument name=NAME is the name of its node, the others are topics.

Commands come as JSON lines on standard input: {"topic", "type", "latched", "data"}; with a number in
"pose" the message is a PoseStamped. Each message on one of the topics is printed as a JSON line.
"""

import contextlib
import json
import sys
import threading
import time

import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.duration import Duration
from std_msgs.msg import String

from uav_dc_ros.nodes.ros import convert, fastdds, qos
from uav_dc_ros.topics import TOPICS

SETTLE_S = 0.3  # a publisher may know of a subscriber before that one knows of it


def main() -> None:
    fastdds.select_transports()
    rclpy.init()
    named = [argument.removeprefix("name=") for argument in sys.argv[1:] if argument.startswith("name=")]
    node = rclpy.create_node(*named or ["probe"])
    for name in [argument for argument in sys.argv[1:] if not argument.startswith("name=")]:
        topic = TOPICS[name.rsplit("/", 1)[-1]]

        def hear(message: object, name: str = name) -> None:
            print(json.dumps({"topic": name, "data": getattr(message, "data", None)}), flush=True)

        node.create_subscription(
            qos.MESSAGE_TYPES[topic.type],
            name,
            lambda m, h=hear: h(m),
            qos.requested(topic, keep_all=True),
        )
    publishers = {}

    def obey() -> None:
        for line in sys.stdin:
            command = json.loads(line)
            name = command["topic"]
            row = TOPICS[name.rsplit("/", 1)[-1]]
            if name not in publishers:
                kind = qos.MESSAGE_TYPES[row.type]
                publishers[name] = node.create_publisher(kind, name, qos.offered(row))
                while publishers[name].get_subscription_count() < command["hearing"]:
                    time.sleep(0.01)
                time.sleep(SETTLE_S)
            if "pose" in command:
                message = PoseStamped()
                message.header.frame_id = command["frame"]
                message.pose.position.x = float(command["pose"])
                message.header.stamp = convert.stamp(command.get("stamp_ns", 0))
            else:
                message = String(data=command["data"])
            publishers[name].publish(message)
        for publisher in publishers.values():
            publisher.wait_for_all_acked(Duration(seconds=5))
        rclpy.shutdown()

    threading.Thread(target=obey, daemon=True).start()
    with contextlib.suppress(rclpy.executors.ExternalShutdownException):
        rclpy.spin(node)


if __name__ == "__main__":
    main()
