"""The MAVROS transport, with standard messages over DDS: a fake MAVROS in a process of its own."""

import contextlib
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped

from tests.conftest import PATIENCE_S, Ros
from tests.support.fake_autopilot.mavros_flight import START, Fake, Flight, fake, mavros_of, node_in, spin
from uav_dc_ros.errors import VehicleError
from uav_dc_ros.messages import Phase
from uav_dc_ros.nodes.ros.executor import DirectExecutor
from uav_dc_ros.nodes.vehicles.mavros import MavrosVehicle
from uav_dc_ros.offboard.frames import Enu
from uav_dc_ros.offboard.mission.fault_detector import SafetySettings
from uav_dc_ros.offboard.mission.geofence import Geofence
from uav_dc_ros.offboard.setpoint_stream import STREAM_TIMEOUT_S
from uav_dc_ros.offboard.vehicle import Telemetry

STANDS = "-7,11,3"  # where the copter stands in MAVROS's frame: east, north, up
ORIGIN = Enu(27.0, -11.0, -3.0)  # of that frame, in the grid's


def until(
    executor: DirectExecutor,
    vehicle: MavrosVehicle,
    right: Callable[[Telemetry], bool],
    seconds: float = PATIENCE_S,
) -> Telemetry:
    """Hear until something is so."""
    end = time.monotonic() + seconds
    while not right(known := vehicle.telemetry()):
        assert time.monotonic() < end, known
        spin(executor, 0.01)
    return known


def check_setpoints(mavros: Fake, fence: Geofence, yaw_deg: float) -> None:
    """All that was heard lay in the fence, in the frame `map`, and turned nobody round."""
    heard = mavros.all("setpoint")
    assert heard
    for setpoint in heard:
        grid = Enu(*(p + o for p, o in zip(setpoint["enu"], ORIGIN, strict=True)))
        assert fence.breach(grid) is None, setpoint
        assert (setpoint["frame"], setpoint["yaw_deg"]) == ("map", pytest.approx(yaw_deg, abs=0.01))


def test_px4_flies_a_mission_that_a_pilot_starts_and_lands(ros: Ros) -> None:
    how = ("--speed", "5", "--stands=" + STANDS, "--yaw", "35")
    with (
        fake(ros, "px4", *how) as mavros,
        node_in(ros) as (node, executor),
        mavros_of(node) as vehicle,
    ):
        flight = Flight(executor, vehicle, mavros, SafetySettings())
        bridge = flight.bridge
        flight.until(lambda: bridge.phase is Phase.PREFLIGHT)
        assert vehicle.telemetry().autopilot == "PX4"
        assert vehicle.telemetry().grid_origin == "27.0,-11.0,-3.0"
        mavros.do("param COM_OF_LOSS_T 100")  # on a busy machine the stream has gaps, at five times its speed
        mavros.do("arm")
        flight.until(lambda: bridge.reason == "a pilot flies: mode POSCTL")
        flight.pilot_sets("OFFBOARD")
        flight.until(lambda: bridge.phase is Phase.LANDING)
        assert flight.cells == [(2, 0, 0), (2, 1, 0), (2, 1, 0)]
        assert mavros.report()["enu"] == pytest.approx((13.0, 31.0, 13.0), abs=2.0), "the dock, in its frame"
        flight.until(lambda: vehicle.telemetry().refusal is not None)
        assert "a pilot has to set AUTO.LAND" in str(vehicle.telemetry().refusal)
        mavros.do("mode AUTO.LAND")
        flight.until(lambda: bridge.is_over)
        assert bridge.phase is Phase.LANDED
        report = mavros.report()
        assert (report["landed"], report["armed"]) == (True, False)
        check_setpoints(mavros, bridge.fence, yaw_deg=35.0)


def test_ardupilot_is_taken_off_by_a_pilot_resumed_after_a_restart_and_taken_over(ros: Ros) -> None:
    how = ("--speed", "5", "--stands=" + STANDS)
    with (
        fake(ros, "ardupilot", *how) as mavros,
        node_in(ros) as (node, executor),
        mavros_of(node) as vehicle,
    ):
        flight = Flight(executor, vehicle, mavros, SafetySettings())
        flight.until(lambda: flight.bridge.phase is Phase.PREFLIGHT)
        mavros.do("arm")
        for _ in range(5):
            flight.tick()
        assert not mavros.all("setpoint"), "on the ground no setpoint would help"
        mavros.do("mode GUIDED")
        mavros.do("takeoff 10")
        flight.until(lambda: flight.bridge.phase is Phase.MOVING)
        assert flight.bridge.step == 0
        standing, grid_origin = flight.bridge.checkpoint, vehicle.telemetry().grid_origin
        vehicle.close()

        with mavros_of(node, grid_origin=grid_origin) as after:
            resumed = Flight(executor, after, mavros, SafetySettings(), checkpoint=standing)
            resumed.until(lambda: resumed.bridge.phase is Phase.MOVING)
            assert after.telemetry().grid_origin == grid_origin
            assert Phase.PREFLIGHT not in [phase for phase, _, _ in resumed.log]
            assert (flight.executed, resumed.executed) == ([0], [1]), "no step twice, none left out"
            assert (flight.cells, resumed.cells) == ([(2, 0, 0)], [(2, 1, 0)])
            mavros.do("mode LOITER")
            resumed.until(lambda: resumed.bridge.is_over)
            phase, step, reason = resumed.log[-1]
            assert (phase, step) == (Phase.ABORTED, 1)
            assert "mode LOITER" in reason
            spin(executor, 0.3)
            before = mavros.report()["setpoints"]
            spin(executor, 0.3)
            assert mavros.report()["setpoints"] == before
            check_setpoints(mavros, resumed.bridge.fence, yaw_deg=90.0)


