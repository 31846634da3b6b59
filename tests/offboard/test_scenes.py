"""Scenes of whole flights, in the vehicle's time: odd telemetry, low voltage, others on the link.

And what real flights broke: each ends on the ground or with a pilot, in bounded time, with a reason.
"""

import random
from collections.abc import Iterable

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.fake_autopilot.autopilot import Autopilot
from tests.support.fake_autopilot.copter import Copter
from tests.support.fake_autopilot.flight import KINDS
from tests.support.fake_autopilot.virtual import VirtualFlight, short
from uav_dc_ros.core.grid import Action
from uav_dc_ros.messages import Phase
from uav_dc_ros.offboard.mission.controller import MissionController
from uav_dc_ros.offboard.mission.fault_detector import SafetySettings

STEPS = list(range(6))


def check_landed(flight: VirtualFlight) -> None:
    """It flew each step once, and landed at the dock."""
    assert flight.bridge.phase is Phase.LANDED, flight.log[-5:]
    assert flight.executed == STEPS
    assert len(flight.all("armed")) == 1
    assert not flight.copter.armed
    assert flight.dock_distance_m() < flight.bridge.settings.tolerance_m


def check_aborted(flight: VirtualFlight, *causes: str) -> None:
    """It ended on the ground, disarmed, and the reason names the cause."""
    assert flight.bridge.phase is Phase.ABORTED, flight.log[-5:]
    assert all(cause in flight.bridge.reason for cause in causes), flight.bridge.reason
    assert (flight.copter.landed, flight.copter.armed) == (True, False)
    assert len(flight.all("armed")) <= 1


def moving(flight: VirtualFlight, step: int = 1) -> None:
    """Fly until it is on its way at a step."""
    flight.until(lambda: flight.bridge.phase is Phase.MOVING and flight.bridge.step == step)


class Unreliable:
    """A link on which single messages are lost, late, repeated or broken."""

    def __init__(self, seed: int, share: float) -> None:
        self.dice, self.share = random.Random(seed), share
        self.later: list[tuple[float, bytes]] = []
        self.flight: VirtualFlight | None = None

    def __call__(self, sent: list[bytes], now_s: float) -> Iterable[bytes]:
        assert self.flight is not None
        if self.dice.random() < self.share / 5:
            self.flight.do(self.dice.choice(["zero_time", "nonsense"]))
        arrives = [data for due_s, data in self.later if due_s <= now_s]
        self.later = [(due_s, data) for due_s, data in self.later if due_s > now_s]
        for data in sent:
            fate = self.dice.choice(["late", "twice", "lost"]) if self.dice.random() < self.share else ""
            if fate == "late":
                self.later.append((now_s + self.dice.uniform(0.1, 3.0), data))
            else:
                arrives += [data] * {"twice": 2, "lost": 0}.get(fate, 1)
        self.dice.shuffle(arrives)
        return arrives


@settings(max_examples=6, deadline=None, derandomize=True)
@given(kind=st.sampled_from(KINDS), seed=st.integers(0, 2**32), share=st.floats(0.0, 0.1))
def test_a_mission_is_flown_whatever_happens_to_single_messages(kind: str, seed: int, share: float) -> None:
    channel = Unreliable(seed, share)
    flight = channel.flight = VirtualFlight(kind, channel=channel)
    flight.until_over()
    check_landed(flight)
    if share > 0.01:
        assert {"late", "repeated"} <= flight.telemetry.discarded.keys()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("line", ["late_position 1.5", "late_position 4", "zero_time", "nonsense", "twice 1"])
def test_one_odd_message_does_nothing(kind: str, line: str) -> None:
    flight = VirtualFlight(kind)
    moving(flight)
    flight.do(line)
    flight.until_over()
    check_landed(flight)
    assert sum(flight.telemetry.discarded.values()) >= 1
    assert not any(reason.startswith("resumed after") for _, _, reason in flight.log)


@pytest.mark.parametrize("kind", KINDS)
def test_low_voltage_brings_it_home_though_the_count_is_high(kind: str) -> None:
    flight = VirtualFlight(kind, scenario=short(20))
    moving(flight)
    flight.do("volts 9.0")
    begun_s = flight.copter.t_s
    flight.until(lambda: flight.bridge.phase is Phase.LANDING)
    assert flight.copter.t_s - begun_s < 16.0
    reason = flight.until_over()
    assert flight.bridge.phase is Phase.ABORTED
    assert "12.6 V at rest" in reason
    assert "under load" in reason or "9.0 V" in reason
    assert flight.copter.charge > 0.8
    assert not flight.copter.armed


