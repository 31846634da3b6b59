"""What a mission must not overlook in the air: wind, crashes, ignored targets, lost links, slow steps."""

import dataclasses
import math

import msgspec
import numpy as np
import pytest

from tests.support.fake_autopilot.simulated import ARMING, SCENARIO, START, Flight, Vehicle, fly_to_step
from uav_dc_ros.messages import FaultKind, Phase
from uav_dc_ros.offboard.frames import Enu
from uav_dc_ros.offboard.mission.controller import Checkpoint
from uav_dc_ros.offboard.mission.fault_detector import SafetySettings
from uav_dc_ros.offboard.mission.geofence import Geofence
from uav_dc_ros.offboard.vehicle import Limits, Mode, SetMode, TakeOff, Telemetry

GROUND = Enu(START.east_m, START.north_m, 0.0)
STEP_S = SCENARIO.mission.step_s


# Landed is where the dock is.


def test_who_lands_away_from_the_dock_has_not_landed() -> None:
    """Blown away from it during the landing, for example."""
    flight = Flight()
    flight.until(Phase.LANDING)
    flight.vehicle.wind_mps = (0.5, 0.0)
    flight.until(Phase.ABORTED)
    away_m = math.dist(flight.vehicle.position[:2], SCENARIO.mission.dock_m)
    assert away_m > 40.0
    assert flight.bridge.reason == (
        f"step 60: at the dock (cell reached); landed {away_m:.0f} m from the dock; expected at most 5 m"
    )


def test_a_circle_that_the_autopilot_keeps_in_silence_is_noticed() -> None:
    """Its fence is smaller than the field, and it reports neither that nor its target."""
    flight = Flight()
    vehicle = flight.vehicle
    vehicle.fence_m = 450.0
    vehicle.reports_target = False
    flight.until(Phase.LANDING)
    assert flight.bridge.reason == "no nearer to cell (5, 0, 2) for 5 s, 100 m away from it"
    assert (flight.bridge.step, flight.bridge.progress.steps_not_reached) == (4, 0)
    flight.until(Phase.ABORTED)


def test_messages_after_the_heartbeat_that_reports_disarming_are_waited_for() -> None:
    flight = Flight()
    flight.until(Phase.LANDING)
    while flight.vehicle.position.up_m > 2.0:
        flight.tick()
    flight.vehicle.frozen = True
    while flight.vehicle.armed:
        flight.tick()
    flight.run(1.0)
    assert flight.bridge.phase is Phase.LANDING
    flight.vehicle.frozen = False
    flight.vehicle.pass_time(0.1, None)
    flight.tick(known=dataclasses.replace(flight.vehicle.telemetry, on_ground=False))
    assert flight.bridge.phase is Phase.LANDING
    flight.until(Phase.LANDED, 1.0)


def test_a_landing_without_a_position_is_none() -> None:
    flight = Flight()
    flight.until(Phase.LANDING)
    flight.vehicle.frozen = True
    flight.until(Phase.ABORTED)
    assert flight.bridge.reason.endswith("disarmed at an unknown position")


def test_a_bridge_that_was_killed_while_it_landed_judges_where_the_vehicle_stands() -> None:
    flight = Flight()
    flight.until(Phase.LANDING)
    checkpoint = msgspec.json.decode(msgspec.json.encode(flight.bridge.checkpoint), type=Checkpoint)
    for off_m, phase in ((0.0, Phase.LANDED), (40.0, Phase.ABORTED)):
        place = Enu(SCENARIO.mission.dock_m[0] - off_m, SCENARIO.mission.dock_m[1], 0.0)
        again = Flight(ARMING, Vehicle(position=place, mode=Mode.LAND), checkpoint=checkpoint)
        again.until(phase, 10.0)


