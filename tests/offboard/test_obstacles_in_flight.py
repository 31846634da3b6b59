"""Missions among obstacles beside the fake autopilot: setpoints keep the margin, and so do the ways home."""

import math
import random
from itertools import pairwise
from typing import Any

import msgspec
import numpy as np
import pytest
import shapely

from tests.support.fake_autopilot.virtual import VirtualFlight, short
from uav_dc_ros.core import world
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.obstacles.prisms import Obstacle
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.offboard.frames import Enu
from uav_dc_ros.offboard.mission.controller import MissionController
from uav_dc_ros.offboard.mission.fault_detector import SafetySettings
from uav_dc_ros.offboard.mission.geofence import Geofence
from uav_dc_ros.offboard.mission.keep_out import cell_conflict, return_conflict
from uav_dc_ros.offboard.vehicle import Limits, Mode
from uav_dc_ros.planners.routes import Routes

MARGIN_M, RETURN_M = 3.0, 15.0
KEPT = {"clearance_m": 5.0}
# On the straight way from start to dock, and beside it. The autopilot returns 15 m above home.
HOUSES = (
    Obstacle(polygon_m=((14, -8), (26, -8), (26, 5), (14, 5)), height_m=11.0, **KEPT),
    Obstacle(polygon_m=((33, 33), (46, 28), (47, 47)), height_m=9.0, **KEPT),
)
ZONES = (
    Obstacle(kind="no_fly", polygon_m=((14, -8), (26, -8), (26, 5), (14, 5)), **KEPT),
    Obstacle(kind="no_fly", polygon_m=((33, 33), (46, 28), (47, 47)), **KEPT),
)
RETURNS = SafetySettings(arm=True, return_altitude_m=RETURN_M)
LANDS = SafetySettings(arm=True, failsafe_action=Mode.LAND)
BOTH = (HOUSES[0], ZONES[1])
EITHER = SafetySettings(arm=True, return_altitude_m=RETURN_M, land_if_return_blocked=True)
# Commands of the fake autopilot, and those that end the fault.
FAULTS = {
    "none": ((), ()),
    "freeze": (("freeze 1",), ("freeze 0",)),
    "lose": (("lose 1",), ("lose 0",)),
    "late": (("late 4",), ("late 0",)),
    "refuse": (("refuse 1",), ("refuse 0",)),
    "battery": (("battery 0.1",), ("battery 1",)),
    "odd messages": (("late_position 1.5", "zero_time", "nonsense", "twice 1"), ("twice 0",)),
    "slow": (("param WPNAV_SPEED 300", "param MPC_XY_VEL_MAX 3"), ()),
    "link": ((), ()),
    "policy": ((), ()),
    "restart": ((), ()),
    "stop": ((), ()),
}


def field(obstacles: tuple[Obstacle, ...], steps: int = 10) -> Scenario:
    """A small field near the ground."""
    return msgspec.structs.replace(short(steps), obstacles=obstacles)


def fence(scenario: Scenario) -> Geofence:
    """With a margin of 3 m."""
    return Geofence.around(scenario, MARGIN_M)


class Wanderer:
    """A policy: half of its moves are any that have an effect, the others lead to the dock."""

    def __init__(self, scenario: Scenario, seed: int) -> None:
        self._rng, self._routes, self._scenario = random.Random(seed), Routes(scenario), scenario

    def __call__(self, bridge: MissionController) -> Action:
        cell = np.asarray(bridge.cell)
        mask = world.action_mask(self._scenario, cell)
        assert mask is not None
        if self._rng.random() < 0.5:
            return Action(self._rng.choice(np.flatnonzero(mask).tolist()))
        return Action(int(self._routes.towards(cell, np.asarray(self._scenario.n_clusters))))


