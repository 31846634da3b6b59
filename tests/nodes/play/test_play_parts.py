"""The parts of play: the time of the bag, and the QoS of recorded topics."""

import math
import sys
from pathlib import Path

import pytest
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2.metadata import dump_qos_v8, dump_qos_v9
from std_msgs.msg import String

from uav_dc_ros.bags.metadata import to_yaml
from uav_dc_ros.bags.read import RecordedTopic
from uav_dc_ros.errors import BagError, NodeError
from uav_dc_ros.nodes.play import playback_publisher
from uav_dc_ros.nodes.play.clock import PlaybackClock
from uav_dc_ros.nodes.ros import recorded_qos

S = 10**9


class Steady:
    """A clock that is set by hand."""

    def __init__(self) -> None:
        self.s = 100.0

    def __call__(self) -> float:
        return self.s


def test_time_runs_by_the_rate_and_stands_still_in_a_pause() -> None:
    now = Steady()
    clock = PlaybackClock(2.0, now=now)
    clock.jump(10 * S)
    clock.limit_ns = 100 * S
    assert clock.due_s(14 * S) == 102.0
    now.s += 3.0
    assert clock.position_ns() == 16 * S
    clock.toggle_pause()
    now.s += 50.0
    assert clock.position_ns() == 16 * S
    assert clock.due_s(17 * S) == math.inf
    clock.toggle_pause()
    assert clock.due_s(17 * S) == now.s + 0.5
    clock.rate = 0.5
    assert clock.due_s(17 * S) == now.s + 2.0


def test_time_does_not_run_ahead_of_what_is_played() -> None:
    """A player that cannot keep up is as slow as it is: a lower rate holds from where it is."""
    now = Steady()
    clock = PlaybackClock(1000.0, now=now)
    clock.limit_ns = 5 * S
    now.s += 1.0
    assert clock.position_ns() == 5 * S
    clock.rate = 1.0
    assert clock.due_s(6 * S) == now.s + 1.0


def test_a_step_and_a_bag_without_schedule_carry_the_time_along() -> None:
    for clock in (PlaybackClock(1.0, paused=True), PlaybackClock(math.inf)):
        clock.jump(1 * S)
        clock.limit_ns = 7 * S
        clock.follow(7 * S)
        assert clock.position_ns() == 7 * S


def test_what_had_to_be_waited_for_delays_the_rest() -> None:
    now = Steady()
    clock = PlaybackClock(1.0, now=now)
    clock.delay(4.0)
    assert clock.due_s(1 * S) == 105.0


FOREVER = QosTime(9223372036, 854775807)


def offer(**changed: object) -> Qos:
    return recorded_qos.offered(QoSProfile(depth=4), 4)._replace(**changed)  # type: ignore[arg-type]


def profile(*offers: Qos, per_s: float = 1.0, message_bytes: int = 100):  # type: ignore[no-untyped-def]
    topic = RecordedTopic(name="/a", type="", offered_qos=to_yaml(dump_qos_v9(list(offers))))
    return recorded_qos.profile(topic, message_bytes=message_bytes, per_s=per_s)


LATCHED = offer(durability=QosDurability.TRANSIENT_LOCAL)
BEST_EFFORT = offer(reliability=QosReliability.BEST_EFFORT)


def test_one_publisher_stands_for_all_and_offers_the_most() -> None:
    made = profile(BEST_EFFORT, LATCHED)
    assert made.reliability == ReliabilityPolicy.RELIABLE
    assert made.durability == DurabilityPolicy.TRANSIENT_LOCAL
    made = profile(BEST_EFFORT, BEST_EFFORT)
    assert made.reliability == ReliabilityPolicy.BEST_EFFORT
    assert made.durability == DurabilityPolicy.VOLATILE


def test_a_bag_that_tells_nothing_is_played_reliably() -> None:
    made = profile()
    assert (made.reliability, made.durability) == (ReliabilityPolicy.RELIABLE, DurabilityPolicy.VOLATILE)


def test_a_latched_topic_keeps_what_its_publishers_kept_together() -> None:
    unknown = LATCHED._replace(history=QosHistory.UNKNOWN, depth=0)
    assert profile(LATCHED).depth == 4
    assert profile(LATCHED, LATCHED, offer(depth=99)).depth == 8
    assert profile(unknown).depth == recorded_qos.UNKNOWN_DEPTH
    # Unless more are published than are acknowledged by then, or they are large.
    assert profile(LATCHED, per_s=1000.0).depth == 20
    assert profile(LATCHED, per_s=math.inf).depth == recorded_qos.WINDOW
    assert profile(LATCHED._replace(history=QosHistory.KEEP_ALL), message_bytes=2**20).depth == 64


def test_deadlines_leases_and_lives_are_offered_again() -> None:
    lively = offer(
        deadline=QosTime(1, 5),
        lifespan=QosTime(3, 0),
        liveliness=QosLiveliness.MANUAL_BY_TOPIC,
        liveliness_lease_duration=QosTime(2, 0),
    )
    made = profile(lively, offer(deadline=QosTime(9, 0), lifespan=QosTime(4, 0)))
    assert made.deadline == Duration(nanoseconds=S + 5)
    assert made.lifespan == Duration(seconds=4)
    assert made.liveliness == LivelinessPolicy.MANUAL_BY_TOPIC
    assert made.liveliness_lease_duration == Duration(seconds=2)
    endless = profile(offer(deadline=FOREVER, lifespan=QosTime(0, 0)), lively)
    assert endless.deadline == Duration(nanoseconds=S + 5)
    assert endless.lifespan == profile(offer()).lifespan  # one of them kept its messages for ever


def test_old_bags_tell_policies_by_number() -> None:
    topic = RecordedTopic(name="/a", type="", offered_qos=str(dump_qos_v8([LATCHED])))
    made = recorded_qos.profile(topic, message_bytes=1, per_s=1.0)
    assert (made.depth, made.durability) == (4, DurabilityPolicy.TRANSIENT_LOCAL)


@pytest.mark.parametrize("text", ["{", "- 3", "hello", "- {history: keep_last}"])
def test_qos_that_is_none_is_refused(text: str) -> None:
    topic = RecordedTopic(name="/a", type="", offered_qos=text)
    with pytest.raises(BagError, match=r"QoS of topic /a is .*expected rosbag2's YAML"):
        recorded_qos.profile(topic, message_bytes=1, per_s=1.0)


def test_nothing_is_imported_that_a_bag_names_but_messages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Python would run it."""
    (tmp_path / "evil").mkdir()
    for name in ("__init__", "msg"):
        (tmp_path / "evil" / f"{name}.py").write_text("raise SystemExit('imported')")
    monkeypatch.syspath_prepend(tmp_path)
    for type in ("evil/msg/Thing", "antigravity/msg/Thing", "os/msg/Thing"):
        with pytest.raises(NodeError, match="is not installed; expected a ROS package"):
            playback_publisher.message_class(RecordedTopic(name="/a", type=type))
    assert not {"evil", "evil.msg", "antigravity"} & set(sys.modules)
    assert playback_publisher.message_class(RecordedTopic(name="/a", type="std_msgs/msg/String")) is String