@pytest.mark.parametrize("kind", KINDS)
def test_a_short_sag_of_the_voltage_does_nothing(kind: str) -> None:
    flight = VirtualFlight(kind)
    moving(flight)
    flight.do("volts 9.5")
    flight.run(4.0)
    flight.do("volts none")
    flight.until_over()
    check_landed(flight)


@pytest.mark.parametrize("speed", [1.0, 8.0, 30.0])
def test_the_failsafe_for_the_ground_station_stays_calm_at_any_speed_of_the_simulator(speed: float) -> None:
    flight = VirtualFlight("ardupilot", SafetySettings(arm=True, heartbeat_timeout_s=3.0), speed=speed)
    flight.do("param FS_GCS_ENABLE 1")
    flight.until_over()
    check_landed(flight)


@pytest.mark.parametrize("kind", KINDS)
def test_a_second_vehicle_on_the_link_is_left_alone(kind: str) -> None:
    """It sends first; the own one stays on the ground while none is selected."""
    flight = VirtualFlight(kind)
    flight.autopilot.other = Autopilot(Copter(kind, 0.0, "second "), 7)
    flight.run(60.0)
    assert flight.bridge.phase is Phase.CONNECTING
    assert "2 autopilots on this link: system 7" in flight.bridge.reason
    assert flight.all("command") == []
    flight = VirtualFlight(kind, system=1)
    flight.autopilot.other = other = Autopilot(Copter(kind, 0.0, "second "), 7)
    flight.until_over()
    check_landed(flight)
    named = f"connected to system 1, {'PX4' if kind == 'px4' else 'ArduCopter'}"
    assert (Phase.PREFLIGHT, 0, named) in flight.log, "console and bag name the selected vehicle"
    assert (other.copter.armed, other.setpoints) == (False, 0)


@pytest.mark.parametrize("kind", KINDS)
def test_a_second_bridge_is_known_before_anybody_can_arm(kind: str) -> None:
    flight = VirtualFlight(kind)
    flight.do("second_bridge_heartbeats 1")
    flight.until(lambda: flight.telemetry.snapshot(flight.now_s).missing is None)
    found = str(flight.telemetry.snapshot(flight.now_s).other_controller)
    assert found.startswith("heartbeats of system 255, component 191")
    assert not flight.copter.armed


@pytest.mark.parametrize("kind", KINDS)
def test_after_a_lost_link_the_report_on_the_estimate_is_older_than_the_heartbeat(kind: str) -> None:
    """The estimate is not lost: nothing was reported."""
    flight = VirtualFlight(kind)
    moving(flight)
    flight.link_is_up = False
    flight.run(4.0)
    known = flight.telemetry.snapshot(flight.now_s)
    assert known.estimate_s is not None
    assert known.heartbeat_s is not None
    assert flight.now_s - known.estimate_s == pytest.approx(4.0, abs=0.3)
    assert flight.now_s - known.heartbeat_s == pytest.approx(4.5, abs=0.6)
    flight.link_is_up = True
    flight.run(1.2)
    known = flight.telemetry.snapshot(flight.now_s)
    assert known.estimate_ok
    assert flight.now_s - (known.estimate_s or 0.0) < 0.3


# What real flights broke.


@pytest.mark.parametrize("kind", KINDS)
def test_wind_that_outdoes_the_vehicle_ends_with_a_landing_where_it_is(kind: str) -> None:
    flight = VirtualFlight(kind, scenario=short(20))
    moving(flight)
    flight.do("wind 20 0")
    flight.until_over(120.0)
    check_aborted(flight, "no nearer to cell", "return makes no progress", "requests land")
    returns, lands = ("RTL", "LAND") if kind == "ardupilot" else ("AUTO.RTL", "AUTO.LAND")
    assert [event["mode"] for event in flight.all("mode")][-2:] == [returns, lands]