def keeps(obstacle: Obstacle, start: Enu, end: Enu, margin_m: float) -> bool:
    """Whether a straight way keeps a margin, by shapely; ways here are level or vertical, or nearly."""
    low, high = min(start.up_m, end.up_m), max(start.up_m, end.up_m)
    if low >= obstacle.top_m + margin_m or high <= obstacle.base_m - margin_m:
        return True
    way = shapely.LineString([start[:2], end[:2]]) if start[:2] != end[:2] else shapely.Point(start[:2])
    return way.distance(shapely.Polygon(obstacle.polygon_m)) >= margin_m


def fly(seed: int, kind: str, obstacles: tuple[Obstacle, ...], how: SafetySettings) -> str:
    """Fly a mission with a random fault; its reason. Fails when a setpoint or the vehicle is too near."""
    rng = random.Random(seed)
    scenario = field(obstacles)
    flight = VirtualFlight(kind, how, scenario, fence=fence(scenario))
    flight.policy = policy = Wanderer(scenario, seed)
    name, at_s, lasts_s = (
        rng.choice(sorted(FAULTS)),
        rng.uniform(15.0, 60.0),
        rng.choice([1.0, 4.0, 30.0, 30.0]),
    )
    sent: list[Enu] = []
    begun = over = False
    while not flight.bridge.is_over:
        now_s, bridge = flight.copter.t_s, flight.bridge
        assert now_s < 2000.0, (name, bridge.phase, bridge.reason)
        if not begun and now_s >= at_s:
            begun = True
            for line in FAULTS[name][0]:
                flight.do(line)
            flight.link_is_up = name != "link"
            bridge.policy_lost = name == "policy"
            flight.policy = None if name == "policy" else policy
            if name == "restart":
                flight.restart(1)
            if name == "stop":
                bridge.stop("stopped", flight.telemetry.snapshot(flight.now_s))
        if begun and not over and now_s >= at_s + lasts_s:
            over = flight.link_is_up = True
            flight.bridge.policy_lost, flight.policy = False, policy
            for line in FAULTS[name][1]:
                flight.do(line)
        flight.tick()
        setpoint = flight.bridge.setpoint
        if setpoint is not None and (not sent or sent[-1] != setpoint):
            sent.append(setpoint)
        where = flight.place_of_grid()
        # Without a position estimate a vehicle lands where it is, also on a roof, and without the link the
        # autopilot's own failsafe flies straight home: docs/obstacles.md.
        is_out_of_hand = name in ("lose", "link") and begun
        assert is_out_of_hand or all(keeps(one, where, where, 0.5) for one in obstacles), (name, where)
    for setpoint in sent:
        assert all(keeps(one, setpoint, setpoint, MARGIN_M) for one in obstacles), (name, setpoint)
    for before, after in pairwise(sent):
        assert all(keeps(one, before, after, MARGIN_M) for one in obstacles), (name, before, after)
    assert len(sent) > 1
    return f"{name}: {flight.bridge.phase}: {flight.bridge.reason}"


CASES = {"houses": (HOUSES, RETURNS), "zones": (ZONES, LANDS), "both": (BOTH, EITHER)}


@pytest.mark.parametrize(
    ("what", "seed", "kind"),
    [("houses", 0, "ardupilot"), ("zones", 1, "px4"), ("both", 0, "px4"), ("both", 3, "ardupilot")],
)
def test_no_setpoint_is_within_the_margin(what: str, seed: int, kind: str) -> None:
    fly(seed, kind, *CASES[what])


