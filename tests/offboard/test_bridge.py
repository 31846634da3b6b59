"""The bridge's decisions, with a simulated vehicle and clock: missions, faults, pilots."""

import dataclasses

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.fake_autopilot.common import way_home
from tests.support.fake_autopilot.simulated import (
    ARMING,
    SCENARIO,
    START,
    Flight,
    Vehicle,
    fly_to_step,
)
from uav_dc_ros.core.grid import Action
from uav_dc_ros.messages import Phase
from uav_dc_ros.offboard.frames import Enu
from uav_dc_ros.offboard.mission.controller import Checkpoint
from uav_dc_ros.offboard.mission.fault_detector import SafetySettings
from uav_dc_ros.offboard.vehicle import Arm, Mode, SetMode, TakeOff


def test_a_whole_mission_from_the_ground_to_the_dock() -> None:
    flight = Flight()
    flight.until(Phase.LANDED)
    phases = list(dict.fromkeys(phase for phase, _, _ in flight.log))
    assert phases == [
        *(Phase.CONNECTING, Phase.PREFLIGHT, Phase.TAKEOFF, Phase.READY, Phase.MOVING),
        *(Phase.LANDING, Phase.LANDED),
    ]
    assert flight.executed == list(range(SCENARIO.mission.max_steps))
    assert flight.bridge.cell[:2] == SCENARIO.dock_cell
    assert flight.vehicle.position.up_m < 0.1
    assert np.allclose(flight.vehicle.position[:2], SCENARIO.mission.dock_m, atol=ARMING.tolerance_m)
    assert not flight.vehicle.armed


def test_without_arm_it_waits_for_a_pilot_and_requests_nothing() -> None:
    flight = Flight(SafetySettings())
    flight.run(100.0)
    assert flight.vehicle.commands == []
    assert flight.bridge.phase is Phase.PREFLIGHT
    flight.vehicle.mode, flight.vehicle.armed = Mode.COMMANDED, True
    flight.until(Phase.LANDED)
    assert not any(
        isinstance(command, Arm) or command == SetMode(Mode.COMMANDED) for command in flight.vehicle.commands
    )


def test_a_vehicle_whose_motors_need_their_time_gets_no_second_take_off_command() -> None:
    flight = Flight()
    flight.until(Phase.TAKEOFF)
    flight.vehicle.ignores_commands = True  # it has received the command, and is still on the ground
    flight.run(2.5)
    assert sum(isinstance(command, TakeOff) for command in flight.vehicle.commands) == 1
    flight.run(1.0)
    assert sum(isinstance(command, TakeOff) for command in flight.vehicle.commands) == 2


def test_a_pilot_who_takes_over_has_it_at_once_and_for_good() -> None:
    flight = fly_to_step(5)
    flight.vehicle.commands.clear()
    flight.vehicle.mode = Mode.OTHER
    flight.run(0.2)
    assert flight.bridge.phase is Phase.ABORTED
    assert "changed by a pilot or by the autopilot's failsafe" in flight.bridge.reason
    flight.vehicle.mode = Mode.COMMANDED
    flight.run(60.0)
    assert flight.bridge.setpoint is None
    assert flight.vehicle.commands == []


@pytest.mark.parametrize("mode", [Mode.RETURN, Mode.LAND])
def test_a_failsafe_is_watched_down_and_not_meddled_with(mode: Mode) -> None:
    flight = fly_to_step(5)
    flight.vehicle.commands.clear()
    flight.vehicle.mode, flight.vehicle.status_text = mode, "GCS Failsafe"
    flight.run(0.2)
    assert flight.bridge.phase is Phase.LANDING
    assert flight.bridge.setpoint is None
    assert (
        "changed by a pilot or by the autopilot's failsafe (autopilot: GCS Failsafe)" in flight.bridge.reason
    )
    flight.until(Phase.ABORTED, 600.0)
    assert flight.vehicle.commands == []
    assert not flight.vehicle.armed


@pytest.mark.parametrize("mode", [Mode.COMMANDED, Mode.OTHER, Mode.HOLD])
def test_a_pilot_may_take_over_a_vehicle_that_comes_down(mode: Mode) -> None:
    flight = fly_to_step(5)
    flight.vehicle.battery = 0.1
    flight.run(1.0)
    assert flight.vehicle.mode is Mode.RETURN
    flight.vehicle.commands.clear()
    flight.vehicle.mode = mode
    flight.run(60.0)
    assert flight.bridge.phase is Phase.ABORTED
    assert "changed by a pilot" in flight.bridge.reason
    assert "after: battery 10%" in flight.bridge.reason
    assert (flight.vehicle.commands, flight.vehicle.mode) == ([], mode)


