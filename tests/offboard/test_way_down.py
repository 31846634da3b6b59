"""What brings a vehicle down, beside a pilot who knows better, and beside a bridge that is started anew."""

import dataclasses

import msgspec
import pytest

from tests.support.fake_autopilot.simulated import ARMING, SCENARIO, START, Flight, Vehicle, fly_to_step
from uav_dc_ros.messages import Phase
from uav_dc_ros.offboard.frames import Enu
from uav_dc_ros.offboard.mission.controller import Checkpoint
from uav_dc_ros.offboard.mission.fault_detector import SafetySettings
from uav_dc_ros.offboard.vehicle import Mode, SetMode

GROUND = Enu(START.east_m, START.north_m, 0.0)


def restarted(flight: Flight) -> Flight:
    """Another bridge beside the same vehicle, with what the journal holds."""
    checkpoint = msgspec.json.decode(msgspec.json.encode(flight.bridge.checkpoint), type=Checkpoint)
    return Flight(flight.bridge.settings, flight.vehicle, checkpoint=checkpoint)


def drifting() -> Flight:
    """Return was requested, and the wind is stronger than it flies."""
    flight = fly_to_step(3)
    flight.vehicle.battery = 0.1
    flight.run(1.0)
    assert flight.vehicle.mode is Mode.RETURN
    flight.vehicle.stuck = True
    flight.run(20.0)
    return flight


def test_a_pilot_may_return_a_vehicle_that_lands_instead_of_returning() -> None:
    flight = drifting()
    vehicle = flight.vehicle
    flight.run(20.0)
    assert vehicle.mode is Mode.LAND
    vehicle.commands.clear()
    vehicle.mode = Mode.RETURN  # the pilot's: there is water below
    flight.run(10.0)
    assert (vehicle.commands, vehicle.mode) == ([], Mode.RETURN)
    vehicle.stuck = False
    flight.until(Phase.ABORTED)
    assert vehicle.commands == []


def test_a_return_that_does_not_come_home_is_ended_by_a_bridge_that_is_started_anew_too() -> None:
    again = restarted(drifting())
    again.run(60.0)
    assert again.vehicle.mode is Mode.LAND, again.log[-3:]


def test_a_landing_at_the_dock_goes_on_as_one() -> None:
    """Killed before the vehicle received the request."""
    flight = fly_to_step(3)
    flight.vehicle.ignores_commands = True
    flight.until(Phase.LANDING)
    assert flight.bridge.checkpoint.outcome is Phase.LANDED
    flight.vehicle.ignores_commands = False
    again = restarted(flight)
    again.until(Phase.LANDED)


def test_a_restarted_bridge_requests_no_return_without_an_estimate() -> None:
    flight = fly_to_step(3)
    flight.vehicle.ignores_commands = True
    flight.vehicle.estimate_ok = False
    flight.until(Phase.LANDING)
    flight.vehicle.estimate_ok = True
    flight.vehicle.commands.clear()
    flight.vehicle.ignores_commands = False
    again = restarted(flight)
    again.until(Phase.ABORTED)
    assert set(again.vehicle.commands) == {SetMode(Mode.LAND)}


def test_who_takes_a_vehicle_that_comes_down_keeps_it_though_no_bridge_was_there_to_see_it() -> None:
    flight = fly_to_step(3)
    flight.vehicle.battery = 0.1
    flight.run(5.0)
    assert flight.vehicle.mode is Mode.RETURN
    flight.vehicle.commands.clear()
    flight.vehicle.mode = Mode.COMMANDED  # a ground station's
    again = restarted(flight)
    again.until(Phase.ABORTED)
    assert again.vehicle.commands == []


@pytest.mark.parametrize("refused", ["rival", "outside", "unplaced", "stopped"])
def test_what_was_left_alone_is_let_alone_by_a_bridge_that_is_started_anew(refused: str) -> None:
    """With the journal of a flight that was refused, or stopped while a pilot had the vehicle."""
    vehicle = Vehicle(position=Enu(300.0, 300.0, 150.0), mode=Mode.COMMANDED, armed=True)
    flight = Flight(ARMING, vehicle)
    if refused == "rival":
        vehicle.other_controller = "component 191 of system 254 sends heartbeats"
    elif refused == "outside":
        vehicle.position = Enu(3000.0, 300.0, 150.0)
    elif refused == "unplaced":
        vehicle.unplaced = True
    else:
        vehicle.mode = Mode.OTHER
    vehicle._report()
    flight.run(8.0)
    flight.bridge.stop("the bridge was stopped")
    assert flight.bridge.is_over
    vehicle.mode = Mode.COMMANDED
    vehicle.unplaced, vehicle.other_controller = False, None
    vehicle._report()
    again = restarted(flight)
    again.run(5.0)
    assert (vehicle.commands, again.bridge.phase) == ([], Phase.ABORTED)