# The autopilot's own limits.


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        (Limits(fence_radius_m=300.0), ("300 m from home", "1000 m east, 1000 m north is 1414 m", "1416 m")),
        (Limits(fence_ceiling_m=100.0), ("ends 100 m above home", "200 m", "FENCE_ALT_MAX")),
        (Limits(fence_floor_m=120.0), ("begins 120 m above home", "100 m", "FENCE_ALT_MIN")),
    ],
)
@pytest.mark.parametrize("how", [ARMING, SafetySettings()])
def test_a_field_that_the_autopilot_s_fence_does_not_hold_is_refused(
    limits: Limits, words: tuple[str, ...], how: SafetySettings
) -> None:
    flight = Flight(how, Vehicle(position=GROUND, limits=limits))
    flight.run(5.0)
    assert flight.bridge.phase is Phase.ABORTED
    assert [word for word in words if word not in flight.bridge.reason] == []
    assert flight.vehicle.commands == []


def test_home_counts_where_the_vehicle_stands_now_and_where_it_was_armed() -> None:
    limits = Limits(fence_radius_m=1420.0, fence_ceiling_m=205.0)
    flight = Flight(vehicle=Vehicle(position=GROUND, limits=limits, home=Enu(5000.0, 0.0, 0.0)))
    flight.until(Phase.MOVING)
    flight = Flight(SafetySettings(), Vehicle(position=GROUND, limits=limits))
    flight.run(2.0)
    flight.vehicle.mode, flight.vehicle.armed = Mode.COMMANDED, True
    flight.vehicle.home = Enu(5000.0, 0.0, 0.0)
    flight.until(Phase.ABORTED)
    assert flight.vehicle.commands == [SetMode(Mode.LAND)]
    assert "1420 m from home" in flight.bridge.reason


@pytest.mark.parametrize("limits", [None, Limits(), Limits(fence_radius_m=2000.0, fence_ceiling_m=500.0)])
def test_limits_that_fit_or_are_not_reported_are_no_reason_not_to_fly(limits: Limits | None) -> None:
    flight = Flight(vehicle=Vehicle(position=GROUND, limits=limits))
    flight.until(Phase.MOVING)
    assert flight.bridge.warnings == []


def test_steps_that_the_vehicle_s_speeds_do_not_allow_are_reported_before_take_off() -> None:
    limits = Limits(speed_mps=10.0, climb_mps=2.5, descent_mps=1.5, polygon_fence=True)
    flight = Flight(vehicle=Vehicle(position=GROUND, limits=limits))
    flight.until(Phase.TAKEOFF)
    slow = "a layer up takes 20 s at 2.5 m/s, a layer down takes 34 s at 1.5 m/s, and a step has 15 s"
    fence = "the autopilot has a fence of another shape, which was not compared with the field"
    assert flight.bridge.warnings == [fence, slow]
    assert (Phase.PREFLIGHT, 0, f"sets the mode and arms; {fence}; {slow}") in flight.log


# Steps.


def slowly(speed_mps: float, **more: float) -> Flight:
    flight = Flight(SafetySettings(arm=True, takeoff_timeout_s=3000.0, **more))  # type: ignore[arg-type]
    flight.vehicle.speeds_mps["across"] = speed_mps
    return flight


def test_a_step_that_is_late_goes_on_until_the_goal_is_the_nearest_cell() -> None:
    flight = slowly(2.5)  # 37.5 m of 100 m within a step
    flight.until(Phase.LANDED, 6000.0)
    assert flight.executed == list(range(SCENARIO.mission.max_steps))
    assert max(flight.ended_m) <= math.hypot(50.0, 50.0, 25.0)
    assert (
        flight.bridge.progress.steps_not_reached == sum(m > ARMING.tolerance_m for m in flight.ended_m) > 10
    )
    assert any("flies on" in reason for _, _, reason in flight.log)


def test_how_many_steps_were_not_reached_is_known_after_a_restart() -> None:
    flight = slowly(4.0)
    while flight.bridge.step < 4:
        flight.tick()
    missed = flight.bridge.progress.steps_not_reached
    assert missed >= 3
    again = Flight(ARMING, flight.vehicle, checkpoint=flight.bridge.checkpoint)
    assert again.bridge.progress.steps_not_reached == missed