def fence_in(flight: VirtualFlight, kind: str) -> None:
    """An autopilot's own circle around home, smaller than the field."""
    px4, ardupilot = ("param GF_MAX_HOR_DIST 30",), ("param FENCE_ENABLE 1", "param FENCE_RADIUS 30")
    for line in px4 if kind == "px4" else ardupilot:
        flight.do(line)


@pytest.mark.parametrize("kind", KINDS)
def test_an_autopilot_s_fence_inside_the_field_is_refused_before_take_off(kind: str) -> None:
    flight = VirtualFlight(kind)
    fence_in(flight, kind)
    flight.until_over(30.0)
    check_aborted(flight, "circular fence ends 30 m from home", "expected at least 285 m")
    assert flight.all("armed") == []


@pytest.mark.parametrize(
    ("kind", "cause"), [("ardupilot", "does not accept the setpoint"), ("px4", "AUTO.RTL: changed by")]
)
def test_an_autopilot_s_fence_that_comes_in_flight_is_noticed(kind: str, cause: str) -> None:
    """ArduCopter ignores a target outside in silence; PX4 returns, and reports it."""
    flight = VirtualFlight(kind, scenario=short(20))
    moving(flight, 0)
    fence_in(flight, kind)
    flight.until_over(120.0)
    check_aborted(flight, cause)
    assert flight.bridge.progress.steps_not_reached == 0


@pytest.mark.parametrize("kind", KINDS)
def test_a_motor_that_fails_ends_the_mission_within_seconds(kind: str) -> None:
    """The autopilot stays armed: the wreck does not end it."""
    flight = VirtualFlight(kind, scenario=short(20))
    moving(flight)
    flight.do("motor 600")
    begun_s = flight.copter.t_s
    flight.until(lambda: flight.bridge.phase is Phase.LANDING, 5.0)
    flight.until_over(150.0)
    assert flight.bridge.phase is Phase.ABORTED
    assert "too low; expected at most 10 m" in flight.bridge.reason
    assert flight.copter.t_s - begun_s < 150.0
    assert flight.bridge.step == 1, "no step counts that was not flown"


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("line", ["second_bridge_heartbeats 1", "second_bridge_acks 1"])
def test_a_second_bridge_is_refused_before_take_off(kind: str, line: str) -> None:
    flight = VirtualFlight(kind)
    flight.do("lose 1")  # not ready yet: there is time to listen
    flight.do(line)
    flight.run(15.0)
    flight.do("lose 0")
    flight.until_over(10.0)
    check_aborted(flight, "another system commands this vehicle: ")
    assert flight.all("armed") == []
    assert flight.all("mode") == []


@pytest.mark.parametrize("kind", KINDS)
def test_a_second_bridge_that_comes_in_flight_is_reported(kind: str) -> None:
    flight = VirtualFlight(kind, scenario=short(20))
    moving(flight)
    flight.do("second_bridge_target 30 30 -15")
    flight.until_over(300.0)
    assert any("another system commands this vehicle: position targets" in why for _, _, why in flight.log)
    assert not flight.copter.armed
    assert flight.bridge.progress.steps_not_reached == 0, "no step counts that was not flown"


@pytest.mark.parametrize("kind", KINDS)
def test_who_switches_the_mode_on_the_ground_has_the_vehicle(kind: str) -> None:
    flight = VirtualFlight(kind)
    flight.do("balk 1")
    flight.until(lambda: flight.bridge.reason.startswith("arming refused"), 60.0)
    mode = "POSCTL" if kind == "px4" else "LOITER"
    flight.do(f"mode {mode}")
    flight.do("balk 0")
    flight.until_over(10.0)
    flight.run(60.0)
    check_aborted(flight, f"mode {mode} before take-off: changed by a pilot")
    assert flight.all("armed") == []
    assert flight.copter.mode == mode


@pytest.mark.parametrize(("kind", "command"), [("ardupilot", 22), ("ardupilot", 176), ("px4", 176)])
def test_two_lost_commands_are_sent_again(kind: str, command: int) -> None:
    flight = VirtualFlight(kind)
    flight.do(f"ignore {command} 2")
    flight.until_over()
    check_landed(flight)
    assert len(flight.all("lost")) == 2


