"""Whole missions: bridge, MAVLink, and a fake autopilot in a process of its own."""

from concurrent.futures import ThreadPoolExecutor
from itertools import product
from typing import Any

import numpy as np
import pytest

from tests.autopilot.flight import KINDS, SCENARIO, WIRES, Flight, fake
from uav_dc_ros.autopilot.watch import Settings
from uav_dc_ros.messages import Phase

ARMING = Settings(arm=True)
SPEED = 100.0


def fly(kind: str, wire: str) -> tuple[Flight, dict[str, Any]]:
    """A whole mission, and how the autopilot is then."""
    with fake(kind, wire, speed=SPEED) as autopilot:
        flight = Flight(autopilot, ARMING)
        with flight.vehicle:
            flight.until(lambda: flight.bridge.is_over, 120.0)
        return flight, autopilot.report()


def expected_cells() -> list[tuple[int, int, int]]:
    """Ten cells east, ten north, and the rest of the steps at the dock, in the layer of the start."""
    east = [(x, 0, 2) for x in range(1, 11)]
    north = [(10, y, 2) for y in range(1, 11)]
    return east + north + [(10, 10, 2)] * (SCENARIO.mission.max_steps - 20)


@pytest.fixture(scope="module")
def flights() -> dict[tuple[str, str], tuple[Flight, dict[str, Any]]]:
    """Every kind on every wire, at once: they wait for one another's time most of theirs."""
    cases = list(product(KINDS, WIRES))
    with ThreadPoolExecutor(len(cases)) as threads:
        return dict(zip(cases, threads.map(lambda case: fly(*case), cases), strict=True))


@pytest.mark.parametrize("wire", WIRES)
@pytest.mark.parametrize("kind", KINDS)
def test_a_whole_mission(flights: dict[Any, Any], kind: str, wire: str) -> None:
    flight, report = flights[kind, wire]
    assert flight.bridge.phase is Phase.LANDED, flight.log[-5:]
    phases = list(dict.fromkeys(phase for phase, _, _ in flight.log))
    assert phases == [
        *(Phase.CONNECTING, Phase.PREFLIGHT, Phase.TAKEOFF, Phase.READY, Phase.MOVING),
        *(Phase.LANDING, Phase.LANDED),
    ]
    assert flight.executed == list(range(SCENARIO.mission.max_steps))
    assert flight.cells == expected_cells()
    north_m, east_m, down_m = report["ned"]
    assert np.allclose((east_m, north_m), SCENARIO.mission.dock_m, atol=ARMING.tolerance_m)
    assert (down_m, report["landed"], report["armed"]) == (0.0, True, False)
    assert report["interrupted"] == 0, "no setpoint while it took off"
    flight.check_setpoints()