def test_what_a_pilot_has_is_let_alone_also_without_a_position() -> None:
    flight = fly_to_step(3)
    flight.vehicle.mode = Mode.OTHER
    flight.run(0.5)
    flight.vehicle.mode = Mode.COMMANDED
    flight.vehicle.commands.clear()
    again = restarted(flight)
    again.vehicle.unplaced = True
    again.vehicle._report()
    again.until(Phase.ABORTED)
    assert again.vehicle.commands == []


def test_a_mode_that_was_entered_is_known_to_a_bridge_that_is_started_anew() -> None:
    """The pilot goes back to the mode that the vehicle was in before the commanded one was requested."""
    kept: list[Checkpoint] = []
    vehicle = Vehicle(position=GROUND, mode_name="STABILIZE")
    flight = Flight(vehicle=vehicle)
    note = flight.bridge._on_change

    def keep() -> None:
        note()
        kept.append(flight.bridge.checkpoint)

    flight.bridge._on_change = keep
    while vehicle.mode is not Mode.COMMANDED:
        flight.tick()
    flight.tick()
    vehicle.commands.clear()
    vehicle.armed = False
    vehicle.mode = Mode.OTHER
    vehicle._report()
    again = Flight(ARMING, vehicle, checkpoint=kept[-1])
    again.run(10.0)
    assert vehicle.commands == []


@pytest.mark.parametrize("phase", [Phase.MOVING, Phase.PREFLIGHT])
def test_a_stopped_bridge_requests_no_return_without_an_estimate(phase: Phase) -> None:
    if phase is Phase.MOVING:
        flight = fly_to_step(3)
    else:
        vehicle = Vehicle(position=START, mode=Mode.COMMANDED, armed=True)
        flight = Flight(SafetySettings(), vehicle)
    flight.vehicle.estimate_ok = False
    flight.vehicle.refused = (Mode.RETURN,)
    flight.run(1.0)
    flight.bridge.stop("the bridge was stopped")
    flight.vehicle.commands.clear()
    flight.run(1.0)
    assert flight.vehicle.commands == [SetMode(Mode.LAND)]


@pytest.mark.parametrize(("link_lost_timeout_s", "mode"), [(7.0, Mode.RETURN), (20.0, Mode.LAND)])
def test_requests_are_repeated_to_a_vehicle_whose_clock_stands(
    link_lost_timeout_s: float, mode: Mode
) -> None:
    """Nothing comes but heartbeats, and the first request is lost, or as many as are a refusal."""
    flight = fly_to_step(3)
    vehicle = flight.vehicle
    vehicle.ignores_commands = True
    told = dataclasses.replace(vehicle.telemetry)

    def run(seconds: float) -> None:
        for _ in range(round(seconds / 0.1)):
            flight.tick(known=dataclasses.replace(told, heartbeat_s=vehicle.now_s, mode=vehicle.mode))

    run(link_lost_timeout_s)
    assert flight.bridge.phase is Phase.LANDING
    vehicle.ignores_commands = False
    run(5.0)
    assert vehicle.mode is mode


@pytest.mark.parametrize("up_m", [3.0, 250.0 - 40.0])
@pytest.mark.parametrize("again", [True, False])
def test_a_vehicle_that_flies_goes_straight_up_or_down_then_across(up_m: float, again: bool) -> None:
    vehicle = Vehicle(position=Enu(300.0, 300.0, up_m), mode=Mode.COMMANDED, armed=True)
    checkpoint = Checkpoint(step=0, cell=SCENARIO.start_cell, airborne=True) if again else None
    flight = Flight(SafetySettings(), vehicle, checkpoint=checkpoint)
    while abs(vehicle.position.up_m - START.up_m) > 3.0:
        assert vehicle.position[:2] == (300.0, 300.0)
        flight.tick()
    flight.until(Phase.MOVING)
