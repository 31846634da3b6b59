"""The console of run_all for a real vehicle: each phase of a flight, and faults during a step."""

import io

import msgspec
import pytest
from rich.console import Console

from tests.nodes.view.test_drawing import MISSION, SCENARIO
from uav_dc_ros.cli import Output
from uav_dc_ros.messages import FaultKind, Phase
from uav_dc_ros.runner.console import MissionConsole

FLIGHT = (
    (Phase.TAKEOFF, "takes off", None),
    (Phase.READY, "at the start, cell (0, 0, 0)", None),
    (Phase.MOVING, "right to cell (1, 0, 0)", None),
    (Phase.MOVING, "no heartbeat for 3 s", FaultKind.LINK),
    (Phase.MOVING, "no heartbeat for 3 s", FaultKind.LINK),  # repeated
    (Phase.MOVING, "goes on after: no heartbeat for 3 s", None),
    (Phase.READY, "step 1: there", None),
    (Phase.READY, "", None),  # a simulated vehicle gives no reason
    (Phase.LANDING, "step 1: at the dock", None),
)


def test_it_prints_what_is_no_routine(monkeypatch: pytest.MonkeyPatch) -> None:
    out = io.StringIO()
    monkeypatch.setattr(Output, "console", lambda self, file: Console(file=out, width=80))
    display = MissionConsole(SCENARIO, 1)
    for phase, reason, fault in FLIGHT:
        held = fault is not None
        display.vehicle(msgspec.structs.replace(MISSION, phase=phase, reason=reason, held=held, fault=fault))
    assert out.getvalue().splitlines() == [
        "takeoff: takes off",
        "ready: at the start, cell (0, 0, 0)",
        "moving (held): no heartbeat for 3 s",
        "moving: goes on after: no heartbeat for 3 s",
        "landing: step 1: at the dock",
    ]