def test_a_pilot_may_choose_another_way_down() -> None:
    flight = fly_to_step(5, SafetySettings(arm=True, failsafe_action=Mode.LAND))
    flight.vehicle.battery = 0.1
    flight.run(1.0)
    flight.vehicle.commands.clear()
    flight.vehicle.mode = Mode.RETURN
    flight.until(Phase.ABORTED, 600.0)
    assert flight.vehicle.commands == []


def test_a_disarmed_vehicle_is_reported_with_the_status_text() -> None:
    flight = Flight()
    flight.until(Phase.TAKEOFF)
    flight.vehicle.armed, flight.vehicle.mode = False, Mode.COMMANDED
    flight.vehicle.status_text = "Disarming motors"
    flight.run(0.2)
    reason = (
        "disarmed by a pilot or by the autopilot itself in the phase takeoff (autopilot: Disarming motors)"
    )
    assert (flight.bridge.phase, flight.bridge.reason) == (Phase.ABORTED, reason)


def test_a_policy_has_its_time_on_the_clock_that_it_lives_by() -> None:
    """A simulated vehicle fifty times as fast as the clock: 30 s of it are 0.6 s of the policy's."""
    flight = fly_to_step(3)
    flight.policy = None
    flight.until(Phase.READY)
    bridge, known = flight.bridge, flight.vehicle.telemetry
    for tick in range(1, 90):
        now_s = flight.vehicle.now_s + tick / 20
        ahead = dataclasses.replace(
            known, vehicle_s=known.vehicle_s + 50 * tick / 20, heartbeat_s=now_s, position_s=now_s
        )
        bridge.tick(now_s, ahead)
        assert bridge.phase is Phase.READY
    assert 50 * tick / 20 > 7 * 30.0


@pytest.mark.parametrize(
    ("fault", "why"),
    [
        ({"frozen": True}, "no position for 0.5 s"),
        ({"estimate_ok": False}, "lost its position estimate"),
        ({"battery": 0.1}, "battery 10%"),
    ],
)
@pytest.mark.parametrize("then", [Mode.RETURN, Mode.LAND])
def test_a_fault_that_stays_brings_it_down(fault: dict[str, object], why: str, then: Mode) -> None:
    flight = fly_to_step(5, SafetySettings(arm=True, failsafe_action=then))
    for name, value in fault.items():
        setattr(flight.vehicle, name, value)
    flight.until(Phase.ABORTED, 600.0)
    assert why in flight.bridge.reason
    # A vehicle without an estimate cannot return.
    assert flight.vehicle.commands[-1] == SetMode(then if flight.vehicle.estimate_ok else Mode.LAND)
    assert not flight.vehicle.armed


def test_land_is_requested_from_a_vehicle_that_refuses_to_return() -> None:
    flight = fly_to_step(5)
    flight.vehicle.battery, flight.vehicle.refused = 0.1, (Mode.RETURN,)
    flight.until(Phase.ABORTED, 600.0)
    sent = [command for command in flight.vehicle.commands if isinstance(command, SetMode)]
    tries = flight.bridge.settings.max_return_attempts
    assert sent[1:] == [SetMode(Mode.RETURN)] * tries + [SetMode(Mode.LAND)]
    assert "return not executed" in flight.bridge.reason


def test_until_it_obeys_a_vehicle_that_is_to_land_is_held() -> None:
    flight = fly_to_step(5)
    flight.vehicle.battery, flight.vehicle.ignores_commands = 0.1, True
    before = flight.bridge.setpoint
    flight.run(60.0)
    assert flight.bridge.phase is Phase.LANDING
    assert flight.bridge.setpoint == before, "an autopilot may do anything when the stream ends"
    flight.vehicle.ignores_commands = False
    flight.until(Phase.ABORTED, 600.0)


def test_a_link_that_never_comes_back_ends_the_mission_without_a_request() -> None:
    flight = fly_to_step(5)
    flight.vehicle.commands.clear()
    flight.vehicle.silent = True
    flight.until(Phase.ABORTED, 400.0)
    assert "no heartbeat for 300 s" in flight.bridge.reason
    assert flight.vehicle.commands == []


@pytest.mark.parametrize("metres", [30.0, 300.0, 5000.0])  # the last one lies outside the fence
def test_a_jump_is_ignored_then_held_through_then_ends_the_mission(metres: float) -> None:
    flight = fly_to_step(5)
    flight.vehicle.offset = (0.0, metres, 0.0)
    flight.run(0.4)
    assert flight.bridge.fault is None
    assert flight.bridge.detector.discarded["impossible position"] > 0
    flight.run(0.4)
    assert "the position jumped by" in str(flight.bridge.fault)
    flight.vehicle.offset = (0.0, 0.0, 0.0)
    flight.run(0.2)
    assert flight.bridge.fault is None
    if metres > 100.0:
        flight.vehicle.offset = (0.0, metres, 0.0)
        flight.until(Phase.ABORTED, 600.0)
        assert flight.bridge.reason == f"the position jumped by {metres:.0f} m"


