"""PX4 on its own topics: over DDS, with a px4_msgs that ROS 2's own generators made, and a stand-in for PX4.

No PX4 has been flown here. What a stand-in cannot tell is whether it is one.
"""

import itertools
import math
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from tests.conftest import PATIENCE_S, Ros, each_once
from tests.nodes import px4_messages
from tests.nodes.conftest import SMALL
from tests.support.fake_autopilot.common import FakeProcess
from uav_dc_ros import scenarios
from uav_dc_ros.core.grid import Action
from uav_dc_ros.errors import VehicleError
from uav_dc_ros.messages import Phase
from uav_dc_ros.nodes.ros import fastdds
from uav_dc_ros.nodes.ros.executor import DirectExecutor
from uav_dc_ros.nodes.vehicles import px4
from uav_dc_ros.offboard.frames import Enu, Geodetic, Ned, to_enu
from uav_dc_ros.offboard.mission.controller import MissionController
from uav_dc_ros.offboard.mission.fault_detector import SafetySettings
from uav_dc_ros.offboard.px4 import telemetry
from uav_dc_ros.offboard.px4.telemetry import Px4Telemetry
from uav_dc_ros.offboard.setpoint_stream import STREAM_S, STREAM_TIMEOUT_S
from uav_dc_ros.offboard.vehicle import Arm, Mode, SetMode, TakeOff, Telemetry

# One worker builds the messages, once.
pytestmark = pytest.mark.xdist_group("px4")

ZURICH = Geodetic(latitude_deg=47.397742, longitude_deg=8.545594, altitude_m=488.0)
START = Ned(3.0, -2.0, 0.5)  # of the stand-in
PLACE = Enu(0.0, 0.0, 0.0)
SPEED = 30.0
NUMBERS = itertools.count()


@pytest.fixture(scope="module")
def messages(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with px4_msgs, which can be imported."""
    if px4_messages.compilers() is None:
        pytest.skip("px4_msgs is made with compilers for C and C++, and Python's headers; some are missing")
    folder = px4_messages.build(tmp_path_factory.mktemp("px4") / "messages")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_PYTHON_CHECK_FIELDS", "1")
        patch.syspath_prepend(folder)
        yield folder
    for name in [name for name in sys.modules if name.partition(".")[0] == px4_messages.PACKAGE]:
        del sys.modules[name]


@pytest.fixture
def msg(messages: Path) -> Any:
    """The module of the message classes."""
    return px4.load_messages()


@pytest.fixture(scope="module")
def domain(messages: Path, module_ros: Ros) -> Iterator[Ros]:
    """ROS in this process, in the domain of the tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        for name in fastdds.NAMES:
            patch.setenv(name, str(Path(fastdds.__file__).with_name("fastdds.xml")))
        rclpy.init(args=[], domain_id=int(module_ros.environment["ROS_DOMAIN_ID"]))
        yield module_ros
        rclpy.shutdown()


class Spun:
    """Nodes of this process, in a namespace of their own, that are spun while a test waits for something."""

    def __init__(self, namespace: str) -> None:
        self.namespace = namespace
        self.executor = DirectExecutor()
        self.nodes: list[Any] = []

    def node(self, name: str) -> Any:
        made = rclpy.create_node(name, namespace=self.namespace)
        self.nodes.append(made)
        self.executor.add_node(made)
        return made

    def until(
        self,
        done: Callable[[], object],
        beat: Callable[[], object] = lambda: None,
        seconds: float = PATIENCE_S,
    ) -> None:
        """Spin until something is so, with a beat every few milliseconds."""
        end_s = time.monotonic() + seconds
        beats_s = 0.0
        while not done():
            now_s = time.monotonic()
            assert now_s < end_s, "this never came to be"
            if now_s >= beats_s:
                beats_s = now_s + 0.004
                beat()
            self.executor.spin_once(0.004)

    def pass_time(self, seconds: float, beat: Callable[[], object] = lambda: None) -> None:
        end_s = time.monotonic() + seconds
        self.until(lambda: time.monotonic() >= end_s, beat, seconds + 5.0)


@pytest.fixture
def spun(domain: Ros) -> Iterator[Spun]:
    """See there."""
    made = Spun(f"/t{next(NUMBERS)}")
    yield made
    for node in made.nodes:
        node.destroy_node()


@pytest.fixture
def vehicle(spun: Spun) -> Iterator[px4.Px4Vehicle]:
    """The transport, on a node of its own, open."""
    made = px4.Px4Vehicle(spun.node("bridge"), start=PLACE)
    made.open()
    yield made
    made.close()


class Hand:
    """PX4's side of the topics, played by hand: what is published, a test says; what comes, is kept."""

    def __init__(self, spun: Spun, msg: Any) -> None:
        self.msg, node = msg, spun.node("hand")
        self.setpoints: list[tuple[int, Any]] = []  # with the time of their publication, ns
        self.heartbeats: list[tuple[int, Any]] = []
        self.commands: list[tuple[int, Any]] = []
        qos = QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT)
        for topic, kind, kept in (
            ("fmu/in/trajectory_setpoint", msg.TrajectorySetpoint, self.setpoints),
            ("fmu/in/offboard_control_mode", msg.OffboardControlMode, self.heartbeats),
            ("fmu/in/vehicle_command", msg.VehicleCommand, self.commands),
        ):
            node.create_subscription(kind, topic, self._keeping(kept), qos)
        self.publishers = {
            topic: node.create_publisher(
                kind,
                f"fmu/out/{topic}",
                QoSProfile(
                    depth=1,
                    reliability=ReliabilityPolicy.BEST_EFFORT,
                    durability=DurabilityPolicy.TRANSIENT_LOCAL,
                ),
            )
            for topic, kind in (
                ("vehicle_status_v1", msg.VehicleStatus),
                ("vehicle_local_position", msg.VehicleLocalPosition),
                ("vehicle_land_detected", msg.VehicleLandDetected),
                ("vehicle_command_ack", msg.VehicleCommandAck),
                ("failsafe_flags", msg.FailsafeFlags),
            )
        }

    @staticmethod
    def _keeping(kept: list[tuple[int, Any]]) -> Callable[[Any, Any], None]:
        def keep(message: Any, info: Any) -> None:
            kept.append((info["source_timestamp"], message))

        return keep

    def say(self, ned: Ned = START, **more: Any) -> None:
        """Tell how it is, and where, as PX4 does all the time."""
        self.publishers["vehicle_status_v1"].publish(status(self.msg, **more))
        self.publishers["vehicle_land_detected"].publish(self.msg.VehicleLandDetected(landed=True))
        self.publishers["vehicle_local_position"].publish(position(self.msg, ned))