def test_a_step_that_ends_at_the_dock_is_flown_to_its_end() -> None:
    """Half a cell away counts elsewhere; who lands there has not landed."""
    scenario = msgspec.structs.replace(
        SCENARIO, mission=msgspec.structs.replace(SCENARIO.mission, episode_end="on_arrival")
    )
    flight = Flight(SafetySettings(arm=True), scenario=scenario)
    flight.vehicle.speeds_mps["across"] = 4.0
    flight.until(Phase.LANDED)
    assert flight.bridge.step == 20
    assert flight.ended_m[-1] <= ARMING.landing_radius_m < flight.ended_m[-2]


@pytest.mark.parametrize("stuck", [True, False])
def test_a_step_that_gets_no_nearer_is_held_then_given_up(stuck: bool) -> None:
    flight = fly_to_step(5)
    flight.vehicle.stuck = True
    flight.run(STEP_S + 3.0)
    assert "no nearer to cell" in str(flight.bridge.fault)
    if not stuck:
        flight.vehicle.stuck = False
        flight.until(Phase.LANDED)
        assert flight.executed == list(range(SCENARIO.mission.max_steps))
        return
    flight.until(Phase.LANDING, 10.0)
    assert flight.bridge.step == 5
    flight.vehicle.stuck = False
    flight.until(Phase.ABORTED)
    assert "no nearer to cell" in flight.bridge.reason


def test_a_move_that_an_earlier_bridge_began_counts_once_it_is_flown() -> None:
    flight = fly_to_step(5)
    again = Flight(ARMING, flight.vehicle, checkpoint=flight.bridge.checkpoint)
    again.until(Phase.TAKEOFF)
    assert again.bridge.step == 5
    again.until(Phase.MOVING)
    assert again.bridge.step == 6
    again.until(Phase.LANDED)
    assert flight.executed + again.executed == list(range(SCENARIO.mission.max_steps))


# Crashes.


@pytest.mark.parametrize("phase", [Phase.TAKEOFF, Phase.MOVING])
@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        ({"tilt_rad": math.radians(100.0)}, "tilted by 100 degrees; expected at most 70"),
        ({"falls": True}, "m too low; expected at most 10 m"),
    ],
)
def test_a_vehicle_that_does_not_fly_any_more_ends_the_mission_at_once(
    phase: Phase, fault: dict[str, object], reason: str
) -> None:
    flight = Flight()
    flight.until(phase)
    flight.run(12.0 if phase is Phase.TAKEOFF else 3.0)
    assert flight.bridge.phase is phase
    for name, value in fault.items():
        setattr(flight.vehicle, name, value)
    flight.until(Phase.LANDING, 5.0)
    assert reason in flight.bridge.reason
    flight.run(1.0)
    assert flight.vehicle.mode is Mode.LAND
    flight.until(Phase.ABORTED, 200.0)


def test_a_vehicle_that_stands_where_it_should_fly_ends_the_mission_at_once() -> None:
    flight = fly_to_step(3, SafetySettings(arm=True, max_sink_m=1000.0))
    flight.vehicle.stuck = True
    while flight.vehicle.position.up_m > 0.0:
        up_m = max(0.0, flight.vehicle.position.up_m - 1.8)
        flight.vehicle.position = flight.vehicle.position._replace(up_m=up_m)
        flight.tick()
    flight.run(2.0)
    assert flight.bridge.reason.startswith("on the ground while it should fly")


def test_a_vehicle_that_has_come_down_after_take_off_gets_no_take_off_command_again() -> None:
    flight = Flight(SafetySettings(arm=True, max_sink_m=1000.0))
    flight.until(Phase.TAKEOFF)
    flight.run(10.0)
    flight.vehicle.commands.clear()
    flight.vehicle.falls = True
    flight.until(Phase.ABORTED, 20.0)
    assert not any(isinstance(command, TakeOff) for command in flight.vehicle.commands)
    assert flight.bridge.reason.startswith("on the ground while it should fly")


def test_a_gust_and_a_short_tilt_are_no_crash() -> None:
    flight = fly_to_step(3)
    flight.vehicle.tilt_rad = 1.5
    flight.run(0.9)
    flight.vehicle.tilt_rad = 0.1
    flight.run(0.9)
    flight.vehicle.position = flight.vehicle.position._replace(up_m=flight.vehicle.position.up_m - 4.0)
    flight.until(Phase.LANDED)