def test_a_pilot_who_flies_already_is_left_alone() -> None:
    vehicle = Vehicle(position=Enu(300.0, 300.0, 150.0), mode=Mode.OTHER, armed=True)
    flight = Flight(vehicle=vehicle)
    flight.run(120.0)
    assert vehicle.commands == []
    assert "a pilot flies" in flight.bridge.reason


def test_no_take_off_with_a_low_battery() -> None:
    flight = Flight(vehicle=Vehicle(position=Enu(START.east_m, START.north_m, 0.0), battery=0.1))
    flight.run(60.0)
    assert not flight.vehicle.armed
    assert "battery 10%" in flight.bridge.reason


def test_a_vehicle_that_was_not_seen_for_a_while_has_not_jumped() -> None:
    flight = fly_to_step(5, SafetySettings(arm=True, max_position_jump_m=1.0, position_timeout_s=2.0))
    flight.run(4.0)
    flight.vehicle.frozen = True
    before = flight.vehicle.position
    flight.run(1.5)
    assert np.linalg.norm(np.subtract(flight.vehicle.position, before)) > 10.0
    flight.vehicle.frozen = False
    for _ in range(5):
        flight.tick()
        assert flight.bridge.fault is None


def test_a_short_fault_is_held_through() -> None:
    flight = fly_to_step(5)
    setpoint = flight.bridge.setpoint
    flight.vehicle.frozen = True
    flight.run(2.0)
    assert flight.bridge.fault is not None
    assert flight.bridge.setpoint == setpoint
    flight.vehicle.frozen = False
    flight.until(Phase.LANDED)
    assert flight.executed == list(range(SCENARIO.mission.max_steps))


def test_a_silent_policy_ends_the_mission_after_two_steps() -> None:
    flight = fly_to_step(3)
    flight.policy = None
    flight.until(Phase.LANDING)
    assert flight.bridge.reason == "no move from the policy for 30 s"
    flight.until(Phase.ABORTED)


def test_a_vehicle_that_flies_already_goes_on_where_it_was() -> None:
    vehicle = Vehicle(position=Enu(300.0, 300.0, 150.0), mode=Mode.COMMANDED, armed=True)
    flight = Flight(SafetySettings(), vehicle, checkpoint=Checkpoint(step=7, cell=(3, 3, 1), airborne=True))
    flight.until(Phase.LANDED)
    assert flight.executed == list(range(7, SCENARIO.mission.max_steps))


@settings(max_examples=8, deadline=None, derandomize=True)
@given(at_s=st.floats(0.0, 1000.0), gone_s=st.floats(0.0, 60.0), falls=st.booleans(), pilot=st.booleans())
def test_a_killed_bridge_is_taken_up_again(at_s: float, gone_s: float, falls: bool, pilot: bool) -> None:
    """Whenever it was killed, and whatever the vehicle, its failsafe or a pilot did meanwhile."""
    first = Flight()
    vehicle = first.vehicle
    while vehicle.now_s < at_s and not first.bridge.is_over:
        first.tick(0.2)
    before = first.bridge.phase
    checkpoint = msgspec.json.decode(msgspec.json.encode(first.bridge.checkpoint), type=Checkpoint)
    setpoint = first.bridge.setpoint
    flew = vehicle.armed and not vehicle.on_ground
    if flew and pilot:
        vehicle.mode = Mode.OTHER
    elif flew and falls:
        vehicle.mode = Mode.LAND
    vehicle.pass_time(0.1, setpoint)
    for _ in range(round(gone_s)):
        vehicle.pass_time(1.0, setpoint)  # it goes on to its last setpoint
    n_sent = len(vehicle.commands)
    second = Flight(ARMING, vehicle, checkpoint=checkpoint)
    while not second.bridge.is_over and vehicle.now_s < 4000.0:
        second.tick(0.2)
    assert second.bridge.is_over, second.log[-3:]
    flown = first.executed + second.executed
    assert flown == sorted(set(flown)), "no step twice"
    if flew:
        assert Arm() not in vehicle.commands[n_sent:], "never armed a second time"
        if pilot:
            assert not vehicle.commands[n_sent:], "never a fight with the pilot"
            assert second.bridge.phase is Phase.ABORTED
        elif not falls and before in (Phase.TAKEOFF, Phase.READY, Phase.MOVING):
            assert second.bridge.phase is Phase.LANDED, second.log[-3:]
            assert flown == list(range(len(flown)))


