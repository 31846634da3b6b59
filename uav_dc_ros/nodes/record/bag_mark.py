"""The verb `mark`: puts an annotation into every recording that runs in a namespace.

It publishes a std_msgs/String on the topic `mark`, and ends once the recorders have acknowledged it.
"""

import argparse
import time

from uav_dc_ros import cdr, cli
from uav_dc_ros.errors import NodeError
from uav_dc_ros.messages import TEXT_MAX, printable
from uav_dc_ros.nodes.ros import environment, fastdds
from uav_dc_ros.topics import MARK

NODE = "bag_mark"
RECORDERS = ("recorder", "bag_record")  # names of nodes
SETTLE_S = 0.5  # for further recorders, after the first
WAIT_S = 0.05
SHUTDOWN_S = 1.0  # for the middleware


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the verb."""
    add = parser.add_argument
    add("text", type=_text, metavar="TEXT", help=f"one line of at most {TEXT_MAX} characters")
    cli.add_namespace(parser, "of the recording (default: %(default)s)")
    seconds = cli.number(0.1, 3600.0, "seconds from 0.1 to 3600")
    what = "longest time to wait for a recorder (default: %(default)g)"
    add("--timeout", type=seconds, default=5.0, metavar="S", help=what)


def _text(text: str) -> str:
    text = text.strip()
    if not 0 < len(text) <= TEXT_MAX or printable(text) != text:
        raise argparse.ArgumentTypeError(f"{text[:80]!r}; expected one line of 1 to {TEXT_MAX} characters")
    return text


def run(options: argparse.Namespace) -> int:
    """Publish the mark; the exit status. Raises NodeError if no recorder receives it in time."""
    environment.prepare(local_only=False)  # the recorder may be on another host
    fastdds.select_transports()
    import rclpy
    from rclpy.duration import Duration
    from rclpy.node import Node
    from rclpy.signals import SignalHandlerOptions
    from std_msgs.msg import String

    from uav_dc_ros.nodes.ros.executor import shut_down

    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = Node(NODE, namespace=options.namespace, start_parameter_services=False, enable_rosout=False)
        publisher = node.create_publisher(String, MARK, 10)
        topic, deadline_s = publisher.topic_name, time.monotonic() + options.timeout

        def recorders() -> list[str]:
            ends = node.get_subscriptions_info_by_topic(topic)
            return sorted(
                f"{end.node_namespace.rstrip('/')}/{end.node_name}"
                for end in ends
                if end.node_name in RECORDERS
            )

        while not recorders():
            if time.monotonic() > deadline_s:
                raise NodeError(
                    f"no recorder received {topic} within {options.timeout:g} s; expected one that records "
                    f"in {options.namespace} (--namespace)"
                )
            time.sleep(WAIT_S)
        time.sleep(SETTLE_S)
        publisher.publish(cdr.encode_string(options.text.encode()))
        if not publisher.wait_for_all_acked(Duration(seconds=max(deadline_s - time.monotonic(), WAIT_S))):
            raise NodeError(f"a recorder did not acknowledge {topic} within {options.timeout:g} s")
        print(f"marked {options.text!r} in the recording of {', '.join(recorders())}")
    finally:
        shut_down(rclpy.get_default_context(), SHUTDOWN_S)
    return 0
