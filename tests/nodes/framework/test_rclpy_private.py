"""The private API of rclpy that is in use: after a change in rclpy, this test shows where."""

import re
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import rclpy
from lifecycle_msgs.msg import Transition
from rclpy.event_handler import QoSSubscriptionEventType, SubscriptionEventCallbacks
from rclpy.lifecycle import LifecycleNode
from std_msgs.msg import String

import uav_dc_ros
from tests.conftest import Ros, finish
from uav_dc_ros.nodes.ros import rclpy_private

PACKAGE = Path(uav_dc_ros.__file__).parent
PRIVATE = re.compile(
    r"implementation_singleton|\._(callback_type|state_machine|service_change_state|parameter_overrides)\b"
)


def test_it_is_in_use_in_one_module_only() -> None:
    found = {path.name for path in PACKAGE.rglob("*.py") if PRIVATE.search(path.read_text("utf-8"))}
    assert found == {"rclpy_private.py"}


def test_all_of_it_is_there(ros: Ros, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in ros.environment.items():
        monkeypatch.setenv(name, value)
    context = rclpy.Context()
    with pytest.raises(rclpy_private.INIT_ERRORS):
        context.init(["--ros-args", "-p"])
    context = rclpy.Context()
    context.init()
    given = rclpy.Parameter("given", value=3)
    node = LifecycleNode("private", context=context, parameter_overrides=[given])
    try:
        check(node, context)
    finally:
        node.destroy_node()
        context.try_shutdown()


TYPE_SUPPORT = """
import sys
from std_msgs.msg import String
from uav_dc_ros.nodes.ros import rclpy_private
if sys.argv[1:]:
    rclpy_private.skip_message_generator()
String.__class__.__import_type_support__()
print("lark" in sys.modules)
"""


@pytest.mark.parametrize("skipped", [True, False])
def test_a_node_does_not_import_the_generator_of_messages(ros: Ros, skipped: bool) -> None:
    """If the other case fails, ROS no longer imports it, and nothing needs to be skipped."""
    arguments = ["skip"] if skipped else []
    status, output = finish(ros.start_command(sys.executable, "-c", TYPE_SUPPORT, *arguments))
    assert (status, output) == (0, f"{not skipped}\n")


def check(node: LifecycleNode, context: Any) -> None:
    assert rclpy_private.parameter_overrides(node)["given"].value == 3
    rclpy_private.parameter_overrides(node)["given"] = rclpy.Parameter("given", value=4)
    assert node.declare_parameter("given", 0).value == 4, "what is changed there is what it declares"

    assert rclpy_private.state(node) == "unconfigured"
    answered = []

    def answer(request: Any, response: Any) -> Any:
        answered.append(request)
        return before(request, response)

    before = rclpy_private.replace_change_state(node, answer)
    assert node._service_change_state.callback is answer
    request = SimpleNamespace(transition=SimpleNamespace(label="", id=Transition.TRANSITION_ACTIVATE))
    with pytest.raises(rclpy_private.RCLError):  # no transition of this state
        answer(request, SimpleNamespace(success=None))
    assert answered == [request]

    plain = node.create_subscription(String, "a", lambda message: None, 1)
    events = SubscriptionEventCallbacks(use_default_callbacks=False)
    informed = node.create_subscription(String, "b", lambda message, info: None, 1, event_callbacks=events)
    assert [rclpy_private.takes_info(one) for one in (plain, informed)] == [False, True]

    wait_set = rclpy_private.wait_set(context, 1, 1, 0, 0, 0)
    wait_set.clear_entities()
    with context.handle:
        at = wait_set.add_subscription(informed.handle)
        wait_set.wait(0)
        assert not wait_set.is_ready("subscription", at)

    for kind, name in (
        (QoSSubscriptionEventType.RCL_SUBSCRIPTION_MESSAGE_LOST, "total_count"),
        (QoSSubscriptionEventType.RCL_SUBSCRIPTION_LIVELINESS_CHANGED, "alive_count"),
    ):
        count = rclpy_private.EventCount(informed, kind)
        assert getattr(count.take(), name) == 0
        count.close()
        assert count.take() is None
