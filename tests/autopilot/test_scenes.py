"""Scenes of whole flights, in the vehicle's time: odd telemetry, low voltage, others on the link."""

import random
from collections.abc import Iterable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.autopilot.autopilot import Autopilot
from tests.autopilot.copter import Copter
from tests.autopilot.flight import KINDS
from tests.autopilot.virtual import VirtualFlight, short
from uav_dc_ros.autopilot.watch import Settings
from uav_dc_ros.messages import Phase

STEPS = list(range(6))


def check_landed(flight: VirtualFlight) -> None:
    """It flew each step once, and landed at the dock."""
    assert flight.bridge.phase is Phase.LANDED, flight.log[-5:]
    assert flight.executed == STEPS
    assert len(flight.all("armed")) == 1
    assert not flight.copter.armed
    assert flight.dock_distance_m() < flight.bridge.settings.tolerance_m


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


@settings(max_examples=10, deadline=None, derandomize=True)
@given(kind=st.sampled_from(KINDS), seed=st.integers(0, 2**32), share=st.floats(0.0, 0.1))
def test_a_mission_is_flown_whatever_happens_to_single_messages(kind: str, seed: int, share: float) -> None:
    channel = Unreliable(seed, share)
    flight = channel.flight = VirtualFlight(kind, channel=channel)
    flight.until_over()
    check_landed(flight)
    if share > 0.01:
        assert {"late", "repeated"} <= flight.hearing.discarded.keys()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("line", ["late_position 1.5", "late_position 4", "zero_time", "nonsense", "twice 1"])
def test_one_odd_message_does_nothing(kind: str, line: str) -> None:
    flight = VirtualFlight(kind)
    moving(flight)
    flight.do(line)
    flight.until_over()
    check_landed(flight)
    assert sum(flight.hearing.discarded.values()) >= 1
    assert not any(reason.startswith("holds") for _, _, reason in flight.log)


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
    flight = VirtualFlight("ardupilot", Settings(arm=True, link_age_s=3.0), speed=speed)
    flight.do("param FS_GCS_ENABLE 1")
    flight.until_over()
    check_landed(flight)


@pytest.mark.parametrize("kind", KINDS)
def test_a_second_vehicle_on_the_link_is_left_alone(kind: str) -> None:
    """It speaks first; the own one is on the ground while nobody says which is meant."""
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
    assert (Phase.PREFLIGHT, 0, named) in flight.log, "the display and the bag say which one it took"
    assert (other.copter.armed, other.setpoints) == (False, 0)


@pytest.mark.parametrize("kind", KINDS)
def test_a_second_bridge_is_known_before_anybody_can_arm(kind: str) -> None:
    flight = VirtualFlight(kind)
    flight.do("second_bridge_heartbeats 1")
    flight.until(lambda: flight.hearing.telemetry(flight.now_s).missing is None)
    found = str(flight.hearing.telemetry(flight.now_s).other_controller)
    assert found.startswith("heartbeats of system 255, component 191")
    assert not flight.copter.armed


@pytest.mark.parametrize("kind", KINDS)
def test_after_a_lost_link_the_report_on_the_estimate_is_older_than_the_heartbeat(kind: str) -> None:
    """Nothing says that the estimate was lost: nothing was reported."""
    flight = VirtualFlight(kind)
    moving(flight)
    flight.link_is_up = False
    flight.run(4.0)
    known = flight.hearing.telemetry(flight.now_s)
    assert known.estimate_s is not None
    assert known.heartbeat_s is not None
    assert flight.now_s - known.estimate_s == pytest.approx(4.0, abs=0.3)
    assert flight.now_s - known.heartbeat_s == pytest.approx(4.5, abs=0.6)
    flight.link_is_up = True
    flight.run(1.2)
    known = flight.hearing.telemetry(flight.now_s)
    assert known.estimate_ok
    assert flight.now_s - (known.estimate_s or 0.0) < 0.3
