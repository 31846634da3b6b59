"""Faults during missions against the fake autopilot: in the fence, no step twice, an end with its reason."""

import random
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

from tests.autopilot.flight import KINDS, WIRES, Fake, Flight, fake
from uav_dc_ros.autopilot.watch import Settings
from uav_dc_ros.messages import Phase

SPEED = 100.0
CAREFUL = Settings(arm=True, position_age_s=0.3, link_age_s=0.6, lost_s=2.0)
ON_GROUND = (Phase.CONNECTING, Phase.PREFLIGHT)
PILOT = {"ardupilot": "ALT_HOLD", "px4": "POSCTL"}

# What is done, what is done to end it (nothing: it lasts), and what the reason may be; "" is a landing.
FAULTS: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "refuse": ("refuse 1", "refuse 0", ("",)),
    "drop": ("drop 0.3", "", ("", "no heartbeat", "no position", "taken over: mode AUTO.RTL")),
    "drop long": ("drop 1.5", "", ("", "no heartbeat", "no position", "taken over: mode AUTO.RTL")),
    "freeze": ("freeze 1", "", ("no position", "")),
    "freeze short": ("freeze 1", "freeze 0", ("", "no position")),
    "jump": ("jump 300 0 0", "", ("jumped", "outside the fence", "taken over", "")),
    "jump away": ("jump 5000 0 0", "", ("outside the fence", "")),
    "mode": ("pilot", "", ("taken over", "")),
    "battery": ("battery 0.1", "battery 1", ("battery 10%", "")),
    "lose": ("lose 1", "", ("position estimate", "")),
    "lose short": ("lose 1", "lose 0", ("", "position estimate")),
    "late": ("late 4", "", ("",)),
    "disarm": ("disarm", "", ("disarmed by", "")),
}


def fly(autopilot: Fake, kind: str, name: str, at: Callable[[Flight], bool]) -> Flight:
    """A mission with a fault from a moment on; half a second later it is ended, if it can be."""
    line, ending, reasons = FAULTS[name]
    flight = Flight(autopilot, CAREFUL)
    begun: list[float] = []

    def meddle() -> None:
        if not begun and at(flight):
            begun.append(time.monotonic())
            autopilot.do(f"mode {PILOT[kind]}" if line == "pilot" else line)
        elif len(begun) == 1 and ending and time.monotonic() - begun[0] > 0.5:
            begun.append(0.0)
            autopilot.do(ending)
        elif len(begun) == 1 and flight.bridge.phase in ON_GROUND and time.monotonic() - begun[0] > 1.5:
            begun.append(0.0)  # nobody takes off with it: that waits for ever, and is mended here
            for mended in ("freeze 0", "jump 0 0 0", "lose 0", "battery 1"):
                autopilot.do(mended)

    with flight.vehicle:
        flight.until(lambda: flight.bridge.is_over, 90.0, meddle)
    flight.check_setpoints()
    assert flight.executed == sorted(set(flight.executed)), "no step twice"
    bridge = flight.bridge
    if bridge.phase is Phase.LANDED:
        assert "" in reasons or not begun, (name, flight.log[-4:])
    else:
        assert bridge.phase is Phase.ABORTED
        assert any(reason and reason in bridge.reason for reason in reasons), (name, flight.log[-4:])
    assert len(autopilot.all("armed")) <= 1, "nobody arms again what was disarmed"
    return flight


ON_THE_WAY = [
    ("ardupilot", "tcp", "drop", ""),
    ("ardupilot", "tcp", "freeze", "no position for 0.3 s"),
    ("px4", "udp", "jump away", "outside the fence"),
    ("ardupilot", "udp", "jump", "jumped by 30"),
    ("px4", "tcp", "mode", "taken over: mode POSCTL"),
    ("ardupilot", "tcp", "mode", "taken over: mode ALT_HOLD"),
    ("px4", "udp", "lose", "lost its position estimate"),
    ("ardupilot", "udp", "battery", "battery 10%"),
]


def on_the_way(kind: str, wire: str, name: str) -> tuple[Flight, list[dict[str, Any]]]:
    """A mission with a fault at its second step; two looks at the autopilot after its end."""
    with fake(kind, wire, speed=SPEED) as autopilot:
        flight = fly(autopilot, kind, name, lambda f: f.bridge.step >= 1 and f.bridge.phase is Phase.MOVING)
        first = autopilot.report()
        time.sleep(0.2)
        return flight, [first, autopilot.report()]


@pytest.fixture(scope="module")
def flights() -> dict[tuple[str, ...], Any]:
    """All of them at once: they wait for time to pass most of theirs."""
    cases = [(kind, wire, name) for kind, wire, name, _ in ON_THE_WAY]
    with ThreadPoolExecutor(3) as threads:  # more would starve one another
        return dict(zip(cases, threads.map(lambda case: on_the_way(*case), cases), strict=True))


@pytest.mark.parametrize(("kind", "wire", "name", "reason"), ON_THE_WAY)
def test_a_fault_on_the_way(flights: Any, kind: str, wire: str, name: str, reason: str) -> None:
    flight, (first, second) = flights[kind, wire, name]
    assert reason in flight.bridge.reason
    if name == "mode":  # the pilot's from then on
        assert (second["mode"], second["armed"]) == (PILOT[kind], True)
        assert second["setpoints"] == first["setpoints"]


def test_arming_that_is_refused_is_told_in_the_autopilots_own_words() -> None:
    with fake("ardupilot", speed=SPEED) as autopilot:
        autopilot.do("balk 1")
        flight = Flight(autopilot, CAREFUL)
        with flight.vehicle:
            flight.until(lambda: "refused" in flight.bridge.reason)
            assert flight.bridge.reason == "arming refused: Arm: Motors: check frame class"
            assert autopilot.all("armed") == []
            autopilot.do("balk 0")
            flight.until(lambda: flight.bridge.phase is Phase.TAKEOFF)


@pytest.mark.long
@pytest.mark.parametrize("number", range(100))
def test_any_fault_at_any_moment(number: int) -> None:
    dice = random.Random(number)
    name = list(FAULTS)[number % len(FAULTS)]
    kind, wire = dice.choice(KINDS), dice.choice(WIRES)
    at_s = dice.uniform(0.0, 8.0)  # a mission takes about 9 s of the clock
    with fake(kind, wire, speed=SPEED) as autopilot:
        begun_s = time.monotonic()
        fly(autopilot, kind, name, lambda f: time.monotonic() - begun_s > at_s)
