"""Whole flights whose telemetry is late, repeated, reordered, impossible or missing; vehicles that fail."""

import dataclasses
import math
from collections import deque
from pathlib import Path
from typing import NamedTuple

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from tests.support.fake_autopilot.common import way_home
from tests.support.fake_autopilot.simulated import ARMING, Flight, Vehicle
from uav_dc_ros import scenarios
from uav_dc_ros.core.grid import Action
from uav_dc_ros.messages import Phase
from uav_dc_ros.offboard.frames import Enu
from uav_dc_ros.offboard.vehicle import Limits, Mode, Telemetry

FIELD = scenarios.load(Path(__file__).parents[2] / "docs" / "field.toml")
TICK_S = 0.2
LONGEST_S = 4000.0  # a mission, with all that the bridge waits for
KEPT = 200  # telemetry that may come late
NOWHERE = Enu(math.nan, 0.0, math.inf)


class Fault(NamedTuple):
    """What is done to the telemetry, from when on, for how long, and how much."""

    kind: str
    at_s: float
    lasts_s: float
    much: float


KINDS = (
    *("late", "repeated", "zeroed", "reordered", "impossible", "not a number", "missing", "shifted"),
    *("clock back", "clock stands", "clock is none", "no heartbeat", "estimate", "disarmed?", "on ground?"),
    *("tilted", "target", "home", "limits", "other", "voltage", "silent policy", "policy gone"),
)
FAILURES = (
    "wind",
    "stuck",
    "falls",
    "ignores_commands",
    "silent",
    "frozen",
    "fence",
    "pilot",
    "lands",
    "drained",
    "disarmed",
)
ON_GROUND = (Phase.CONNECTING, Phase.PREFLIGHT)


def distorted(fault: Fault, known: Telemetry, history: deque[Telemetry], now_s: float) -> Telemetry:
    """Telemetry with one fault in it."""
    old = history[max(0, len(history) - 1 - int(fault.much * 50))]
    here = known.position or Enu(0.0, 0.0, 0.0)
    change: dict[str, object] = {}
    match fault.kind:
        case "late":  # an old message arrives now
            change = {"position": old.position, "vehicle_s": old.vehicle_s}
        case "repeated":
            return old
        case "zeroed":
            change = {"position": Enu(0.0, 0.0, 0.0), "vehicle_s": 0.0, "battery": None}
        case "reordered":
            change = {"position": old.position, "position_s": old.position_s}
        case "impossible":
            change = {"position": here._replace(north_m=here.north_m + 400.0 + 1e6 * fault.much)}
        case "not a number":
            change = {"position": NOWHERE}
        case "missing":
            change = {"position": None, "position_s": known.position_s if fault.much > 0.5 else None}
        case "shifted":
            change = {"position": here._replace(east_m=here.east_m + 30.0 * fault.much)}
        case "clock back":
            change = {"vehicle_s": known.vehicle_s - 100.0 * fault.much}
        case "clock stands":
            change = {"vehicle_s": fault.at_s}
        case "clock is none":
            change = {"vehicle_s": math.nan}
        case "no heartbeat":
            change = {"heartbeat_s": None if fault.much > 0.5 else now_s - 10.0}
        case "estimate":
            change = {"estimate_ok": False, "estimate_s": None if fault.much > 0.5 else now_s - 5.0}
        case "on ground?":
            change = {"on_ground": True if fault.much > 0.5 else None}
        case "tilted":
            change = {"tilt_rad": math.nan if fault.much > 0.5 else 3.0}
        case "target":
            change = {"target": NOWHERE if fault.much > 0.5 else Enu(1e4, 0.0, 0.0), "target_s": now_s}
        case "home":
            change = {"home": NOWHERE if fault.much > 0.5 else Enu(1e4, 0.0, 0.0)}
        case "limits":
            change = {"limits": Limits(fence_radius_m=10.0, speed_mps=0.0, climb_mps=1.0)}
        case "other":
            change = {"other_controller": "component 191 of system 254"}
        case "voltage":
            change = {"battery_v": 0.0, "battery_fails": fault.much > 0.5}
        case "disarmed?":
            change = {"armed": not known.armed} if fault.much > 0.9 else {}
    return dataclasses.replace(known, **change)  # type: ignore[arg-type]


def fail(fault: Fault, vehicle: Vehicle, present: bool) -> None:
    """What goes wrong with the vehicle itself."""
    match fault.kind:
        case "wind":
            vehicle.wind_mps = (30.0 * fault.much, 0.0) if present else (0.0, 0.0)
        case "stuck" | "falls" | "ignores_commands" | "silent" | "frozen":
            setattr(vehicle, fault.kind, present)
        case "fence":
            vehicle.fence_m = 300.0 * fault.much if present else None
        case "pilot" | "lands" if present:
            vehicle.mode = Mode.OTHER if fault.kind == "pilot" else Mode.LAND
        case "drained" if present:
            vehicle.battery = 0.3 * fault.much
        case "disarmed" if present:
            vehicle.armed = False


