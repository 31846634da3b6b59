"""Missions, whole or with a fault: bridge, MAVLink, a fake autopilot; each flight in processes of its own."""

import random
from itertools import product
from typing import Any

import numpy as np
import pytest

from tests.support.fake_autopilot.faulty import CAREFUL, FAULTS, PILOT, SPEED, all_flown, check, flown, low
from tests.support.fake_autopilot.flight import KINDS, SCENARIO, WIRES, Flight, fake
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.messages import Phase

CASES = list(product(KINDS, WIRES))
SHORT = [("ardupilot", "tcp", "late message"), ("px4", "udp", "odd messages")]
ON_THE_WAY = [
    ("ardupilot", "tcp", "freeze", "no position for 0.5 s"),
    ("px4", "tcp", "mode", "mode POSCTL: changed by a pilot or by the autopilot's failsafe"),
    ("ardupilot", "tcp", "mode", "mode ALT_HOLD: changed by a pilot or by the autopilot's failsafe"),
    ("px4", "udp", "lose", "lost its position estimate"),
]
# The vehicle's time decides these alone: test_bridge.py and test_battery.py fly them without a clock.
MORE_ON_THE_WAY = [
    ("ardupilot", "udp", "jump", "jumped by 3"),
    ("ardupilot", "udp", "battery", "% at 10.1 V; expected at least 20%"),
    ("px4", "udp", "jump away", "jumped by 5000 m"),
    ("px4", "udp", "drop", "mode AUTO.RTL: changed by"),
]


def expected_cells(scenario: Scenario) -> list[list[int]]:
    """Straight east, straight north, and the rest of the steps at the dock, in the layer of the start."""
    dock_x, dock_y = scenario.dock_cell
    east = [[x, 0, 2] for x in range(1, dock_x + 1)]
    north = [[dock_x, y, 2] for y in range(1, dock_y + 1)]
    return east + north + [[dock_x, dock_y, 2]] * (scenario.mission.max_steps - dock_x - dock_y)


def check_whole(told: dict[str, Any], name: str = "none", scenario: Scenario = SCENARIO) -> None:
    """It took off, flew the cells of the simulation, and landed at the dock."""
    check(name, told)
    assert told["phase"] == Phase.LANDED, told["log"]
    assert told["phases"] == [
        *(Phase.CONNECTING, Phase.PREFLIGHT, Phase.TAKEOFF, Phase.READY, Phase.MOVING),
        *(Phase.LANDING, Phase.LANDED),
    ]
    assert told["executed"] == list(range(scenario.mission.max_steps))
    assert told["cells"] == expected_cells(scenario)
    north_m, east_m, down_m = told["then"]["ned"][1]
    assert np.allclose((east_m, north_m), scenario.mission.dock_m, atol=CAREFUL.tolerance_m)
    assert down_m == 0.0
    assert told["then"]["landed"][1], told["log"]
    assert not told["then"]["armed"][1]
    assert told["interrupted"] == 0, "no setpoint while it took off"


@pytest.fixture(scope="module")
def flights() -> dict[tuple[Any, ...], dict[str, Any]]:
    """They wait for one another's time most of theirs."""
    return all_flown([*SHORT, *(case[:3] for case in ON_THE_WAY)])


@pytest.mark.parametrize("case", SHORT)
def test_a_whole_mission_whatever_happens_to_single_messages(
    flights: dict[Any, dict[str, Any]], case: tuple[str, str, str]
) -> None:
    assert flights[case]["begun"]
    check_whole(flights[case], case[2], low())


@pytest.mark.long
def test_a_whole_mission_of_every_kind_on_every_wire() -> None:
    for told in all_flown(CASES).values():
        check_whole(told)


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


@pytest.mark.long
@pytest.mark.parametrize(("kind", "wire", "name", "reason"), MORE_ON_THE_WAY)
def test_another_fault_on_the_way(kind: str, wire: str, name: str, reason: str) -> None:
    (told,) = flown([(kind, wire, name)])
    check(name, told)
    assert told["phase"] == Phase.ABORTED
    assert reason in told["reason"], told["log"]
    assert not told["then"]["armed"][1], "it stands"


def test_arming_that_is_refused_is_told_in_the_autopilots_own_words() -> None:
    with fake("ardupilot", speed=SPEED) as autopilot:
        autopilot.do("balk 1")
        flight = Flight(autopilot, CAREFUL)
        with flight.vehicle:
            flight.until(lambda: "refused" in flight.bridge.reason)
            assert flight.bridge.reason.startswith("arming refused: Arm: Motors: check frame class")
            assert autopilot.all("armed") == []
            autopilot.do("balk 0")
            flight.until(lambda: flight.bridge.phase is Phase.TAKEOFF)


@pytest.mark.long
@pytest.mark.parametrize("number", range(200))
def test_any_fault_at_any_moment(number: int) -> None:
    dice = random.Random(number)
    name = list(FAULTS)[number % len(FAULTS)]
    kind, wire, at_s = dice.choice(KINDS), dice.choice(WIRES), dice.uniform(0.0, 1000.0)
    check(name, flown([(kind, wire, name, at_s)])[0])