@pytest.fixture
def hand(spun: Spun, msg: Any) -> Hand:
    """See there."""
    return Hand(spun, msg)


def status(msg: Any, **more: Any) -> Any:
    """A status: disarmed, in POSCTL, unless told otherwise."""
    values = {"arming_state": 1, "nav_state": 2, "system_id": 7, "component_id": 1, "system_type": 2}
    return msg.VehicleStatus(**{**values, "pre_flight_checks_pass": True, **more})


def position(msg: Any, ned: Ned, reference: Geodetic | None = None, **more: Any) -> Any:
    """A position that PX4 trusts, unless told otherwise."""
    message = msg.VehicleLocalPosition(x=ned.north_m, y=ned.east_m, z=ned.down_m)
    message.xy_valid = message.z_valid = message.v_xy_valid = message.v_z_valid = True
    if reference is not None:
        message.xy_global = message.z_global = True
        message.ref_lat, message.ref_lon = reference.latitude_deg, reference.longitude_deg
        message.ref_alt = reference.altitude_m
    for name, value in more.items():
        setattr(message, name, value)
    return message


def standing(msg: Any, ned: Ned = START, **more: Any) -> Px4Telemetry:
    """What is known of a vehicle that stands on the ground and told where."""
    telemetry = Px4Telemetry(start=more.pop("start", PLACE), **more)
    telemetry.on_vehicle_status(status(msg), 0.0)
    telemetry.update("vehicle_land_detected", msg.VehicleLandDetected(landed=True), 0.0)
    telemetry.on_vehicle_local_position(position(msg, ned), 0.0)
    return telemetry


# What it says on, and with what.


def test_without_px4_msgs_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "px4_msgs.msg", raising=False)
    monkeypatch.setitem(sys.modules, "px4_msgs", None)
    node: Any = None
    with pytest.raises(VehicleError, match="needs the ROS package px4_msgs") as told:
        px4.Px4Vehicle(node, start=PLACE)
    assert str(told.value).endswith("its workspace sourced: https://github.com/PX4/px4_msgs")
    assert "\n" not in str(told.value)