@pytest.mark.parametrize("lost", [2, 3])
def test_commands_to_take_off_that_are_lost_are_repeated_before_the_autopilot_disarms(lost: int) -> None:
    class Lossy(Vehicle):
        lost = 0
        stands_s = 0.0

        def send_command(self, command: object) -> None:
            if isinstance(command, TakeOff) and self.lost:
                self.lost -= 1
                self.commands.append(command)
            else:
                super().send_command(command)  # type: ignore[arg-type]

        def pass_time(self, seconds: float, setpoint: Enu | None) -> None:
            super().pass_time(seconds, setpoint)
            self.stands_s = self.stands_s + seconds if self.armed and self.on_ground else 0.0
            if self.stands_s > 10.0:
                self.armed = False

    flight = Flight(vehicle=Lossy(position=GROUND))
    flight.vehicle.lost = lost  # type: ignore[attr-defined]
    flight.until(Phase.MOVING)


# Returns.


@pytest.mark.parametrize("wind_mps", [14.0, 20.0, 25.0])
@pytest.mark.parametrize("reports_home", [True, False])
def test_a_return_that_does_not_come_home_lands(wind_mps: float, reports_home: bool) -> None:
    """Wind outdoes the vehicle, from take-off on."""
    vehicle = Vehicle(position=GROUND, wind_mps=(wind_mps, 0.0))
    if not reports_home:
        report = vehicle._report
        vehicle._report = lambda: (
            report(),
            setattr(vehicle, "telemetry", dataclasses.replace(vehicle.telemetry, home=None)),
        )  # type: ignore[method-assign,assignment,func-returns-value]
    flight = Flight(SafetySettings(arm=True, max_speed_mps=30.0), vehicle)
    flight.until(Phase.LANDING)
    begun_s = vehicle.now_s
    flight.until(Phase.ABORTED)
    assert vehicle.now_s - begun_s < 35.0 + 30.0 + 210.0 / 1.5
    assert [
        command for command in vehicle.commands if command in (SetMode(Mode.RETURN), SetMode(Mode.LAND))
    ] == [
        SetMode(Mode.RETURN),
        SetMode(Mode.LAND),
    ]
    assert "outside the fence" in flight.bridge.reason
    assert "return makes no progress for 30 s (" in flight.bridge.reason
    assert not vehicle.armed


def test_a_return_that_a_pilot_chose_is_only_monitored_and_ends_all_the_same() -> None:
    flight = fly_to_step(5)
    flight.vehicle.commands.clear()
    flight.vehicle.mode, flight.vehicle.wind_mps = Mode.RETURN, (20.0, 0.0)
    flight.until(Phase.ABORTED, 60.0)
    assert "return makes no progress" in flight.bridge.reason
    assert flight.vehicle.commands == []


@pytest.mark.parametrize("obeys", [True, False])
def test_a_landing_that_comes_no_lower_has_an_end(obeys: bool) -> None:
    flight = fly_to_step(5, SafetySettings(arm=True, failsafe_action=Mode.LAND))
    flight.vehicle.battery, flight.vehicle.stuck, flight.vehicle.ignores_commands = 0.1, True, not obeys
    flight.until(Phase.ABORTED, 200.0)
    mode = "LAND" if obeys else "COMMANDED"
    assert f"in mode {mode} neither descended nor disarmed for 120 s" in flight.bridge.reason
    assert flight.bridge.reason.startswith("battery 10%")


def test_a_way_home_longer_than_the_limit_is_no_stall() -> None:
    flight = fly_to_step(18)
    flight.vehicle.battery = 0.1
    flight.until(Phase.ABORTED)
    assert np.allclose(flight.vehicle.position, GROUND, atol=1.0)
    assert flight.bridge.reason.startswith("battery 10%")
    assert SetMode(Mode.LAND) not in flight.vehicle.commands