def test_a_bridge_that_comes_back_to_a_vehicle_outside_the_fence_brings_it_home() -> None:
    vehicle = Vehicle(position=Enu(2000.0, 300.0, 150.0), mode=Mode.COMMANDED, armed=True)
    flight = Flight(ARMING, vehicle, checkpoint=Checkpoint(step=7, cell=(3, 3, 1), airborne=True))
    flight.until(Phase.ABORTED)
    assert flight.executed == []
    assert flight.bridge.reason.startswith("outside the fence when the bridge restarted: 2000.0 m east")
    assert SetMode(Mode.RETURN) in vehicle.commands


def test_a_bridge_that_comes_back_knows_its_battery() -> None:
    """Whose charge the autopilot counts wrongly: what its voltage was at rest is kept."""
    first = Flight(vehicle=Vehicle(position=Enu(START.east_m, START.north_m, 0.0), battery_v=12.6))
    first.until(Phase.MOVING)
    first.vehicle.battery, first.vehicle.battery_v = 0.0, 12.3
    second = Flight(ARMING, first.vehicle, checkpoint=first.bridge.checkpoint)
    second.until(Phase.LANDED)


def test_a_vehicle_that_flies_already_lands_where_that_is_wanted() -> None:
    vehicle = Vehicle(position=Enu(300.0, 300.0, 150.0), mode=Mode.COMMANDED, armed=True)
    flight = Flight(SafetySettings(flying_at_start="land"), vehicle)
    flight.until(Phase.ABORTED)
    assert flight.executed == []
    assert not vehicle.armed


@pytest.mark.parametrize("mode", [Mode.RETURN, Mode.OTHER])
def test_a_vehicle_that_another_pilot_flew_is_not_armed_again(mode: Mode) -> None:
    """One that returns while a bridge is restarted, for example: it must not take off again by itself."""
    vehicle = Vehicle(position=Enu(300.0, 300.0, 50.0), mode=mode, armed=True)
    flight = Flight(ARMING, vehicle)
    flight.run(20.0)
    vehicle.mode = Mode.LAND
    flight.run(60.0)
    assert not vehicle.armed
    assert vehicle.commands == []
    assert flight.bridge.reason == "a pilot had control: waiting for a pilot to set the mode and arm"
    vehicle.mode, vehicle.armed = Mode.COMMANDED, True
    flight.until(Phase.LANDED)


def test_moves_out_of_turn_change_nothing() -> None:
    flight = fly_to_step(5)
    before = flight.bridge.progress.goal, flight.bridge.setpoint
    assert "expected it to be ready" in str(flight.bridge.move(5, Action.UPWARD))
    flight.policy = None
    flight.until(Phase.READY)
    assert flight.bridge.move(5, Action.UPWARD) == "a move for step 5; expected 6"
    assert (flight.bridge.progress.goal, flight.bridge.setpoint) == before


FAULTS = st.sampled_from(
    ["frozen", "silent", "ignores_commands", "estimate", "battery", "pilot", "disarmed", "blown", "policy"]
)


@settings(max_examples=8, deadline=None, derandomize=True)
@given(fault=FAULTS, at_s=st.floats(0.0, 500.0), lasts_s=st.floats(0.1, 60.0))
def test_whatever_goes_wrong_has_an_end(fault: str, at_s: float, lasts_s: float) -> None:
    flight = Flight()
    vehicle = flight.vehicle
    healed = False
    while not flight.bridge.is_over and vehicle.now_s < 4000.0:
        if at_s <= vehicle.now_s < at_s + lasts_s:
            match fault:
                case "frozen" | "silent" | "ignores_commands":
                    setattr(vehicle, fault, True)
                case "estimate":
                    vehicle.estimate_ok = False
                case "battery":
                    vehicle.battery = 0.15
                case "pilot":
                    vehicle.mode = Mode.OTHER
                case "disarmed":
                    vehicle.armed = False
                case "blown":
                    vehicle.position = vehicle.position._replace(east_m=2000.0)
                case "policy":
                    flight.policy = None
        elif vehicle.now_s >= at_s + lasts_s and not healed:
            vehicle.frozen = vehicle.silent = vehicle.ignores_commands = False
            vehicle.estimate_ok, flight.policy, healed = True, way_home, True
            vehicle.battery = 1.0  # on the ground, it waits for a full one
        flight.tick(0.2)
    waits = flight.bridge.phase is Phase.CONNECTING and not vehicle.armed  # blown away before it began
    assert flight.bridge.is_over or waits, flight.log[-3:]
    assert flight.bridge.reason
    assert flight.executed == sorted(set(flight.executed)), "no step twice"
