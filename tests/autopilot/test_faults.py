"""Faults during missions against the fake autopilot: in the fence, no step twice, an end with its reason."""

import random
from typing import Any

import pytest

from tests.autopilot.faulty import CAREFUL, FAULTS, PILOT, SPEED, all_flown, check, flown
from tests.autopilot.flight import KINDS, WIRES, Flight, fake
from uav_dc_ros.messages import Phase

ON_THE_WAY = [
    ("ardupilot", "tcp", "freeze", "no position for 0.5 s"),
    ("px4", "udp", "jump away", "outside the fence"),
    ("ardupilot", "udp", "jump", "jumped by 3"),
    ("px4", "tcp", "mode", "mode POSCTL: changed by a pilot or by the autopilot's failsafe"),
    ("ardupilot", "tcp", "mode", "mode ALT_HOLD: changed by a pilot or by the autopilot's failsafe"),
    ("px4", "udp", "lose", "lost its position estimate"),
    ("ardupilot", "udp", "battery", "% at 10.1 V; expected at least 20%"),
    ("px4", "udp", "drop", "mode AUTO.RTL: changed by"),
]


@pytest.fixture(scope="module")
def flights() -> dict[tuple[Any, ...], dict[str, Any]]:
    """A few at a time."""
    return all_flown([case[:3] for case in ON_THE_WAY])


@pytest.mark.parametrize(("kind", "wire", "name", "reason"), ON_THE_WAY)
def test_a_fault_on_the_way(flights: Any, kind: str, wire: str, name: str, reason: str) -> None:
    told = flights[kind, wire, name]
    check(name, told)
    assert told["phase"] == Phase.ABORTED
    assert reason in told["reason"], told["log"]
    if name == "mode":  # the pilot's from then on
        assert told["then"]["mode"] == [PILOT[kind]] * 2
        assert told["then"]["armed"] == [True, True]
        assert told["modes"][-1] == PILOT[kind]
    else:
        assert not told["then"]["armed"][1], "it stands"


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
    kind, wire, at_s = dice.choice(KINDS), dice.choice(WIRES), dice.uniform(0.0, 1000.0)
    check(name, flown(kind, wire, name, 1000, at_s))
