"""The scenario's battery and the aircraft's: the model ends a mission as planned, the aircraft's at once."""

import numpy as np
import pytest

from tests.support.fake_autopilot.simulated import START, Flight, fly_to_step
from tests.support.worlds import changed
from uav_dc_ros.core import energy
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.messages import Phase
from uav_dc_ros.offboard.vehicle import Mode, SetMode

LEVEL_J = changed("five_clusters_hover", energy={"battery_j": 1e6}).step_energies_j.level


def with_battery(steps: float) -> Scenario:
    """A battery that lasts for so many moves."""
    return changed("five_clusters_hover", energy={"battery_j": steps * LEVEL_J, "ends": "both"})


def test_a_spent_model_battery_away_from_the_dock_is_a_return() -> None:
    flight = Flight(scenario=with_battery(20.5))
    flight.policy = lambda bridge: Action.RIGHT if bridge.step < 10 else Action.LEFT
    flight.until(Phase.TIMEOUT)
    reasons = [reason for phase, _, reason in flight.log if phase is Phase.LANDING]
    assert reasons[0] == "step 20: out of the scenario's battery away from the dock (cell reached)"
    assert flight.vehicle.commands[-1] == SetMode(Mode.RETURN)
    assert np.allclose(flight.vehicle.position[:2], START[:2], atol=1.0), "home"
    assert flight.vehicle.battery == 1.0


def test_it_lands_at_the_dock_with_the_last_of_the_model_s_battery() -> None:
    flight = Flight(scenario=with_battery(20.5))  # twenty moves to the dock
    flight.until(Phase.LANDED)
    assert flight.bridge.step == 20
    assert not flight.vehicle.armed


def test_the_aircraft_s_own_battery_ends_a_mission_whatever_the_model_has_left() -> None:
    scenario = with_battery(40.5)
    flight = fly_to_step(5, scenario=scenario)
    used_j = flight.bridge.progress.energy_used_j
    assert scenario.energy is not None
    assert energy.state_of_charge(scenario.energy, used_j) > 0.8
    flight.vehicle.battery = 0.1
    flight.run(1.0)
    assert flight.vehicle.mode is Mode.RETURN
    flight.until(Phase.ABORTED)
    assert flight.bridge.reason.startswith("battery 10%")


def test_a_vehicle_that_waits_or_is_late_uses_no_energy_of_the_model() -> None:
    """The model counts steps, as the policy learned it; the aircraft's battery counts the rest."""
    calm, late = fly_to_step(8, scenario=with_battery(40.5)), Flight(scenario=with_battery(40.5))
    late.vehicle.speeds_mps["across"] = 5.0  # 20 s for a step of 15 s
    while late.bridge.step < 8 or late.bridge.phase is not Phase.MOVING:
        assert not late.bridge.is_over, late.log[-5:]
        late.tick()
    assert late.vehicle.now_s > calm.vehicle.now_s + 30.0
    assert late.bridge.progress.energy_used_j == calm.bridge.progress.energy_used_j
    assert float(calm.bridge.progress.energy_used_j) == pytest.approx(8 * LEVEL_J, rel=1e-12)