def test_a_vehicle_whose_clock_stands_has_an_end() -> None:
    flight = fly_to_step(5)
    stands_s = flight.vehicle.now_s
    while not flight.bridge.is_over:
        assert flight.vehicle.now_s < stands_s + 1000.0
        flight.tick(known=dataclasses.replace(flight.vehicle.telemetry, vehicle_s=stands_s))
    assert "time has not advanced" in flight.bridge.reason


# Links.


def cut(flight: Flight, seconds: float) -> None:
    """Nothing comes for a time; then heartbeats, and a second later all the rest."""
    vehicle = flight.vehicle
    vehicle.silent = True
    flight.run(seconds)
    before = vehicle.telemetry
    vehicle.silent = False
    for _ in range(10):
        flight.tick(known=dataclasses.replace(before, heartbeat_s=vehicle.now_s, vehicle_s=vehicle.now_s))


@pytest.mark.parametrize("fault_timeout_s", [1.0, 1.5, 3.1, 5.0, 8.0])
@pytest.mark.parametrize("seconds", [9.0, 30.0])
def test_after_a_lost_link_the_failsafe_that_was_chosen_is_requested(
    fault_timeout_s: float, seconds: float
) -> None:
    flight = fly_to_step(5, SafetySettings(arm=True, fault_timeout_s=fault_timeout_s))
    flight.vehicle.commands.clear()
    cut(flight, seconds)
    flight.until(Phase.ABORTED)
    assert flight.vehicle.commands[0] == SetMode(Mode.RETURN)
    assert SetMode(Mode.LAND) not in flight.vehicle.commands
    assert flight.bridge.reason == "link lost: no heartbeat for 3 s"


def test_a_link_that_comes_back_in_time_is_held_through() -> None:
    flight = fly_to_step(5, SafetySettings(arm=True, fault_timeout_s=20.0))
    cut(flight, 10.0)
    assert (flight.bridge.fault_kind, flight.bridge.reason) == (
        FaultKind.LINK, "link lost: no heartbeat for 3 s",
    )  # fmt: skip
    flight.until(Phase.LANDED)
    assert flight.bridge.fault_kind is None
    assert any(reason == "resumed after: link lost: no heartbeat for 3 s" for _, _, reason in flight.log)


@pytest.mark.parametrize("reports", [True, False])
def test_an_estimate_that_is_lost_while_heartbeats_come_makes_it_land(reports: bool) -> None:
    """It is reported as bad, or reports of it do not come any more."""
    flight = fly_to_step(5)
    vehicle = flight.vehicle
    link_lost_timeout_s = vehicle.now_s
    while not flight.bridge.is_over:
        known = dataclasses.replace(vehicle.telemetry, estimate_ok=False)
        if not reports:
            silent = vehicle.now_s - link_lost_timeout_s > 3.0
            known = dataclasses.replace(known, estimate_ok=not silent, estimate_s=link_lost_timeout_s)
        flight.tick(known=known)
    assert flight.bridge.reason == "the autopilot has lost its position estimate"
    assert vehicle.commands[-1] == SetMode(Mode.LAND)


def test_telemetry_without_a_position_ends_nothing_by_an_exception() -> None:
    """One datagram that came late made the transport forget all positions, with a fresh time."""
    for phase in (Phase.TAKEOFF, Phase.MOVING):
        flight = Flight()
        flight.until(phase)
        flight.run(2.0)
        flight.tick(known=dataclasses.replace(flight.vehicle.telemetry, position=None))
        flight.tick(known=dataclasses.replace(flight.vehicle.telemetry, position=None, position_s=None))
        flight.tick(known=Telemetry(heartbeat_s=flight.vehicle.now_s, armed=True, mode=Mode.COMMANDED))
        assert flight.bridge.phase is phase
        flight.until(Phase.LANDED)


@pytest.mark.parametrize("margin_m", [1.0, 20.0, 300.0])
def test_the_fence_lies_as_far_above_the_grid_as_around_it(margin_m: float) -> None:
    fence = Geofence.around(SCENARIO, margin_m)
    assert fence.upper == Enu(1000.0 + margin_m, 1000.0 + margin_m, 200.0 + margin_m)
