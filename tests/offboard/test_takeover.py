"""Who has the vehicle: a pilot's switch on the ground, another system, a bridge that is stopped anywhere."""

import dataclasses

import msgspec
import pytest

from tests.support.fake_autopilot.simulated import ARMING, START, Flight, Vehicle, fly_to_step
from uav_dc_ros.messages import Phase
from uav_dc_ros.offboard.frames import Enu
from uav_dc_ros.offboard.mission.controller import Checkpoint
from uav_dc_ros.offboard.mission.fault_detector import SafetySettings
from uav_dc_ros.offboard.vehicle import Arm, Mode, SetMode, Telemetry

GROUND = Enu(START.east_m, START.north_m, 0.0)
ALOFT = Enu(300.0, 300.0, 150.0)


class Stubborn(Vehicle):
    """Does not arm while the throttle stick is up."""

    stick_is_up = True

    def send_command(self, command: object) -> None:
        if isinstance(command, Arm) and self.stick_is_up:
            self.commands.append(command)
        else:
            super().send_command(command)  # type: ignore[arg-type]


def restarted(flight: Flight) -> Flight:
    """Another bridge beside the same vehicle, with what the journal holds."""
    checkpoint = msgspec.json.decode(msgspec.json.encode(flight.bridge.checkpoint), type=Checkpoint)
    return Flight(flight.bridge.settings, flight.vehicle, checkpoint=checkpoint)


def test_a_switch_on_the_ground_is_the_last_word() -> None:
    flight = Flight(vehicle=Stubborn(position=GROUND))
    flight.run(10.0)
    assert flight.vehicle.mode is Mode.COMMANDED
    flight.vehicle.mode, flight.vehicle.mode_name = Mode.OTHER, "LOITER"
    n_sent = len(flight.vehicle.commands)
    flight.vehicle.stick_is_up = False  # type: ignore[attr-defined]
    flight.run(60.0)
    assert flight.vehicle.commands[n_sent:] == []
    assert (flight.vehicle.mode, flight.vehicle.armed) == (Mode.OTHER, False)
    reason = "mode LOITER before take-off: changed by a pilot or by the autopilot's failsafe"
    assert (flight.bridge.phase, flight.bridge.reason) == (Phase.ABORTED, reason)
    again = restarted(flight)
    again.run(10.0)
    assert flight.vehicle.commands[n_sent:] == []
    assert (again.bridge.phase, again.bridge.reason) == (Phase.ABORTED, reason)


@pytest.mark.parametrize("obeys", [True, False])
def test_a_bridge_that_is_restarted_on_the_ground_knows_what_it_requested(obeys: bool) -> None:
    """The pilot's switch came while no bridge was there; also if the mode was never taken."""
    flight = Flight(vehicle=Stubborn(position=GROUND, mode_name="STABILIZE", ignores_commands=not obeys))
    flight.run(10.0)
    assert SetMode(Mode.COMMANDED) in flight.vehicle.commands
    flight.vehicle.mode, flight.vehicle.mode_name = Mode.OTHER, "LOITER"
    flight.vehicle.commands.clear()
    again = restarted(flight)
    again.run(10.0)
    assert flight.vehicle.commands == []
    assert again.bridge.phase is Phase.ABORTED
    assert again.bridge.reason.startswith("mode LOITER before take-off: changed by a pilot")


def test_what_was_requested_is_kept_before_it_is_sent() -> None:
    kept: list[str | None] = []
    flight = Flight()
    note = flight.bridge._on_change

    def keep() -> None:
        note()
        kept.append(flight.bridge.checkpoint.allowed_mode)
        assert flight.vehicle.commands == [] or kept[-1] is not None

    flight.bridge._on_change = keep
    flight.until(Phase.TAKEOFF)
    assert kept[-1] is not None


