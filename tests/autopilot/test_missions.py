"""Whole missions: bridge, MAVLink, and a fake autopilot, each flight in processes of its own."""

from itertools import product
from typing import Any

import numpy as np
import pytest

from tests.autopilot.faulty import CAREFUL, all_flown, check
from tests.autopilot.flight import KINDS, SCENARIO, WIRES
from uav_dc_ros.messages import Phase

CASES = list(product(KINDS, WIRES))
SHORT = [("ardupilot", "tcp"), ("px4", "udp")]


def expected_cells() -> list[list[int]]:
    """Ten cells east, ten north, and the rest of the steps at the dock, in the layer of the start."""
    east = [[x, 0, 2] for x in range(1, 11)]
    north = [[10, y, 2] for y in range(1, 11)]
    return east + north + [[10, 10, 2]] * (SCENARIO.mission.max_steps - 20)


def check_whole(told: dict[str, Any]) -> None:
    """It took off, flew the cells of the simulation, and landed at the dock."""
    check("none", told)
    assert told["phase"] == Phase.LANDED, told["log"]
    assert told["phases"] == [
        *(Phase.CONNECTING, Phase.PREFLIGHT, Phase.TAKEOFF, Phase.READY, Phase.MOVING),
        *(Phase.LANDING, Phase.LANDED),
    ]
    assert told["executed"] == list(range(SCENARIO.mission.max_steps))
    assert told["cells"] == expected_cells()
    north_m, east_m, down_m = told["then"]["ned"][1]
    assert np.allclose((east_m, north_m), SCENARIO.mission.dock_m, atol=CAREFUL.tolerance_m)
    assert down_m == 0.0
    assert told["then"]["landed"][1], told["log"]
    assert not told["then"]["armed"][1]
    assert told["interrupted"] == 0, "no setpoint while it took off"


@pytest.fixture(scope="module")
def flights() -> dict[tuple[Any, ...], dict[str, Any]]:
    """They wait for one another's time most of theirs."""
    return all_flown(SHORT)


@pytest.mark.parametrize("case", SHORT)
def test_a_whole_mission(flights: dict[Any, dict[str, Any]], case: tuple[str, str]) -> None:
    check_whole(flights[case])


@pytest.mark.long
def test_a_whole_mission_of_every_kind_on_every_wire() -> None:
    for told in all_flown(CASES).values():
        check_whole(told)