def test_px4_msgs_of_an_older_px4_are_refused(msg: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(msg, "FailsafeFlags")
    with pytest.raises(VehicleError, match=r"px4_msgs has no FailsafeFlags; expected that of PX4 1\.15"):
        px4.load_messages()


@pytest.mark.parametrize(("version", "name"), [(None, "t"), (0, "t"), (1, "t_v1"), (12, "t_v12")])
def test_a_topic_has_the_version_of_its_messages(version: int | None, name: str) -> None:
    kind = type("Kind", (), {} if version is None else {"MESSAGE_VERSION": version})
    assert px4.versioned("t", kind) == name


def test_topics_and_their_qos(vehicle: px4.Px4Vehicle, spun: Spun) -> None:
    node, space = spun.nodes[0], spun.namespace
    own = f"{space}/fmu/"
    names = {name.removeprefix(own) for name, _ in node.get_topic_names_and_types() if name.startswith(own)}
    assert names == {
        *("in/offboard_control_mode", "in/trajectory_setpoint", "in/vehicle_command"),
        *("out/vehicle_status_v1", "out/vehicle_local_position", "out/vehicle_land_detected"),
        *("out/battery_status", "out/failsafe_flags", "out/vehicle_command_ack"),
        *("out/vehicle_attitude", "out/home_position"),
    }
    for name in names:
        publishes = name.startswith("in/")
        look = node.get_publishers_info_by_topic if publishes else node.get_subscriptions_info_by_topic
        (end,) = look(own + name)
        assert end.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
        assert end.qos_profile.durability == DurabilityPolicy.VOLATILE


def test_numbers_are_those_of_the_definitions(msg: Any) -> None:
    state, command = msg.VehicleStatus, msg.VehicleCommand
    prefix = "NAVIGATION_STATE_"
    told = [
        line.split()[1::2]
        for line in px4_messages.DEFINITIONS["VehicleStatus"].splitlines()
        if prefix in line
    ]
    assert len(told) == 9
    assert {int(number): name.removeprefix(prefix) for name, number in told}.items() <= (
        telemetry.MODE_NAMES.items()
    )
    assert telemetry.MODES == {
        state.NAVIGATION_STATE_OFFBOARD: Mode.COMMANDED,
        state.NAVIGATION_STATE_AUTO_LOITER: Mode.HOLD,
        state.NAVIGATION_STATE_AUTO_RTL: Mode.RETURN,
        state.NAVIGATION_STATE_AUTO_LAND: Mode.LAND,
        state.NAVIGATION_STATE_AUTO_PRECLAND: Mode.LAND,
        state.NAVIGATION_STATE_DESCEND: Mode.LAND,
    }
    assert telemetry.ARMED == state.ARMING_STATE_ARMED
    assert (px4.RETURN, px4.LAND, px4.SET_MODE, px4.ARM) == (
        command.VEHICLE_CMD_NAV_RETURN_TO_LAUNCH,
        command.VEHICLE_CMD_NAV_LAND,
        command.VEHICLE_CMD_DO_SET_MODE,
        command.VEHICLE_CMD_COMPONENT_ARM_DISARM,
    )


# Frames: numbers worked out by hand, so that a mistake in a sign fails.


def test_where_it_is_comes_from_ned(msg: Any) -> None:
    telemetry = standing(msg, Ned(3.0, -2.0, 0.5), start=Enu(100.0, 200.0, 0.0))
    assert telemetry.snapshot().position == Enu(100.0, 200.0, 0.0)
    telemetry.on_vehicle_local_position(
        position(msg, Ned(13.0, 18.0, -29.5)), 1.0
    )  # 10 north, 20 east, 30 up
    assert telemetry.snapshot().position == Enu(120.0, 210.0, 30.0)


def test_a_setpoint_goes_out_in_ned(vehicle: px4.Px4Vehicle, spun: Spun, hand: Hand) -> None:
    goal = Enu(20.0, 10.0, 30.0)
    spun.until(lambda: len(hand.setpoints) > 3, lambda: (hand.say(), vehicle.set_setpoint(goal)))
    setpoint, heartbeat = hand.setpoints[-1][1], hand.heartbeats[-1][1]
    assert list(setpoint.position) == [13.0, 18.0, -29.5]
    assert np.isnan([setpoint.velocity, setpoint.acceleration, setpoint.jerk]).all()
    assert math.isnan(setpoint.yaw)
    assert math.isnan(setpoint.yawspeed)
    assert heartbeat == hand.msg.OffboardControlMode(position=True)
    assert (setpoint.timestamp, heartbeat.timestamp) == (0, 0)


def test_the_grid_has_a_datum_once_px4_knows_the_earth(msg: Any) -> None:
    telemetry = standing(msg)
    assert telemetry.snapshot().grid_origin == "local:2.0,-3.0,0.5"
    telemetry.on_vehicle_local_position(position(msg, START, ZURICH), 1.0)
    datum = Geodetic.parse(telemetry.snapshot().grid_origin)
    # PX4 counts from a point 3 m south and 2 m east of where the vehicle stands, half a metre above it.
    assert ZURICH.enu_from(datum) == pytest.approx((2.0, -3.0, 0.5), abs=1e-5)
    known = telemetry.snapshot().position
    assert known == pytest.approx(PLACE, abs=1e-5)
    # PX4 moves its origin 40 m to the east in flight: the same place has other numbers from then on.
    moved = ZURICH.at(Enu(40.0, 0.0, 0.0))
    telemetry.update("vehicle_land_detected", msg.VehicleLandDetected(landed=False), 2.0)
    telemetry.on_vehicle_local_position(position(msg, Ned(3.0, -42.0, 0.5), moved), 2.0)
    assert telemetry.snapshot().position == pytest.approx(PLACE, abs=1e-3)
    assert telemetry.snapshot().grid_origin == str(datum)


@pytest.mark.parametrize("reference", [None, ZURICH], ids=["local", "global"])
def test_a_bridge_that_comes_back_in_the_air_has_the_same_grid(msg: Any, reference: Geodetic | None) -> None:
    telemetry = standing(msg, start=Enu(100.0, 0.0, 0.0))
    telemetry.on_vehicle_local_position(position(msg, START, reference), 1.0)
    again = Px4Telemetry(start=Enu(100.0, 0.0, 0.0), grid_origin=telemetry.snapshot().grid_origin)
    for each in (telemetry, again):
        each.on_vehicle_status(status(msg, arming_state=2, nav_state=14), 2.0)
        each.update("vehicle_land_detected", msg.VehicleLandDetected(landed=False), 2.0)
        each.on_vehicle_local_position(position(msg, Ned(50.0, 60.0, -70.0), reference), 2.0)
    assert again.snapshot().missing is None
    assert again.snapshot().position == pytest.approx((162.0, 47.0, 70.5), abs=0.01)
    assert again.snapshot().position == pytest.approx(telemetry.snapshot().position, abs=1e-6)


@pytest.mark.parametrize("grid_origin", ["local:", "local:1,2", "local:1,2,nan", "local:a,b,c", "47,8"])
def test_an_invalid_grid_origin(grid_origin: str) -> None:
    with pytest.raises(VehicleError, match="expected"):
        Px4Telemetry(start=PLACE, grid_origin=grid_origin)


def test_the_scenario_s_datum_has_the_altitude_of_the_ground(msg: Any) -> None:
    corner = ZURICH.at(Enu(-5.0, -7.0, 0.0))
    telemetry = standing(msg, datum_deg=corner[:2])
    assert telemetry.snapshot().position is None, "not where the scenario starts"
    assert "with a global position" in str(telemetry.snapshot().missing)
    telemetry.on_vehicle_local_position(position(msg, START, ZURICH), 1.0)
    north_m, east_m, down_m = START
    datum, place = telemetry.datum, telemetry.snapshot().position
    assert datum == pytest.approx((*corner[:2], ZURICH.altitude_m - down_m), abs=1e-3)
    assert place == pytest.approx((5.0 + east_m, 7.0 + north_m, 0.0), abs=1e-3)


def test_a_grid_with_a_datum_needs_a_px4_that_knows_the_earth(msg: Any) -> None:
    telemetry = standing(msg, datum=ZURICH.at(Enu(-5.0, -7.0, 0.0)))
    assert telemetry.snapshot().position is None
    assert "has no global position" in str(telemetry.snapshot().missing)
    telemetry.on_vehicle_local_position(position(msg, START, ZURICH), 1.0)
    assert telemetry.snapshot().position == pytest.approx((5.0 - 2.0, 7.0 + 3.0, -0.5), abs=1e-3)
    assert telemetry.snapshot().missing is None


# The stream.


def gaps_s(messages: list[tuple[int, Any]]) -> Any:
    """Times between messages, seconds, as they were published."""
    return np.diff([time_ns for time_ns, _ in messages]) / 1e9


def test_the_stream_keeps_its_pace(vehicle: px4.Px4Vehicle, spun: Spun, hand: Hand) -> None:
    """While positions come at 50 Hz, and the node's own thread is held up now and then."""
    goal = Enu(0.0, 0.0, 50.0)

    def beat() -> None:
        hand.say()
        vehicle.set_setpoint(goal)
        spun.pass_time(0.02)

    spun.until(lambda: len(hand.setpoints) > 3, beat)
    hand.heartbeats.clear()
    for i in range(75):
        beat()
        if i % 25 == 24:
            time.sleep(0.3)  # a callback that takes its time
    gaps = gaps_s(hand.heartbeats)
    print(f"late by, ms: p50 {1e3 * np.quantile(abs(gaps - STREAM_S), 0.5):.2f}", end=", ")
    print(f"p99 {1e3 * np.quantile(abs(gaps - STREAM_S), 0.99):.2f}, of {len(gaps)}")
    assert np.mean(gaps) == pytest.approx(STREAM_S, rel=0.15)
    assert np.median(abs(gaps - STREAM_S)) < 0.01
    assert max(gaps) < 0.5, "PX4 wants more than 2 Hz"


def test_the_stream_ends_a_second_after_those_who_decide(
    vehicle: px4.Px4Vehicle, spun: Spun, hand: Hand
) -> None:
    goal = Enu(0.0, 0.0, 50.0)
    spun.until(lambda: len(hand.setpoints) > 3, lambda: (hand.say(), vehicle.set_setpoint(goal)))
    vehicle.set_setpoint(goal)
    last_ns = time.time_ns()
    spun.pass_time(3.5, hand.say)
    for heard in (hand.heartbeats, hand.setpoints):  # best effort: the last ones may be lost on their way
        assert 0.5 * STREAM_TIMEOUT_S <= (heard[-1][0] - last_ns) / 1e9 <= STREAM_TIMEOUT_S + 0.2
    before = len(hand.heartbeats)
    spun.until(lambda: len(hand.heartbeats) > before, lambda: (hand.say(), vehicle.set_setpoint(goal)))


@pytest.mark.parametrize("gone", ["silence", "xy_valid"])
def test_the_stream_ends_half_a_second_after_the_last_good_position(
    vehicle: px4.Px4Vehicle, spun: Spun, hand: Hand, gone: str
) -> None:
    goal = Enu(0.0, 0.0, 50.0)

    def set_setpoint() -> None:
        vehicle.set_setpoint(goal)
        if gone != "silence":
            bad = position(hand.msg, START, **{gone: False})
            hand.publishers["vehicle_local_position"].publish(bad)

    spun.until(lambda: len(hand.setpoints) > 3, lambda: (hand.say(), vehicle.set_setpoint(goal)))
    last_ns = time.time_ns()
    spun.pass_time(2.5, set_setpoint)
    silent_s = (hand.heartbeats[-1][0] - last_ns) / 1e9
    assert px4.POSE_TIMEOUT_S - 0.2 <= silent_s <= px4.POSE_TIMEOUT_S + 1.5
    assert vehicle.telemetry().estimate_ok is (gone == "silence")
    before = len(hand.heartbeats)
    spun.until(lambda: len(hand.heartbeats) > before, lambda: (hand.say(), vehicle.set_setpoint(goal)))


@pytest.mark.parametrize(
    "bad",
    [
        *({name: False} for name in ("xy_valid", "z_valid", "v_xy_valid", "v_z_valid")),
        *({"dead_reckoning": True}, {"x": math.nan}, {"z": math.inf}),
    ],
    ids=str,
)
def test_a_position_that_px4_does_not_trust_is_none(msg: Any, bad: dict[str, Any]) -> None:
    telemetry = standing(msg)
    assert (telemetry.snapshot().estimate_ok, telemetry.position_s) == (True, 0.0)
    telemetry.on_vehicle_local_position(position(msg, Ned(9.0, 9.0, 9.0), **bad), 1.0)
    known = telemetry.snapshot()
    assert (known.estimate_ok, known.position, known.position_s) == (False, PLACE, 0.0)
    never = Px4Telemetry(start=PLACE)
    never.on_vehicle_status(status(msg), 0.0)
    never.on_vehicle_local_position(position(msg, START, **bad), 1.0)
    assert never.snapshot().missing == "PX4 has no estimate of its position yet"


def test_no_setpoint_no_stream(vehicle: px4.Px4Vehicle, spun: Spun, hand: Hand) -> None:
    spun.until(
        lambda: len(hand.setpoints) > 3, lambda: (hand.say(), vehicle.set_setpoint(Enu(0.0, 0.0, 50.0)))
    )
    vehicle.set_setpoint(None)
    spun.pass_time(0.1, hand.say)
    before = len(hand.heartbeats), len(hand.setpoints)
    spun.pass_time(0.4, lambda: (hand.say(), vehicle.set_setpoint(None)))
    assert (len(hand.heartbeats), len(hand.setpoints)) == before
    vehicle.close()
    vehicle.close()


def test_another_bridge_is_seen(vehicle: px4.Px4Vehicle, spun: Spun, hand: Hand, msg: Any) -> None:
    spun.until(lambda: vehicle.telemetry().autopilot == "PX4", hand.say)
    assert vehicle.telemetry().other_controller is None
    topic = f"{spun.namespace}/fmu/in/trajectory_setpoint"
    other = spun.node("other").create_publisher(msg.TrajectorySetpoint, topic, 1)
    expected = f"2 nodes publish {topic}; expected one bridge only"
    spun.until(lambda: vehicle.telemetry().other_controller == expected, hand.say)
    assert other is not None


def test_a_stream_that_broke_is_not_believed_to_live(vehicle: px4.Px4Vehicle, spun: Spun, hand: Hand) -> None:
    def broken(message: Any) -> None:
        raise RuntimeError("no such publisher")

    spun.until(lambda: vehicle.telemetry().missing is None, hand.say)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(vehicle._publishers["trajectory_setpoint"], "publish", broken)
        with pytest.raises(RuntimeError, match="no such publisher"):
            spun.pass_time(20.0, lambda: (hand.say(), vehicle.set_setpoint(Enu(0.0, 0.0, 50.0))))


def test_a_vehicle_whose_time_is_faster_gets_more_of_it(
    vehicle: px4.Px4Vehicle, spun: Spun, hand: Hand
) -> None:
    stamps = iter(range(1, 10**9, 200_000))  # 0.2 s each, every 20 ms: a simulation that is ten times faster

    def say() -> None:
        hand.say()
        where = position(hand.msg, START, timestamp=next(stamps))
        hand.publishers["vehicle_local_position"].publish(where)
        vehicle.set_setpoint(Enu(0.0, 0.0, 50.0))
        spun.pass_time(0.02)

    spun.until(lambda: len(hand.setpoints) > 3, say)
    vehicle_s = vehicle.telemetry().vehicle_s
    hand.heartbeats.clear()
    for _ in range(50):
        say()
    assert vehicle.telemetry().vehicle_s - vehicle_s == pytest.approx(10.0, abs=0.5)
    assert len(hand.heartbeats) > 2 * 20, "more than the clock alone would have brought"


# Commands and answers.


def test_wishes_as_commands(vehicle: px4.Px4Vehicle, spun: Spun, hand: Hand) -> None:
    for command in (Arm(), SetMode(Mode.LAND)):
        vehicle.send_command(command)  # nobody is there yet: to be forgotten, not kept
    spun.until(lambda: vehicle.telemetry().autopilot == "PX4", hand.say)
    assert hand.commands == []
    commands = [SetMode(mode) for mode in (Mode.COMMANDED, Mode.HOLD, Mode.RETURN, Mode.LAND)]
    for command in [*commands, TakeOff(50.0), Arm()]:
        vehicle.send_command(command)
    spun.until(lambda: len(hand.commands) == 5)
    said = [message for _, message in hand.commands]
    assert [(each.command, each.param1, each.param2, each.param3) for each in said] == [
        *((176, 1.0, 6.0, 0.0), (176, 1.0, 4.0, 3.0), (20, 0.0, 0.0, 0.0), (21, 0.0, 0.0, 0.0)),
        (400, 1.0, 0.0, 0.0),
    ]
    assert all(
        math.isnan(value) for value in (said[3].param4, said[3].param5, said[3].param6, said[3].param7)
    )
    for each in said:
        assert (each.target_system, each.target_component, each.source_system) == (7, 1, 7)
        assert (each.source_component, each.from_external, each.timestamp) == (191, True, 0)


def test_a_refusal_is_told_until_it_is_granted(msg: Any) -> None:
    telemetry = standing(msg)

    def answer(result: int, command: int = 400, component: int = 191, system: int = 7) -> str | None:
        message = msg.VehicleCommandAck(command=command, result=result)
        message.target_system, message.target_component = system, component
        telemetry.on_vehicle_command_ack(message, 1.0)
        return telemetry.snapshot().refusal

    assert answer(1, component=190) is None, "somebody else was refused"
    assert answer(1, system=255) is None, "likewise"
    assert answer(5) is None, "it is being done"
    assert answer(1, command=511) is None, "never asked"
    assert answer(1) == "arming refused: temporarily rejected"
    telemetry.update("failsafe_flags", msg.FailsafeFlags(home_position_invalid=True), 1.0)
    telemetry.on_vehicle_status(status(msg, pre_flight_checks_pass=False), 1.0)
    why = "(home position invalid, its preflight checks fail)"
    assert answer(77, 176) == f"the change of mode refused: result 77 {why}"
    assert answer(0, 176) == f"arming refused: temporarily rejected {why}"
    telemetry.on_vehicle_status(status(msg, arming_state=2), 1.0)
    assert telemetry.snapshot().refusal is None


# What is known.


def test_modes_and_failsafe(msg: Any) -> None:
    telemetry = Px4Telemetry(start=PLACE)
    assert telemetry.snapshot() == Telemetry(missing="PX4 has no estimate of its position yet")
    for state, failsafe, mode, name in (
        (14, False, Mode.COMMANDED, "OFFBOARD"),
        (5, True, Mode.RETURN, "AUTO_RTL (failsafe)"),
        (17, False, Mode.OTHER, "AUTO_TAKEOFF"),
        (23, False, Mode.OTHER, "nav_state 23"),
    ):
        telemetry.on_vehicle_status(status(msg, nav_state=state, failsafe=failsafe), 3.0)
        known = telemetry.snapshot()
        assert (known.mode, known.mode_name, known.heartbeat_s) == (mode, name, 3.0)
    telemetry.on_vehicle_status(status(msg, system_type=1), 4.0)
    assert telemetry.snapshot().missing == "PX4 has a vehicle of type 1; expected a multicopter"


def test_the_emptiest_battery_counts(msg: Any) -> None:
    telemetry = Px4Telemetry(start=PLACE)
    for number, connected, remaining, told in (
        (1, True, 0.75, 0.75),
        (2, True, 0.5, 0.5),
        (3, True, -1.0, 0.5),  # not known
        (2, False, 0.5, 0.75),
    ):
        message = msg.BatteryStatus(id=number, connected=connected, remaining=remaining)
        telemetry.on_battery_status(message, 0.0)
        assert telemetry.snapshot().battery == told


def test_a_battery_tells_its_voltage_and_what_px4_thinks_of_it(msg: Any) -> None:
    telemetry = Px4Telemetry(start=PLACE)
    assert (telemetry.snapshot().battery_v, telemetry.snapshot().battery_fails) == (None, False)
    for warning, fails in ((0, False), (1, True), (3, True)):
        message = msg.BatteryStatus(id=1, connected=True, remaining=0.75, voltage_v=9.0, warning=warning)
        telemetry.update("battery_status", message, 0.0)
        known = telemetry.snapshot()
        assert (known.battery, known.battery_v, known.battery_fails) == (0.75, 9.0, fails)


def test_when_it_last_said_whether_it_trusts_its_position_is_told(msg: Any) -> None:
    telemetry = standing(msg)
    assert telemetry.snapshot().estimate_s == 0.0
    telemetry.update("vehicle_local_position", position(msg, START, xy_valid=False), 1.0)
    telemetry.update("vehicle_status", status(msg), 2.0)
    known = telemetry.snapshot()
    assert (known.estimate_ok, known.estimate_s, known.position_s) == (False, 1.0, 0.0)


def test_home_and_tilt_are_told(msg: Any) -> None:
    telemetry = standing(msg)
    assert (telemetry.snapshot().home, telemetry.snapshot().tilt_rad) == (None, None)
    telemetry.update("home_position", msg.HomePosition(x=3.0, y=8.0, z=0.5, valid_lpos=True), 1.0)
    telemetry.update("vehicle_attitude", msg.VehicleAttitude(q=[0.0, 1.0, 0.0, 0.0]), 1.0)
    known = telemetry.snapshot()
    assert known.home == pytest.approx((PLACE.east_m + 10.0, PLACE.north_m, PLACE.up_m))
    assert known.tilt_rad == pytest.approx(math.pi), "on its back"
    assert known.system == "system 7"


def test_what_is_late_repeated_unstamped_or_of_another_vehicle_is_counted_and_ignored(msg: Any) -> None:
    telemetry = standing(msg)

    def hear(name: str, message: Any, stamp_s: float, now_s: float) -> Telemetry:
        message.timestamp = round(stamp_s * 1e6)
        telemetry.update(name, message, now_s)
        return telemetry.snapshot()

    offboard = status(msg, arming_state=2, nav_state=14)
    at = [position(msg, Ned(START.north_m + m, START.east_m, START.down_m)) for m in (0.0, 1.0, 2.0, 400.0)]
    hear("vehicle_status", offboard, 100.0, 1.0)
    hear("vehicle_local_position", at[1], 100.0, 1.0)
    for stamp_s, now_s, message in (
        *((98.5, 1.1, at[0]), (0.0, 1.2, at[0]), (100.0, 1.3, at[3]), (9e6, 1.4, at[3])),
    ):
        known = hear("vehicle_local_position", message, stamp_s, now_s)
        assert (known.position, known.position_s) == (pytest.approx((0.0, 1.0, 0.0)), 1.0)
    assert hear("vehicle_local_position", at[2], 100.5, 1.5).position_s == 1.5
    for stamp_s, message in ((98.5, status(msg)), (101.0, status(msg, system_id=8))):
        known = hear("vehicle_status", message, stamp_s, 1.5)
        assert (known.mode, known.armed) == (Mode.COMMANDED, True)
    assert known.discarded == {
        "late": 2,
        "zeroed": 1,
        "repeated": 1,
        "impossible": 1,
        "of another system": 1,
    }
    assert hear("vehicle_local_position", at[1], 3.0, 2.6).position_s == 2.6, "it has booted anew"


def test_time_goes_on_whatever_clock_the_stamps_are_of(msg: Any) -> None:
    telemetry = Px4Telemetry(start=PLACE)
    agent_us = 1_700_000_000_000_000
    passed = []
    for stamp_us in (
        *(60_000_000, 61_000_000, 60_999_000, 62_000_000),  # since boot; one was overtaken
        *(agent_us, 0, agent_us + 1_000_000),  # of the agent's clock; one without a stamp
        *(agent_us - 3_600_000_000, agent_us - 3_599_000_000),  # which somebody has set
        *(1, 500_001),  # booted anew
    ):
        telemetry.on_vehicle_status(status(msg, timestamp=stamp_us), 0.0)
        passed.append(round(telemetry.vehicle_s, 6))
    assert passed == [0.0, 1.0, 1.0, 2.0, 2.0, 2.0, 3.0, 3.0, 4.0, 4.0, 4.5]


def test_in_the_air_without_a_datum_nobody_knows_where_the_grid_is(msg: Any) -> None:
    for landed in (None, False):  # PX4 1.15 may not tell: then it stands as long as it is disarmed
        telemetry = Px4Telemetry(start=PLACE)
        telemetry.on_vehicle_status(status(msg, arming_state=2, nav_state=14), 0.0)
        if landed is not None:
            telemetry.update("vehicle_land_detected", msg.VehicleLandDetected(landed=landed), 0.0)
        telemetry.on_vehicle_local_position(position(msg, START), 0.0)
        assert "expected a datum" in str(telemetry.snapshot().missing)
    telemetry = Px4Telemetry(start=PLACE)
    telemetry.on_vehicle_status(status(msg), 0.0)
    telemetry.on_vehicle_local_position(position(msg, START), 0.0)
    assert (telemetry.snapshot().missing, telemetry.snapshot().position) == (None, PLACE)


def test_px4_msgs_of_another_release_are_named(vehicle: px4.Px4Vehicle, spun: Spun, msg: Any) -> None:
    assert vehicle.telemetry().missing == (
        "nothing received on fmu/out/vehicle_status_v1, fmu/out/vehicle_local_position yet"
    )
    spun.nodes[0].create_publisher(msg.VehicleStatus, "fmu/out/vehicle_status", 1)
    spun.until(lambda: "but" in str(vehicle.telemetry().missing))
    assert str(vehicle.telemetry().missing).endswith(
        f"yet, but {spun.namespace}/fmu/out/vehicle_status exists; expected px4_msgs of PX4's release"
    )


# Flights, with the stand-in for PX4.


class Fake(FakeProcess):
    """The stand-in, a process; its commands are those of `Px4.obey`."""

    def __init__(self, ros: Ros, messages: Path, namespace: str) -> None:
        super().__init__(ros.stranger("px4", messages, SPEED, namespace, folder="support/fake_autopilot"))


class Flight:
    """A flight, tick by tick, as the bridge's node does it."""

    def __init__(self, spun: Spun, fake: Fake, folder: Path) -> None:
        self.spun, self.fake = spun, fake
        path = folder / "short.toml"
        path.write_text(SMALL.replace("max_steps = 30", "max_steps = 6"))
        self.log: list[tuple[Phase, int, str]] = []
        self.cells: list[tuple[int, int, int]] = []
        scenario = scenarios.load(path)
        self.place = Enu(*scenario.mission.start_m[:2], 0.0)
        self.bridge = MissionController(scenario, SafetySettings(arm=True), self.note)
        self.vehicle = px4.Px4Vehicle(spun.node("bridge"), start=self.place)
        self.vehicle.open()

    def note(self) -> None:
        bridge = self.bridge
        if bridge.phase is Phase.MOVING and self.log[-1][0] is not Phase.MOVING:
            self.cells.append(bridge.progress.goal)
        told = bridge.phase, bridge.step, bridge.reason
        if told not in self.log[-1:]:  # what is to be kept may change without
            self.log.append(told)

    def tick(self) -> None:
        bridge, vehicle = self.bridge, self.vehicle
        for command in bridge.tick(time.monotonic(), vehicle.telemetry()):
            vehicle.send_command(command)
        if bridge.phase is Phase.READY and bridge.fault is None:
            x, y, _ = bridge.cell
            action = Action.RIGHT if x < 2 else Action.FORWARD if y < 2 else Action.HOVER
            assert bridge.move(bridge.step, action) is None
        vehicle.set_setpoint(bridge.setpoint)

    def until(self, done: Callable[[], object], seconds: float = PATIENCE_S) -> None:
        """Fly until something is so."""
        try:
            self.spun.until(done, self.tick, seconds)
        except AssertionError as error:
            raise AssertionError(f"{self.log[-6:]} {self.fake.events[-6:]}") from error

    def do(self, line: str) -> None:
        """Have the stand-in do something, and fly on until it has."""
        before = len(self.fake.all("obeyed"))
        self.fake.write(line)
        self.until(lambda: len(self.fake.all("obeyed")) > before)

    def finish(self) -> None:
        """Fly until the mission is over, and all that the stand-in told of it has come."""
        self.until(lambda: self.bridge.is_over)
        self.do(f"speed {SPEED}")

    def grid(self, ned: list[float]) -> Enu:
        """Where a position of the stand-in's lies in the grid."""
        return Enu(*(p + h - s for p, h, s in zip(self.place, to_enu(Ned(*ned)), to_enu(START), strict=True)))


@pytest.fixture
def flight(spun: Spun, messages: Path, domain: Ros, tmp_path: Path) -> Iterator[Flight]:
    """See there."""
    fake = Fake(domain, messages, spun.namespace)
    made = Flight(spun, fake, tmp_path)
    yield made
    made.vehicle.close()
    fake.close()
    assert fake.all("odd") == []
    for told in fake.all("setpoint"):
        assert made.bridge.fence.breach(made.grid(told["ned"])) is None, told


def test_a_whole_mission(flight: Flight) -> None:
    flight.finish()
    assert flight.bridge.phase is Phase.LANDED, flight.log[-3:]
    assert list(dict.fromkeys(phase for phase, _, _ in flight.log)) == [
        *(Phase.CONNECTING, Phase.PREFLIGHT, Phase.TAKEOFF, Phase.READY, Phase.MOVING),
        *(Phase.LANDING, Phase.LANDED),
    ]
    assert flight.cells == [(1, 0, 0), (2, 0, 0), (2, 1, 0), *[(2, 2, 0)] * 3]
    # Where it was sent: up, then east, then north, as PX4 counts.
    sent = each_once([np.round(told["ned"], 1).tolist() for told in flight.fake.all("setpoint")])
    n, e, d = START
    expected = [(n, e, d), (n, e, d - 100), (n, e + 100, d - 100), (n, e + 200, d - 100)]
    expected += [(n + 100, e + 200, d - 100), (n + 200, e + 200, d - 100)]
    assert sent == [list(ned) for ned in expected]
    (landed,) = flight.fake.all("landed")
    assert math.dist(flight.grid(landed["ned"])[:2], (200.0, 200.0)) <= flight.bridge.settings.tolerance_m
    offboard, landing = [told["mode"] for told in flight.fake.all("mode")]
    assert (offboard, landing) == (14, 18)
    known = flight.vehicle.telemetry()
    assert (known.armed, known.on_ground, known.battery) == (False, True, pytest.approx(0.9))


def test_a_pilot_who_takes_over_has_it_at_once(flight: Flight) -> None:
    flight.until(lambda: flight.bridge.step == 2)
    flight.do("mode 2")
    flight.finish()
    assert flight.log[-1][0] is Phase.ABORTED
    assert flight.log[-1][2].startswith("mode POSCTL: changed by a pilot")
    flight.spun.pass_time(0.3, flight.tick)  # what was on its way
    before = [told for told in flight.fake.events if told["event"] in ("command", "setpoint")]
    flight.spun.pass_time(0.5, flight.tick)
    assert [told for told in flight.fake.events if told["event"] in ("command", "setpoint")] == before
    assert flight.fake.all("mode")[-1]["why"] == "pilot"


def test_when_nobody_decides_any_more_px4_takes_it_home(flight: Flight) -> None:
    flight.until(lambda: flight.bridge.step == 2)
    before_s = time.monotonic()
    flight.spun.until(lambda: flight.fake.all("mode")[-1]["mode"] == 5)
    assert time.monotonic() - before_s + 0.2 >= STREAM_TIMEOUT_S
    assert flight.fake.all("mode")[-1]["why"] == "failsafe"
    flight.finish()
    phase, _, why = flight.log[-1]
    changed = "changed by a pilot or by the autopilot's failsafe"
    # A busy machine may bring the bridge a late position beside the new mode: "(after: no position ...)".
    assert (phase, why.partition(" (after: ")[0]) == (Phase.ABORTED, f"mode AUTO_RTL (failsafe): {changed}")


@pytest.mark.parametrize(
    ("fault", "reason", "mode"),
    [
        ("freeze 1", "no position for 0.5 s", "AUTO_RTL"),
        ("lose 1", "the autopilot has lost its position estimate", "DESCEND"),
    ],
    ids=["freeze", "lose"],
)
def test_without_a_position_it_holds_until_px4_gives_up(
    flight: Flight, fault: str, reason: str, mode: str
) -> None:
    flight.until(lambda: flight.bridge.step == 2)
    flight.do("speed 0.5")  # so that it is plain who is the first
    flight.spun.pass_time(0.5, flight.tick)  # at that speed a position that came late is no jump
    flight.do(fault)
    flight.until(lambda: flight.bridge.phase is Phase.LANDING)
    (phase, step, why), (_, _, end) = flight.log[-2:]
    assert (phase.is_over, why) == (False, reason)
    assert end.startswith(
        f"mode {mode} (failsafe): changed by a pilot or by the autopilot's failsafe (after: {reason}"
    )
    flight.do(f"speed {SPEED}")
    flight.finish()
    assert flight.log[-1] == (Phase.ABORTED, step, end)
    assert flight.fake.all("mode")[-1]["why"] == "failsafe"


def test_a_bridge_that_is_started_again_in_the_air_goes_on(flight: Flight) -> None:
    flight.until(lambda: flight.bridge.step == 2)
    flight.do("speed 0.1")  # PX4 waits a second of its time, and no more
    standing, place = flight.bridge.checkpoint, Enu(7.0, 7.0, 7.0)
    grid_origin = flight.vehicle.telemetry().grid_origin
    flight.vehicle.close()
    flight.bridge = MissionController(flight.bridge.scenario, flight.bridge.settings, flight.note, standing)
    flight.vehicle = px4.Px4Vehicle(flight.spun.nodes[0], start=place, grid_origin=grid_origin)
    opened_s = time.monotonic()
    flight.vehicle.open()
    flight.until(lambda: flight.bridge.phase is not Phase.CONNECTING)
    while flight.fake.all("obeyed")[-1]["streamed_wall_s"] < opened_s:
        flight.do("speed 0.1")  # until PX4 has found the new publishers
    flight.do(f"speed {SPEED}")
    flight.finish()
    assert flight.bridge.phase is Phase.LANDED, flight.log[-3:]
    assert flight.cells == [(1, 0, 0), (2, 0, 0), (2, 1, 0), *[(2, 2, 0)] * 3]
    assert [told["mode"] for told in flight.fake.all("mode")] == [14, 18]
    (landed,) = flight.fake.all("landed")
    assert math.dist(flight.grid(landed["ned"])[:2], (200.0, 200.0)) <= flight.bridge.settings.tolerance_m


def test_a_vehicle_that_refuses_is_not_flown_and_says_why(flight: Flight) -> None:
    flight.do("refuse 1")
    flight.until(lambda: any("refused" in reason for _, _, reason in flight.log))
    phase, step, reason = flight.log[-1]
    assert (phase, step) == (Phase.PREFLIGHT, 0)
    assert reason.startswith("the change of mode refused: temporarily rejected")
    flight.do("refuse 0")
    flight.until(lambda: flight.bridge.phase is Phase.TAKEOFF)
    assert flight.fake.all("mode")[0]["mode"] == 14