def test_a_request_that_is_refused_is_repeated_until_a_pilot_chooses_a_third_mode() -> None:
    vehicle = Vehicle(position=GROUND, mode_name="STABILIZE", refused=(Mode.COMMANDED,))
    flight = Flight(vehicle=vehicle)
    flight.run(10.0)
    assert vehicle.commands.count(SetMode(Mode.COMMANDED)) >= 4
    vehicle.mode_name = "LOITER"
    vehicle.refused = ()
    vehicle.commands.clear()
    flight.run(10.0)
    assert vehicle.commands == []
    assert flight.bridge.phase is Phase.ABORTED


def test_before_anything_is_requested_a_pilot_may_choose_any_mode() -> None:
    vehicle = Vehicle(position=GROUND, mode_name="STABILIZE", battery=0.1)
    flight = Flight(vehicle=vehicle)
    flight.run(5.0)
    vehicle.mode_name = "LOITER"
    flight.run(5.0)
    assert flight.bridge.phase is Phase.PREFLIGHT
    vehicle.battery = 1.0
    flight.until(Phase.TAKEOFF)


def test_without_arm_modes_on_the_ground_are_the_pilot_s_business() -> None:
    vehicle = Vehicle(position=GROUND, mode=Mode.COMMANDED)
    flight = Flight(SafetySettings(), vehicle)
    for mode in (Mode.OTHER, Mode.COMMANDED, Mode.HOLD, Mode.COMMANDED):
        flight.run(3.0)
        vehicle.mode = mode
    assert flight.bridge.phase is Phase.PREFLIGHT
    vehicle.armed = True
    flight.until(Phase.MOVING)


def test_what_a_pilot_took_over_stays_the_pilot_s_after_a_restart_and_a_stop() -> None:
    flight = fly_to_step(3)
    flight.vehicle.mode = Mode.OTHER
    flight.run(0.5)
    flight.vehicle.mode = Mode.COMMANDED  # a ground station's now
    flight.vehicle.commands.clear()
    again = restarted(flight)
    again.run(5.0)
    assert (again.bridge.phase, again.bridge.reason) == (Phase.ABORTED, flight.bridge.reason)
    third = restarted(flight)
    third.bridge.stop("the bridge was stopped", flight.vehicle.telemetry)
    third.run(1.0)
    assert flight.vehicle.commands == []


@pytest.mark.parametrize("how", [ARMING, SafetySettings()])
def test_a_vehicle_that_another_system_commands_is_refused_before_anything_is_sent(
    how: SafetySettings,
) -> None:
    evidence = "component 191 of system 254 sends heartbeats"
    for vehicle in (
        Vehicle(position=GROUND, other_controller=evidence),
        Vehicle(position=ALOFT, other_controller=evidence, mode=Mode.COMMANDED, armed=True),
    ):
        flight = Flight(how, vehicle)
        flight.run(5.0)
        assert vehicle.commands == []
        assert flight.bridge.setpoint is None
        assert (flight.bridge.phase, flight.bridge.reason) == (
            Phase.ABORTED,
            f"another system commands this vehicle: {evidence}",
        )


@pytest.mark.parametrize("armed", [False, True])
def test_what_is_missing_after_connecting_stops_a_take_off(armed: bool) -> None:
    """Such as a second vehicle on the link; also where a pilot has armed meanwhile."""
    flight = Flight(vehicle=Stubborn(position=GROUND))
    flight.until(Phase.PREFLIGHT)
    flight.run(5.0)
    vehicle, missing = flight.vehicle, "2 autopilots on this link"
    vehicle.missing, vehicle.stick_is_up = missing, False  # type: ignore[attr-defined]
    vehicle.armed = armed
    vehicle._report()
    vehicle.commands.clear()
    flight.run(10.0)
    assert vehicle.commands == []
    assert flight.bridge.setpoint is None
    assert (flight.bridge.phase, flight.bridge.reason) == (Phase.CONNECTING, missing)
    vehicle.missing = None
    flight.until(Phase.TAKEOFF, 10.0)


