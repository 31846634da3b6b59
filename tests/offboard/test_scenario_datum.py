"""A scenario that states where its grid lies: the bridge flies there, and nowhere else."""

import msgspec
import pytest

from tests.support.fake_autopilot.autopilot import HOME
from tests.support.fake_autopilot.flight import KINDS
from tests.support.fake_autopilot.simulated import Vehicle
from tests.support.fake_autopilot.virtual import VirtualFlight, short
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.messages import Phase
from uav_dc_ros.offboard.frames import Enu, Geodetic
from uav_dc_ros.offboard.mission.controller import MissionController
from uav_dc_ros.offboard.mission.fault_detector import SafetySettings
from uav_dc_ros.offboard.mission.preflight import NO_GLOBAL_POSITION

STANDS = Geodetic(*HOME)  # where the fake vehicle is switched on


def world(east_m: float = 0.0, north_m: float = 0.0) -> Scenario:
    """The short mission; the vehicle is switched on at this offset from its start."""
    scenario = short()
    x_m, y_m, _ = scenario.mission.start_m
    corner = STANDS.at(Enu(-x_m - east_m, -y_m - north_m, 0.0))
    return msgspec.structs.replace(scenario, datum_deg=corner[:2])


@pytest.mark.parametrize("kind", KINDS)
def test_the_grid_lies_where_the_scenario_has_it(kind: str) -> None:
    scenario = world(12.0, -7.0)
    flight = VirtualFlight(kind, scenario=scenario, datum_deg=scenario.datum_deg)
    flight.until_over()
    assert flight.bridge.phase is Phase.LANDED, flight.log[-5:]
    north_m, east_m, _ = flight.copter.ned  # from where it was switched on
    x_m, y_m, _ = scenario.mission.start_m
    landed = (x_m + 12.0 + east_m, y_m - 7.0 + north_m)
    assert landed == pytest.approx(scenario.mission.dock_m, abs=flight.bridge.settings.tolerance_m)
    datum = flight.telemetry.datum
    assert datum is not None
    assert datum[:2] == scenario.datum_deg
    assert datum.altitude_m == pytest.approx(STANDS.altitude_m, abs=0.1), "that of the ground"


@pytest.mark.parametrize("kind", KINDS)
def test_a_vehicle_that_stands_elsewhere_moves_no_grid(kind: str) -> None:
    """`--datum here`: the vehicle stands at the start. 20 m beside it nothing is sent to the vehicle."""
    scenario = world(20.0)
    flight = VirtualFlight(kind, scenario=scenario)
    flight.until_over(60.0)
    assert flight.bridge.phase is Phase.ABORTED
    assert flight.telemetry.datum is not None
    assert f"the grid's corner at {flight.telemetry.datum} is 20.0 m from" in flight.bridge.reason
    assert f"datum_deg = {list(scenario.datum_deg or ())}" in flight.bridge.reason
    assert (flight.all("armed"), flight.all("mode"), flight.all("command")) == ([], [], [])


@pytest.mark.parametrize("kind", KINDS)
def test_a_datum_a_few_metres_beside_it_is_flown(kind: str) -> None:
    flight = VirtualFlight(kind, scenario=world(3.0))
    flight.until(lambda: flight.bridge.phase is Phase.TAKEOFF, 60.0)


@pytest.mark.parametrize("kind", KINDS)
def test_a_vehicle_in_the_air_gives_no_altitude(kind: str) -> None:
    scenario = world()
    flight = VirtualFlight(kind, scenario=scenario, datum_deg=scenario.datum_deg)
    flight.do("fly 10 10 20")
    flight.until_over(15.0)
    assert flight.bridge.phase is Phase.ABORTED
    if kind == "ardupilot":  # PX4 without a stream returns by itself meanwhile
        assert "datum_deg of the scenario) is not known" in flight.bridge.reason
        assert "--datum=LAT,LON,ALT" in flight.bridge.reason
    assert flight.all("command") == []


def test_a_grid_that_cannot_be_compared_is_not_flown() -> None:
    """`--datum here` through MAVROS, and no global position."""
    scenario = world()
    x_m, y_m, _ = scenario.mission.start_m
    vehicle = Vehicle(position=Enu(x_m, y_m, 0.0))
    bridge = MissionController(scenario, SafetySettings(arm=True), lambda: None)
    for _ in range(50):
        assert not list(bridge.tick(vehicle.now_s, vehicle.telemetry))
        vehicle.pass_time(0.1, bridge.setpoint)
    assert bridge.phase is Phase.CONNECTING
    assert bridge.reason == NO_GLOBAL_POSITION
    for _ in range(50):
        bridge.tick(vehicle.now_s, vehicle.telemetry.replace(datum=Geodetic(*scenario.datum_deg or (), 0.0)))
        vehicle.pass_time(0.1, bridge.setpoint)
    assert bridge.phase is Phase.PREFLIGHT