class Distorted(Flight):
    """A flight over the field whose telemetry has faults."""

    def __init__(self, faults: list[Fault]) -> None:
        super().__init__(ARMING, scenario=FIELD)
        self.faults = faults
        self.history: deque[Telemetry] = deque(maxlen=KEPT)
        self.bridge._on_change = self._check

    def _check(self) -> None:
        """A step counts only where the vehicle is in its cell, by the last position that could be true."""
        before = self._step
        self._note()
        if self.bridge.step != before:
            here = self.bridge._telemetry.position
            assert here is not None
            centre, grid = self.bridge.progress.centre(self.bridge.cell), FIELD.grid
            for p, c, size_m in zip(
                here, centre, (grid.cell_m, grid.cell_m, grid.altitude_step_m), strict=True
            ):
                assert abs(p - c) <= size_m / 2 + 1e-6

    def fly(self) -> None:
        """To its end, or until it is clear that it waits on the ground."""
        vehicle, bridge = self.vehicle, self.bridge
        while not bridge.is_over and vehicle.now_s < LONGEST_S:
            now_s = vehicle.now_s
            self.history.append(vehicle.telemetry)
            present = [f for f in self.faults if f.at_s <= now_s < f.at_s + f.lasts_s]
            for fault in self.faults:
                fail(fault, vehicle, fault in present)
            known = vehicle.telemetry
            for fault in present:
                known = distorted(fault, known, self.history, now_s)
            self.policy = None if any(f.kind == "silent policy" for f in present) else _way
            bridge.policy_lost = any(f.kind == "policy gone" for f in present)
            self.tick(TICK_S, known)
            if bridge.phase in ON_GROUND and now_s > 1200.0:
                break


def _way(bridge: object) -> Action:
    return way_home(bridge)  # type: ignore[arg-type]


def check(faults: list[Fault]) -> Distorted:
    """Fly, and check what holds for every mission."""
    flight = Distorted(faults)
    flight.fly()
    bridge, vehicle = flight.bridge, flight.vehicle
    waits = bridge.phase in ON_GROUND and vehicle.on_ground
    assert bridge.is_over or waits, flight.log[-4:]
    assert bridge.reason
    assert flight.executed == sorted(set(flight.executed)), "no step twice"
    if bridge.phase is Phase.LANDED and not any(fault.kind == "wind" for fault in faults):
        assert math.dist(vehicle.position[:2], FIELD.mission.dock_m) <= 5.0 + 30.0, "shifted by that at most"
    return flight


FAULTS = st.lists(
    st.builds(
        Fault,
        kind=st.sampled_from(KINDS + FAILURES),
        at_s=st.floats(0.0, 300.0),
        lasts_s=st.one_of(st.floats(0.0, 1.0), st.floats(0.0, 30.0), st.just(1e6)),
        much=st.floats(0.0, 1.0),
    ),
    max_size=6,
)
QUIET = [HealthCheck.too_slow]


@settings(max_examples=10, deadline=None, derandomize=True, suppress_health_check=QUIET)
@given(faults=FAULTS)
@example(faults=[Fault("repeated", 54.8, 1e6, 0.5)])
@example(faults=[Fault("late", 80.0, 0.2, 0.15)])
@example(faults=[Fault("zeroed", 80.0, 0.2, 0.0)])
@example(faults=[Fault("impossible", 80.0, 0.8, 0.0)])
@example(faults=[Fault("wind", 0.0, 1e6, 0.5)])
@example(faults=[Fault("wind", 0.0, 1e6, 0.5), Fault("silent", 40.0, 20.0, 0.5)])
@example(faults=[Fault("falls", 60.0, 1e6, 0.0), Fault("ignores_commands", 30.0, 1e6, 0.0)])
def test_whatever_goes_wrong_the_mission_has_an_end(faults: list[Fault]) -> None:
    check(faults)


@pytest.mark.long
@settings(max_examples=300, deadline=None, derandomize=True, suppress_health_check=QUIET)
@given(faults=FAULTS)
def test_whatever_goes_wrong_the_mission_has_an_end_every_time(faults: list[Fault]) -> None:
    check(faults)


@pytest.mark.parametrize("kind", KINDS)
def test_one_message_that_is_wrong_ends_nothing(kind: str) -> None:
    """Whatever it is, in one phase after the other; but a report that it is disarmed is believed."""
    flight = check([Fault(kind, at_s, TICK_S, 0.8) for at_s in (10.0, 40.0, 41.0, 100.0)])
    if kind == "other":
        assert flight.bridge.phase is Phase.ABORTED or flight.bridge.warnings == []
    else:
        assert flight.bridge.phase is Phase.LANDED, flight.log[-3:]


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "disarmed?"])
def test_a_fault_that_stays_has_an_end(kind: str) -> None:
    flight = check([Fault(kind, 100.0, 1e6, 0.8)])
    assert flight.bridge.is_over
    assert flight.vehicle.mode in (Mode.LAND, Mode.RETURN, Mode.COMMANDED)
