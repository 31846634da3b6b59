"""Flights in the shipped scenarios with obstacles, with their policies, beside the fake autopilot."""

import dataclasses

import gymnasium
import pytest

from tests.offboard.test_obstacles_in_flight import keeps
from tests.support.fake_autopilot.flight import KINDS
from tests.support.fake_autopilot.virtual import VirtualFlight
from uav_dc_ros import scenarios
from uav_dc_ros.agents import policy as policies
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.env.registration import ENV_ID
from uav_dc_ros.messages import Phase
from uav_dc_ros.offboard.frames import Enu
from uav_dc_ros.offboard.mission.controller import MissionController
from uav_dc_ros.offboard.mission.fault_detector import SafetySettings
from uav_dc_ros.offboard.mission.geofence import Geofence
from uav_dc_ros.offboard.mission.keep_out import cell_conflict, return_conflict

# Of docs/obstacles.md: the margin of the fence, and the altitude of the autopilot's return.
SETTINGS = {"town": (8.0, 115.0), "farm": (13.0, 80.0)}
FIELDS = tuple(SETTINGS)


def settings(name: str) -> SafetySettings:
    return SafetySettings(arm=True, return_altitude_m=SETTINGS[name][1], land_if_return_blocked=True)


class ShippedPolicy:
    """The shipped policy, with the users and the data of the environment's mission."""

    def __init__(self, scenario: Scenario) -> None:
        self.policy = policies.load(f"{scenario.name}_dueling")
        self.env = gymnasium.make(ENV_ID, scenario=scenario).unwrapped
        _, self.info = self.env.reset(seed=0)

    def __call__(self, bridge: MissionController) -> Action:
        assert tuple(self.info["cell"].tolist()) == bridge.cell, "it flies the cells of the simulation"
        seen = {name: self.info[name] for name in ("cell", "step", "data_bits", "collected")}
        mask = self.info["action_mask"].astype(bool)
        action = self.policy.act(self.policy.observe(bridge.scenario, **seen), mask)
        self.info = self.env.step(action)[-1]
        return Action(int(action))


def fly(name: str, kind: str) -> tuple[VirtualFlight, list[Enu]]:
    """A flight with the shipped policy, and the list of its setpoints."""
    scenario = scenarios.load(name)
    margin_m, return_m = SETTINGS[name]
    flight = VirtualFlight(kind, settings(name), scenario, fence=Geofence.around(scenario, margin_m))
    flight.policy = ShippedPolicy(scenario)
    flight.do(f"param RTL_RETURN_ALT {return_m}" if kind == "px4" else f"param RTL_ALT {return_m * 100:g}")
    return flight, []


def until(flight: VirtualFlight, sent: list[Enu], *phases: Phase, step: int = 0) -> None:
    """Fly to a phase of a step; fails where setpoint or vehicle are too near to an obstacle."""
    bridge, obstacles = flight.bridge, flight.bridge.scenario.obstacles
    while not (bridge.is_over or (bridge.phase in phases and bridge.step >= step)):
        assert flight.copter.t_s < 3000.0, (bridge.phase, bridge.reason)
        flight.tick()
        if bridge.setpoint is not None and (not sent or sent[-1] != bridge.setpoint):
            sent.append(bridge.setpoint)
            way = (sent[-2:][0], sent[-1])
            assert all(keeps(one, *way, bridge.fence.margin_m) for one in obstacles), way
        where = flight.place_of_grid()
        assert all(keeps(one, where, where, bridge.fence.margin_m - 1.0) for one in obstacles), where


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", FIELDS)
def test_the_shipped_policy_lands_at_the_dock(name: str, kind: str) -> None:
    flight, sent = fly(name, kind)
    until(flight, sent)
    bridge = flight.bridge
    assert bridge.phase is Phase.LANDED, flight.log[-5:]
    assert flight.executed == list(range(bridge.scenario.mission.max_steps))
    assert flight.dock_distance_m() < bridge.settings.tolerance_m
    assert all(bridge.fence.breach(setpoint) is None for setpoint in sent)
    assert len(set(sent)) > 10, "it flies among the obstacles"


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "kind", "step", "mode"),
    [
        ("farm", "ardupilot", 3, "RTL"),
        ("farm", "px4", 45, "AUTO.LAND"),
        ("town", "ardupilot", 50, "LAND"),
        ("town", "px4", 3, "AUTO.RTL"),
    ],
)
def test_a_low_battery_brings_it_down_beside_all_obstacles(
    name: str, kind: str, step: int, mode: str
) -> None:
    """From near the start it returns. Beyond yard and market the way home is not free: it lands there."""
    flight, sent = fly(name, kind)
    until(flight, sent, Phase.MOVING, step=step)
    flight.do("battery 0.1")
    until(flight, sent)
    assert flight.bridge.phase is Phase.ABORTED
    assert flight.all("mode")[-1]["mode"] == mode
    blocked = "the straight way home comes nearer than " in flight.bridge.reason
    assert blocked == ("LAND" in mode), flight.bridge.reason
    assert (flight.copter.armed, flight.copter.landed) == (False, True)
    if not blocked:
        x_m, y_m, _ = flight.bridge.scenario.mission.start_m
        assert flight.place_of_grid()[:2] == pytest.approx((x_m, y_m), abs=2.0)


@pytest.mark.parametrize("name", FIELDS)
def test_what_the_guide_recommends_is_what_the_field_needs(name: str) -> None:
    scenario = scenarios.load(name)
    margin_m, return_m = SETTINGS[name]
    x_m, y_m, _ = scenario.mission.start_m
    how, fence, home = settings(name), Geofence.around(scenario, margin_m), Enu(x_m, y_m, 0.0)
    assert cell_conflict(scenario, fence, how) is None
    assert return_conflict(scenario, fence, how, None, home) is None
    assert cell_conflict(scenario, Geofence.around(scenario), how) is not None, "the default is too wide"
    for less in ({"land_if_return_blocked": False}, {"return_altitude_m": return_m - 30.0}):
        refused = return_conflict(scenario, fence, dataclasses.replace(how, **less), None, home)  # type: ignore[arg-type]
        assert refused is not None, less