def test_another_system_that_comes_in_flight_is_reported() -> None:
    flight, evidence = fly_to_step(3), "component 191 of system 254 sends heartbeats"
    flight.vehicle.other_controller = evidence
    flight.run(1.0)
    assert flight.bridge.phase in (Phase.READY, Phase.MOVING)
    assert flight.bridge.warnings == [f"another system commands this vehicle: {evidence}"]
    assert any("another system commands this vehicle" in reason for _, _, reason in flight.log)
    flight.vehicle.other_controller = None
    flight.vehicle.battery = 0.1
    flight.until(Phase.LANDING)
    assert flight.bridge.reason.startswith(f"another system commands this vehicle: {evidence}; battery 10%")


def test_a_target_that_is_not_ours_for_long_ends_the_mission() -> None:
    """Another bridge drags the vehicle to a target of its own, or the autopilot refuses targets silently."""
    flight = fly_to_step(3)
    vehicle = flight.vehicle
    vehicle.fence_m = 1.0  # it keeps the target that it has
    vehicle.target = Enu(0.0, 500.0, 150.0)
    flight.until(Phase.LANDING, 12.0)
    assert flight.bridge.reason.startswith(NOT_ACCEPTED)
    assert ";" not in flight.bridge.reason
    flight.until(Phase.ABORTED)


NOT_ACCEPTED = "the autopilot does not accept the setpoint: its target is "
ENDS = [
    ({"falls": True}, "m too low; expected at most 10 m"),
    ({"tilt_rad": 2.0}, "tilted by 115 degrees; expected at most 70"),
    ({"offset": (0.0, 0.0, 600.0)}, "the vehicle is outside the fence: "),
    ({"battery": 0.1}, "battery 10%"),
    ({"frozen": True}, "no position for 0.5 s"),
]


@pytest.mark.parametrize(("change", "end"), ENDS, ids=[next(iter(change)) for change, _ in ENDS])
@pytest.mark.parametrize("after_s", [2.0, 7.0], ids=["before", "on hold"])
def test_the_reason_of_an_end_begins_with_its_cause(
    change: dict[str, object], end: str, after_s: float
) -> None:
    """The cause is a target that is not ours: it holds the vehicle after 5 s, or is too recent for that."""
    flight = fly_to_step(3, SafetySettings(arm=True, max_speed_mps=1e6))
    vehicle = flight.vehicle
    vehicle.fence_m, vehicle.target = 1.0, vehicle.position._replace(up_m=vehicle.position.up_m - 5.0)
    flight.run(after_s)
    assert (flight.bridge.fault is not None) == (after_s > 5.0)
    for name, value in change.items():
        setattr(vehicle, name, value)
    flight.until(Phase.LANDING, 12.0)
    reason = flight.bridge.reason
    assert end in reason
    # Without positions for five seconds, a target that deviated for two before is no fault.
    assert reason.startswith(NOT_ACCEPTED) or (after_s < 5.0 and "frozen" in change), reason
    assert reason.count(NOT_ACCEPTED) <= 1
    flight.until(Phase.ABORTED)
    assert flight.bridge.reason.startswith(reason)


# A new mission beside a vehicle in the air, and Ctrl-C.


@pytest.mark.parametrize("mode", [Mode.COMMANDED, Mode.OTHER])
def test_a_vehicle_in_the_air_without_a_datum_is_refused_at_once(mode: Mode) -> None:
    vehicle = Vehicle(position=ALOFT, mode=mode, armed=True, unplaced=True)
    flight = Flight(vehicle=vehicle)
    flight.until(Phase.ABORTED, 10.0)
    assert "expected --datum=LAT,LON,ALT" in flight.bridge.reason
    assert vehicle.commands == []


def test_a_vehicle_in_the_air_outside_the_fence_is_refused_at_once() -> None:
    vehicle = Vehicle(position=Enu(3000.0, 0.0, 150.0), mode=Mode.COMMANDED, armed=True)
    flight = Flight(vehicle=vehicle)
    flight.until(Phase.ABORTED, 5.0)
    assert flight.bridge.reason.startswith("the vehicle is outside the fence: 3000.0 m east")
    assert vehicle.commands == []