@pytest.mark.long
def test_no_setpoint_is_within_the_margin_in_a_hundred_faulted_missions() -> None:
    ends = []
    for seed in range(100):
        obstacles, how = list(CASES.values())[seed % 3]
        ends.append(fly(100 + seed, ("ardupilot", "px4")[seed // 3 % 2], obstacles, how))
    assert len({end.partition(":")[0] for end in ends}) == len(FAULTS)
    assert sum(": landed:" in end for end in ends) > 20
    assert sum(": aborted:" in end for end in ends) > 10


def test_the_start_of_a_mission_is_refused_where_its_cells_are_too_near() -> None:
    scenario = field(HOUSES)
    assert cell_conflict(scenario, fence(scenario), RETURNS) is None
    wrong = cell_conflict(scenario, Geofence.around(scenario, 8.0), RETURNS)
    assert wrong is not None
    assert wrong.startswith("obstacles[0]: cell (")
    assert "is nearer than 10 m; expected its clearance_m of at least 10" in wrong
    assert cell_conflict(short(), Geofence.around(short()), RETURNS) is None


HOME = Enu(0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("obstacles", "how", "limits", "message"),
    [
        (HOUSES, {"return_altitude_m": 15.0}, None, None),
        (HOUSES, {"return_altitude_m": 15.0}, Limits(return_altitude_m=15.0), None),
        (HOUSES, {}, None, "obstacles, and bridge.return_altitude_m is not known"),
        (HOUSES, {}, Limits(return_altitude_m=15.0), "RTL_RETURN_ALT) (it reports 15), or bridge"),
        (HOUSES, {"return_altitude_m": 30.0}, Limits(return_altitude_m=15.0), "returns at 15 m above home"),
        (
            HOUSES,
            {"return_altitude_m": 13.0},
            None,
            "expected bridge.return_altitude_m of at least 14, another",
        ),
        (
            ZONES,
            {"return_altitude_m": 90.0},
            None,
            "obstacles[0]: a return from cell (1, 1, 0) at 90 m above",
        ),
        (ZONES, {"failsafe_action": Mode.LAND}, None, None),
        (BOTH, {"return_altitude_m": 15.0, "land_if_return_blocked": True}, None, None),
        (BOTH, {"return_altitude_m": 15.0}, None, "obstacles[1]: a return from cell"),
        (BOTH, {"land_if_return_blocked": True}, None, "bridge.return_altitude_m is not known"),
        (HOUSES, {"failsafe_action": Mode.LAND}, None, "obstacles[0]: a landing from cell (0, 0, 2) comes"),
    ],
)
def test_ways_home_are_compared_with_obstacles(
    obstacles: Any, how: dict[str, Any], limits: Limits | None, message: str | None
) -> None:
    scenario = field(obstacles)
    settings = SafetySettings(**how)
    wrong = return_conflict(scenario, fence(scenario), settings, limits, HOME)
    assert wrong is None if message is None else message in str(wrong)


def test_a_return_that_may_cross_an_obstacle_is_refused_on_the_ground() -> None:
    scenario = field(HOUSES)
    flight = VirtualFlight("ardupilot", SafetySettings(arm=True), scenario, fence=fence(scenario))
    reason = flight.until_over()
    assert "bridge.return_altitude_m is not known" in reason
    assert flight.place_of_grid().up_m < 0.1
    assert not flight.all("armed")


def test_the_fence_keeps_positions_and_ways_away() -> None:
    around = fence(field(HOUSES))
    assert around.breach(Enu(20.0, 0.0, 13.9)) == "nearer than 3 m to obstacles[0]"
    assert around.breach(Enu(20.0, 0.0, 14.0)) is None
    assert around.breach(Enu(29.1, 0.0, 10.0)) is None
    assert around.breach(Enu(28.9, 0.0, 10.0)) == "nearer than 3 m to obstacles[0]"
    assert around.path_breach(Enu(0.0, 0.0, 10.0), Enu(40.0, 0.0, 10.0)) is not None
    assert around.path_breach(Enu(0.0, 0.0, 15.0), Enu(40.0, 0.0, 15.0)) is None
    assert around.path_breach(Enu(0.0, 0.0, 15.0), Enu(40.0, 0.0, 15.0), 2.0) is not None
    assert math.isinf(ZONES[0].top_m)
    assert fence(field(ZONES)).breach(Enu(20.0, 0.0, 20.0)) is not None
