"""What brings a vehicle down, beside a pilot who knows better, and beside a bridge that is started anew."""

import dataclasses

import pytest

from tests.autopilot.simulated import START, Flight, Vehicle, fly_to_step
from uav_dc_ros.autopilot.frames import Enu
from uav_dc_ros.autopilot.vehicle import Mode, SetMode
from uav_dc_ros.autopilot.watch import Settings
from uav_dc_ros.messages import Phase

GROUND = Enu(START.east_m, START.north_m, 0.0)


@pytest.mark.parametrize("phase", [Phase.MOVING, Phase.PREFLIGHT])
def test_a_vehicle_without_an_estimate_is_not_told_to_return_when_the_bridge_is_stopped(phase: Phase) -> None:
    if phase is Phase.MOVING:
        flight = fly_to_step(3)
    else:
        vehicle = Vehicle(position=START, mode=Mode.COMMANDED, armed=True)
        flight = Flight(Settings(), vehicle)
    flight.vehicle.estimate_ok = False
    flight.vehicle.refused = (Mode.RETURN,)
    flight.run(1.0)
    flight.bridge.stop("the bridge was stopped")
    flight.vehicle.asked.clear()
    flight.run(1.0)
    assert flight.vehicle.asked == [SetMode(Mode.LAND)]


@pytest.mark.parametrize(("lost_s", "mode"), [(7.0, Mode.RETURN), (20.0, Mode.LAND)])
def test_a_vehicle_whose_clock_stands_is_asked_again(lost_s: float, mode: Mode) -> None:
    """Nothing comes but heartbeats, and the first request is lost, or as many as are a refusal."""
    flight = fly_to_step(3)
    vehicle = flight.vehicle
    vehicle.deaf = True
    told = dataclasses.replace(vehicle.told)

    def run(seconds: float) -> None:
        for _ in range(round(seconds / 0.1)):
            flight.tick(known=dataclasses.replace(told, heartbeat_s=vehicle.now_s, mode=vehicle.mode))

    run(lost_s)
    assert flight.bridge.phase is Phase.LANDING
    vehicle.deaf = False
    run(5.0)
    assert vehicle.mode is mode