@pytest.mark.parametrize("ticks", [0, 1, 2, 5, 20])
@pytest.mark.parametrize("unplaced", [True, False])
@pytest.mark.parametrize("then", [Mode.RETURN, Mode.LAND])
def test_a_bridge_that_is_stopped_brings_a_vehicle_down_in_every_phase(
    ticks: int, unplaced: bool, then: Mode
) -> None:
    vehicle = Vehicle(position=ALOFT, mode=Mode.COMMANDED, armed=True, unplaced=unplaced)
    vehicle.pass_time(0.1, None)
    flight = Flight(SafetySettings(failsafe_action=then), vehicle)
    for _ in range(ticks):
        flight.tick()
    flight.bridge.stop("the bridge was stopped", vehicle.telemetry)
    flight.run(0.3)
    assert vehicle.commands == [SetMode(then)]
    assert flight.bridge.can_be_released(vehicle.telemetry)
    flight.until(Phase.ABORTED)
    assert flight.bridge.reason == "the bridge was stopped"


def test_a_bridge_that_is_stopped_lets_a_pilot_s_vehicle_alone() -> None:
    for vehicle in (Vehicle(position=ALOFT, armed=True), Vehicle(position=GROUND)):
        flight = Flight(vehicle=vehicle)
        flight.tick()
        flight.bridge.stop("the bridge was stopped")
        flight.run(1.0)
        assert vehicle.commands == []
        assert flight.bridge.phase is Phase.ABORTED


def test_a_bridge_that_is_stopped_lets_one_of_several_vehicles_alone() -> None:
    """The first one on the link flies, commanded by another system."""
    vehicle = Vehicle(position=ALOFT, mode=Mode.COMMANDED, armed=True, missing="2 autopilots on this link")
    vehicle.pass_time(0.1, None)
    flight = Flight(vehicle=vehicle)
    for _ in range(20):
        flight.tick(known=dataclasses.replace(vehicle.telemetry, is_selected=False))
    flight.bridge.stop("the bridge was stopped")
    flight.run(1.0)
    assert (vehicle.commands, flight.bridge.phase) == ([], Phase.ABORTED)


def test_a_mission_in_the_air_that_cannot_be_taken_up_has_an_end() -> None:
    """The position never comes back, though the link does."""
    flight = fly_to_step(3)
    flight.vehicle.frozen = True
    flight.vehicle.telemetry = Telemetry()
    again = restarted(flight)
    again.until(Phase.ABORTED, 1500.0)
    assert again.bridge.reason.startswith("no position for 0.5 s; waited 300 s")
    assert SetMode(Mode.RETURN) in flight.vehicle.commands


def test_a_vehicle_that_was_armed_and_disarmed_before_take_off_is_not_armed_again() -> None:
    """Somebody disarmed it, while the bridge waited for what was missing."""
    flight = Flight(vehicle=Stubborn(position=GROUND))
    vehicle = flight.vehicle
    flight.run(3.0)
    vehicle.missing, vehicle.armed = "2 autopilots on this link", True
    vehicle._report()
    flight.run(3.0)
    vehicle.armed = vehicle.stick_is_up = False  # type: ignore[attr-defined]
    vehicle.missing = None
    vehicle._report()
    vehicle.commands.clear()
    flight.run(10.0)
    assert vehicle.commands == []
    assert flight.bridge.reason == "a pilot had control: waiting for a pilot to set the mode and arm"
    again = restarted(flight)
    again.run(10.0)
    assert vehicle.commands == []


def test_a_vehicle_that_is_disarmed_as_a_bridge_comes_back_is_not_armed_again() -> None:
    """It had not left the ground when that one was killed."""
    flight = Flight(vehicle=Stubborn(position=GROUND, stuck=True))
    flight.vehicle.stick_is_up = False  # type: ignore[attr-defined]
    flight.until(Phase.TAKEOFF)
    again = restarted(flight)
    again.until(Phase.PREFLIGHT)
    again.vehicle.armed = False
    again.vehicle._report()
    again.vehicle.commands.clear()
    again.run(5.0)
    assert again.vehicle.commands == []
    assert (again.bridge.phase, again.bridge.reason) == (
        Phase.ABORTED,
        "on the ground and disarmed when the bridge restarted",
    )