@pytest.mark.parametrize("kind", KINDS)
def test_a_link_that_is_cut_for_ten_seconds_makes_it_return(kind: str) -> None:
    flight = VirtualFlight(kind, scenario=short(20))
    moving(flight)
    flight.link_is_up = False
    flight.run(10.0)
    flight.link_is_up = True
    flight.until_over(120.0)
    check_aborted(flight, "link lost: no heartbeat for 3 s")
    assert flight.copter.mode == ("AUTO.RTL" if kind == "px4" else "RTL")


@pytest.mark.parametrize("kind", KINDS)
def test_a_vehicle_in_the_air_without_a_datum_is_refused_at_once(kind: str) -> None:
    """Without a stream PX4 returns by itself meanwhile."""
    flight = VirtualFlight(kind)
    flight.do("fly 10 10 20")
    flight.until_over(15.0)
    assert flight.bridge.phase is Phase.ABORTED
    cause = "--datum" if kind == "ardupilot" else "mode AUTO.RTL"
    assert cause in flight.bridge.reason
    assert flight.all("command") == []


def down_and_up(bridge: MissionController) -> Action:
    """Between two layers."""
    return Action.UPWARD if bridge.cell[2] == 0 else Action.DOWNWARD


@pytest.mark.parametrize("kind", KINDS)
def test_a_descent_that_takes_longer_than_a_step_is_told_before_and_counted_after(kind: str) -> None:
    world = short()
    grid = msgspec.structs.replace(world.grid, altitude_step_m=12.0)
    start = (*world.mission.start_m[:2], 22.0)
    world = msgspec.structs.replace(
        world, grid=grid, mission=msgspec.structs.replace(world.mission, start_m=start)
    )
    flight = VirtualFlight(kind, scenario=world)
    flight.policy = down_and_up
    flight.do("param MPC_Z_VEL_MAX_DN 0.5" if kind == "px4" else "param WPNAV_SPEED_DN 50")
    flight.until(lambda: flight.bridge.phase is Phase.TAKEOFF, 60.0)
    warning = "a layer down takes 24 s at 0.5 m/s, and a step has 15 s"
    assert flight.bridge.warnings == [warning]
    assert any(warning in why for phase, _, why in flight.log if phase is Phase.PREFLIGHT)
    flight.until_over()
    assert flight.bridge.phase is Phase.TIMEOUT
    assert flight.bridge.progress.steps_not_reached == 3
    assert not flight.copter.armed


@pytest.mark.parametrize("kind", KINDS)
def test_voltage_that_the_autopilot_finds_low_brings_it_home_though_the_count_is_high(kind: str) -> None:
    flight = VirtualFlight(kind, scenario=short(60))
    moving(flight)
    flight.do("volts 10.3")  # more than four fifths of what it had at rest
    flight.until_over(180.0)
    check_aborted(flight, "at 10.3 V, 12.6 V at rest: the autopilot reports it low or broken")
    assert flight.copter.charge > 0.8


@pytest.mark.parametrize("kind", KINDS)
def test_a_second_vehicle_that_comes_before_arming_stops_it(kind: str) -> None:
    flight = VirtualFlight(kind)
    flight.do("balk 1")
    flight.until(lambda: flight.bridge.reason.startswith("arming refused"), 60.0)
    flight.autopilot.other = Autopilot(Copter(kind, 0.0, "second "), 7)
    flight.run(5.0)
    flight.do("balk 0")
    flight.run(30.0)
    assert flight.all("armed") == []
    assert "2 autopilots on this link: system 1" in flight.bridge.reason
    if kind == "px4":  # it has no stream meanwhile, and leaves OFFBOARD
        check_aborted(flight, "mode AUTO.RTL before take-off")
        return
    assert flight.bridge.phase is Phase.CONNECTING
    flight.autopilot.other = None
    flight.until_over()
    check_landed(flight)


@pytest.mark.parametrize("kind", KINDS)
def test_a_bridge_that_is_restarted_beside_a_second_vehicle_goes_on(kind: str) -> None:
    flight = VirtualFlight(kind, scenario=short(20), looks=1)
    moving(flight, 3)
    system = flight.telemetry.snapshot(flight.now_s).system_id
    assert system == 1
    flight.autopilot.other = other = Autopilot(Copter(kind, 0.0, "second "), 7)
    flight.restart(system)
    flight.until_over()
    assert flight.bridge.phase is Phase.LANDED, flight.log[-5:]
    assert flight.executed == list(range(20))
    assert len(flight.all("armed")) == 1
    assert other.setpoints == 0