@pytest.fixture(scope="module")
def standing(module_ros: Ros) -> Iterator[Fake]:
    """A PX4 that stands on the ground; whoever breaks something mends it."""
    with fake(module_ros, "px4", "--stands=" + STANDS, "--beat-s", "0.5") as mavros:
        yield mavros


def test_what_goes_wrong_is_seen(module_ros: Ros, standing: Fake) -> None:
    mavros = standing
    with node_in(module_ros) as (node, executor), mavros_of(node) as vehicle:
        mavros.do("frame odom")
        until(executor, vehicle, lambda known: "frame 'odom'; expected 'map'" in str(known.missing))
        mavros.do("frame map")
        until(executor, vehicle, lambda known: known.missing is None)

        def age(known: Telemetry) -> float:
            return time.monotonic() - (known.position_s or 0.0)

        for fault in ("frozen", "again"):
            mavros.do(f"{fault} 1")
            before = until(executor, vehicle, lambda known: age(known) > 0.6)
            later = until(executor, vehicle, lambda known: age(known) > 1.0)
            assert later.position == before.position
            assert later.vehicle_s > before.vehicle_s, "the vehicle's time does not stand still with it"
            mavros.do(f"{fault} 0")
            until(executor, vehicle, lambda known: age(known) < 0.1)
        time.sleep(0.2)  # poses come, and wait for the executor
        mavros.do("frozen 1")
        time.sleep(0.5)  # the last one does not become younger by that
        spin(executor, 0.05)
        assert age(vehicle.telemetry()) > 0.45
        mavros.do("frozen 0")
        mavros.do("battery 0.15")
        until(executor, vehicle, lambda known: known.battery == pytest.approx(0.15))
        mavros.do("estimate_lost 1")
        until(executor, vehicle, lambda known: not known.estimate_ok)
        mavros.do("estimate_lost 0")
        until(executor, vehicle, lambda known: known.estimate_ok)
        mavros.do("link_lost 1")
        # Poses alone are no heartbeat.
        silent = lambda known: time.monotonic() - (known.heartbeat_s or 0.0) > 1.5  # noqa: E731
        until(executor, vehicle, lambda known: silent(known) and age(known) < 0.5)
        mavros.do("link_lost 0")


def test_the_stream_is_20_hz_without_the_executor_and_ends_a_second_after_the_last_word(
    module_ros: Ros, standing: Fake
) -> None:
    mavros = standing
    with node_in(module_ros) as (node, executor), mavros_of(node) as vehicle:
        until(executor, vehicle, lambda known: known.missing is None)
        mavros.do("times")
        target = Enu(20.0, 5.0, 10.0)
        began_s = time.monotonic()
        while time.monotonic() - began_s < 2.0:  # the executor stands still
            vehicle.set_setpoint(target)
            last_s = time.monotonic()
            time.sleep(0.5)
        time.sleep(STREAM_TIMEOUT_S + 3.0)
        times = np.array(mavros.report()["times"])
        # As the other process heard it; on a busy machine it hears late.
        assert STREAM_TIMEOUT_S - 0.1 < times[-1] - last_s < STREAM_TIMEOUT_S + 2.0
        assert np.median(np.diff(times)) == pytest.approx(0.05, abs=0.02)
        assert len(times) <= (last_s + STREAM_TIMEOUT_S - began_s) / 0.05 + 10
        assert mavros.all("setpoint")[-1]["enu"] == [-7.0, 16.0, 13.0]


def test_names_can_be_remapped_and_others_who_fly_the_same_are_told(ros: Ros) -> None:
    remap = [
        *("-r", "__ns:=/uav2", "-r", "mavros/local_position/pose:=/drone/pose"),
        *("-r", "mavros/setpoint_position/local:=goal"),
    ]
    with (
        fake(ros, "px4", "--reliable", "--ros-args", *remap) as mavros,
        node_in(ros, *remap) as (node, executor),
        contextlib.ExitStack() as stack,
    ):
        other = node.create_publisher(PoseStamped, "/uav2/goal", 1)
        twin = node.create_publisher(PoseStamped, "/drone/pose", 1)
        vehicle = stack.enter_context(mavros_of(node))
        pattern = "nodes publish /drone/pose; expected one vehicle only"
        until(executor, vehicle, lambda known: pattern in str(known.missing))
        node.destroy_publisher(twin)
        until(executor, vehicle, lambda known: known.missing is None)
        rivals = "2 nodes publish /uav2/goal; expected one bridge only"
        until(executor, vehicle, lambda known: known.other_controller == rivals)
        node.destroy_publisher(other)
        until(executor, vehicle, lambda known: known.other_controller is None)
        vehicle.set_setpoint(START)
        mavros.wait_for("setpoint")
        restarted = stack.enter_context(mavros_of(node, grid_origin=vehicle.telemetry().grid_origin))
        known = until(executor, restarted, lambda known: known.missing is None)
        assert known.other_controller is None, "its predecessor is still in the graph"
        assert node.count_publishers("/uav2/goal") == 2


def test_nobody_who_hears_setpoints_is_told(ros: Ros) -> None:
    deaf = ("--ros-args", "-r", "mavros/setpoint_position/local:=elsewhere")
    with fake(ros, "px4", *deaf), node_in(ros) as (node, executor), mavros_of(node) as vehicle:
        expected = "no node subscribes to /mavros/setpoint_position/local; expected MAVROS to"
        until(executor, vehicle, lambda known: known.missing == expected)
        vehicle.close()  # and again, when the block ends


def test_to_arm_it_needs_mavros_msgs(ros: Ros) -> None:
    with (
        node_in(ros) as (node, _),
        pytest.raises(VehicleError, match="arming through MAVROS needs the package"),
    ):
        MavrosVehicle(node, start=START, arms=True)
