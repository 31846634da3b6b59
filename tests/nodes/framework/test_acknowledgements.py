"""No message of a mission is dropped while a subscriber is slower than the mission."""

import signal
import subprocess

import pytest
from std_msgs.msg import String

from tests.conftest import Ros, finish, until, wait_for
from tests.nodes.conftest import python
from tests.support.fake_autopilot.mavros_flight import node_in
from uav_dc_ros.nodes.framework import acknowledgements
from uav_dc_ros.nodes.framework.acknowledgements import AcknowledgementWindow
from uav_dc_ros.nodes.ros import qos
from uav_dc_ros.topics import TOPICS

MESSAGES = 200
PROFILE = qos.offered(TOPICS["rates"])
PROFILE.depth = 10  # messages that the publisher keeps
LARGE = "x" * 64_000  # so that buffers of the system do not hold all messages

SUBSCRIBER = """
import rclpy
from std_msgs.msg import String
from uav_dc_ros.nodes.ros import qos
from uav_dc_ros.topics import TOPICS
rclpy.init()
node = rclpy.create_node("slow")
received = []
node.create_subscription(
    String, "rates", lambda message: received.append(message), qos.requested(TOPICS["rates"], keep_all=True)
)
print("subscribed", flush=True)
while not (received and received[-1].data == "last"):
    rclpy.spin_once(node)
print(len(received), flush=True)
"""


def test_a_subscriber_that_stands_still_receives_every_message(
    ros: Ros, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(acknowledgements, "ACKNOWLEDGE_S", 60.0)
    with node_in(ros) as (node, _):
        publisher = node.create_publisher(String, "rates", PROFILE)
        window = AcknowledgementWindow([publisher])
        subscriber = python(ros, SUBSCRIBER)
        assert subscriber.stdout is not None
        wait_for(subscriber.stdout, "subscribed")
        until(lambda: publisher.get_subscription_count() == 1)
        subscriber.send_signal(signal.SIGSTOP)
        # Another process lets it go on: rclpy waits for acknowledgements without releasing the GIL.
        goes_on = subprocess.Popen(["sh", "-c", f"sleep 0.5; kill -CONT {subscriber.pid}"])
        for _ in range(MESSAGES):
            window.step()
            publisher.publish(String(data=LARGE))
        publisher.publish(String(data="last"))
        status, output = finish(subscriber)
        assert goes_on.wait() == 0
    assert (status, output.split()) == (0, [str(MESSAGES + 1)])


class Publisher:
    """Counts the waits; its subscriber never acknowledges."""

    qos_profile = PROFILE

    def __init__(self) -> None:
        self.waited_s: list[float] = []

    def wait_for_all_acked(self, timeout: object) -> bool:
        self.waited_s.append(timeout.nanoseconds * 1e-9)  # type: ignore[attr-defined]
        return False


def test_a_subscriber_that_was_killed_delays_a_mission_once() -> None:
    now_s = 100.0
    publisher = Publisher()
    window = AcknowledgementWindow([publisher], lambda: now_s)  # type: ignore[list-item]
    for _ in range(18):
        window.step()
    assert publisher.waited_s == pytest.approx([1.0, 0.02, 0.02])
    for _ in range(60):  # in real time no wait delays a step
        now_s += 1.0
        window.step()
    assert len(publisher.waited_s) == 3
