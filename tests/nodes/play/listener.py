"""A subscriber that keeps what it receives, and prints it when its standard input is closed.

    listener.py JSON

JSON: {"topics": {NAME: {"type": ..., "latched": bool, "reliable": bool}}, "each_s": seconds that it
takes for a message, "name": of the node}. It prints "there" once it subscribes. A line on its input requests
for the number of messages so far. At the end comes one line: a list of [topic, data (base64), when it was
published, when it was received], in the order of receipt; times in nanoseconds. It keeps all that it has not
handled yet.
"""

import base64
import importlib
import json
import sys
import threading
import time
from typing import Any

import rclpy
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from uav_dc_ros.nodes.ros import fastdds
from uav_dc_ros.nodes.ros.executor import DirectExecutor

QUIET_S = 0.4


def main() -> None:
    spec = json.loads(sys.argv[1])
    fastdds.select_transports()
    rclpy.init()
    node = rclpy.create_node(spec.get("name", "listener"))
    received: list[tuple[str, bytes, int, int]] = []
    each_s = spec.get("each_s", 0.0)

    def listen(topic: str, row: dict[str, Any]) -> None:
        def receive(data: bytes, info: Any) -> None:
            received.append((topic, data, info["source_timestamp"], info["received_timestamp"]))
            if each_s:
                time.sleep(each_s)

        package, _, name = row["type"].split("/")
        latched, reliable = row.get("latched", False), row.get("reliable", True)
        qos = QoSProfile(
            history=HistoryPolicy.KEEP_ALL,
            reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        )
        kind = getattr(importlib.import_module(f"{package}.msg"), name)
        node.create_subscription(kind, topic, receive, qos, raw=True)

    for topic, row in spec["topics"].items():
        listen(topic, row)
    executor = DirectExecutor()
    executor.add_node(node)
    closed = False

    def obey() -> None:
        nonlocal closed
        for _ in sys.stdin:
            print(len(received), flush=True)
        closed = True
        executor.wake()

    print("there", flush=True)
    threading.Thread(target=obey, daemon=True).start()
    executor.spin(lambda: closed)
    executor.spin(lambda: False, QUIET_S)
    print(
        json.dumps([[t, base64.b64encode(d).decode(), sent, got] for t, d, sent, got in received]), flush=True
    )
    rclpy.shutdown()


if __name__ == "__main__":
    main()
