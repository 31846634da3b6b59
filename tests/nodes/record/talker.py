"""A publisher outside the mission: publishes numbered messages on any topics, and prints how many.

Its argument is a JSON list of publishers: {"topic", "reliable", "latched", "depth", "bytes", "hz", "n",
"after_s", "patience_s"}, all but the first with a default. The number stands in the first nine characters of
a std_msgs/String; with "stereo" the message is an empty stereo_msgs/DisparityImage. Prints "publishing",
then, when all is published, the numbers of messages by topic as JSON, and ends when its standard input does.
"""

import json
import sys
import threading
import time
from collections import Counter
from typing import Any

import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String

from uav_dc_ros.nodes.ros import fastdds

published: Counter[str] = Counter()


def talk(node: Any, row: dict[str, Any]) -> None:
    """Publish what one row says."""
    time.sleep(row.get("after_s", 0.0))
    kind: Any = String
    if row.get("stereo"):
        from stereo_msgs.msg import DisparityImage

        kind = DisparityImage
    profile = QoSProfile(
        depth=row.get("depth", 1000),
        reliability=ReliabilityPolicy.RELIABLE
        if row.get("reliable", True)
        else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if row.get("latched") else DurabilityPolicy.VOLATILE,
    )
    publisher = node.create_publisher(kind, row["topic"], profile)
    if not row.get("latched"):
        deadline_s = time.monotonic() + row.get("patience_s", 200.0)
        while not publisher.get_subscription_count() and time.monotonic() < deadline_s:
            time.sleep(0.005)
        time.sleep(0.3)  # a publisher may know of a subscriber before that one knows of it
    filling = "x" * (row.get("bytes", 9) - 9)
    begun_s = time.monotonic()
    for i in range(row.get("n", 1)):
        publisher.publish(kind() if row.get("stereo") else String(data=f"{i:09d}{filling}"))
        published[row["topic"]] += 1
        time.sleep(max(0.0, begun_s + (i + 1) / row.get("hz", 1000.0) - time.monotonic()))
    row["publisher"] = publisher


def main() -> None:
    fastdds.select_transports()
    rclpy.init()
    node = rclpy.create_node("talker")
    rows = json.loads(sys.argv[1])
    threads = [threading.Thread(target=talk, args=(node, row)) for row in rows]
    for thread in threads:
        thread.start()
    print("publishing", flush=True)
    for thread in threads:
        thread.join()
    time.sleep(0.5)
    print(json.dumps(published), flush=True)
    sys.stdin.read()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
