"""One mission against the fake autopilot, in a process of its own, with a fault on the way or without one.

    python -m tests.autopilot.faulty --kind px4 --wire udp --fault "jump away" --step 1

A process per flight, as on a companion computer: several bridges in one would starve one another's streams.
It prints one line of JSON when the mission is over: what the bridge decided, and what the autopilot saw.
"""

import argparse
import json
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from tests.autopilot.flight import KINDS, ROOT, WIRES, Flight, fake
from uav_dc_ros.autopilot.watch import Settings
from uav_dc_ros.messages import Phase

SPEED = 100.0
AT_ONCE = 2
LIMIT_S = 120.0
# The clock runs a hundredth as fast as the vehicle's: what is a blink of it is half a minute of a flight.
CAREFUL = Settings(arm=True, position_age_s=0.5, link_age_s=0.8, hold_s=10.0, lost_s=2.0, silent_s=1.0)
ON_GROUND = (Phase.CONNECTING, Phase.PREFLIGHT)
PILOT = {"ardupilot": "ALT_HOLD", "px4": "POSCTL"}
MENDED = ("freeze 0", "jump 0 0 0", "lose 0", "battery 1")

# What is done, what is done half a second later (nothing: it lasts), and how it may end; "" is a landing at
# the dock.
AWAY = ("no heartbeat", "no position", "mode AUTO.RTL: changed by")
FAULTS: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "none": ("", "", ("",)),
    "refuse": ("refuse 1", "refuse 0", ("",)),
    "drop": ("drop 0.3", "", ("", *AWAY)),
    "drop long": ("drop 1.5", "", ("", *AWAY)),
    "freeze": ("freeze 1", "", ("no position", "")),
    "freeze short": ("freeze 1", "freeze 0", ("", "no position")),
    "jump": ("jump 300 0 0", "", ("jumped", "outside the fence", "mode AUTO.RTL: changed by", "")),
    "jump away": ("jump 5000 0 0", "", ("outside the fence", "")),
    "mode": ("pilot", "", ("changed by a pilot", "")),
    "battery": ("battery 0.1", "battery 1", ("battery 10%", "battery 9%", "")),
    # On the ground it is believed: nobody knows better there.
    "miscounted": ("counted 0.05", "battery 1", ("", "battery ")),
    "lose": ("lose 1", "", ("position estimate", "")),
    "lose short": ("lose 1", "lose 0", ("", "position estimate")),
    "late": ("late 4", "", ("",)),
    "disarm": ("disarm", "", ("disarmed by", "")),
    "silent policy": ("policy", "", ("no move from the policy", "")),
}


def fly(kind: str, wire: str, name: str, step: int, at_s: float) -> dict[str, Any]:
    """Fly one mission.

    Args:
        kind: of the autopilot.
        wire: to it.
        name: of the fault.
        step, at_s: it begins when the vehicle moves at this step, or at this time of the vehicle's; the first
            of the two.
    """
    line, ending, _ = FAULTS[name]
    with fake(kind, wire, speed=SPEED) as autopilot:
        flight = Flight(autopilot, CAREFUL)
        bridge = flight.bridge
        begun_s: float | None = None
        ended = False

        def meddle() -> None:
            nonlocal begun_s, ended
            now_s = time.monotonic()
            due = bridge.step >= step and bridge.phase is Phase.MOVING
            if begun_s is None and line and (due or flight.vehicle.telemetry().vehicle_s >= at_s):
                begun_s = now_s
                if line == "policy":
                    flight.policy = None
                else:
                    autopilot.do(f"mode {PILOT[kind]}" if line == "pilot" else line)
            if begun_s is None or ended:
                return
            if ending and now_s - begun_s > 0.5:
                ended = True
                autopilot.do(ending)
            elif bridge.phase in ON_GROUND and now_s - begun_s > 1.5:
                ended = True  # nobody takes off with it: that waits for ever, and is mended here
                for mended in MENDED:
                    autopilot.do(mended)

        with flight.vehicle:
            flight.until(lambda: bridge.is_over, LIMIT_S, meddle)
            first = autopilot.report()
            end_s = time.monotonic() + 0.2
            while time.monotonic() < end_s:  # the node goes on a while, and nothing must come of it
                flight.tick()
                time.sleep(0.01)
            last = autopilot.report()
        return {
            "phase": bridge.phase,
            "reason": bridge.reason,
            "begun": begun_s is not None,
            "phases": list(dict.fromkeys(phase for phase, _, _ in flight.log)),
            "log": flight.log[-8:],
            "unreasoned": [entry for entry in flight.log if not entry[2]],
            "executed": flight.executed,
            "cells": flight.cells,
            "outside": flight.outside(),
            "armed": len(autopilot.all("armed")),
            "modes": [event["mode"] for event in autopilot.all("mode")],
            "then": {key: (first[key], last[key]) for key in ("setpoints", "mode", "armed", "landed", "ned")},
            "interrupted": last["interrupted"],
        }


def flown(
    kind: str, wire: str, name: str = "none", step: int = 1, at_s: float = float("inf")
) -> dict[str, Any]:
    """The same, in a process of its own."""
    options = ["--kind", kind, "--wire", wire, "--fault", name, "--step", str(step), "--at", str(at_s)]
    done = subprocess.run(
        [sys.executable, "-m", "tests.autopilot.faulty", *options],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=LIMIT_S + 30.0,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return dict(json.loads(done.stdout))


def all_flown(cases: list[tuple[Any, ...]]) -> dict[tuple[Any, ...], dict[str, Any]]:
    """Many of them, a few at a time."""
    with ThreadPoolExecutor(AT_ONCE) as threads:
        return dict(zip(cases, threads.map(lambda case: flown(*case), cases), strict=True))


def check(name: str, told: dict[str, Any]) -> None:
    """What holds for every mission, whatever happened to it."""
    assert told["outside"] == [], "no setpoint outside the fence"
    assert told["executed"] == sorted(set(told["executed"])), "no step twice"
    assert told["armed"] <= 1, "nobody arms again what was disarmed"
    assert told["unreasoned"] == [], "every change has its reason"
    expected = FAULTS[name][2] if told["begun"] else ("",)
    if told["phase"] == Phase.LANDED:
        assert "" in expected, told["log"]
    else:
        assert told["phase"] == Phase.ABORTED
        assert any(reason and reason in told["reason"] for reason in expected), told["log"]
    sent = told["then"]["setpoints"]
    assert sent[0] == sent[1], "nothing is sent any more"


def main() -> None:
    """Fly, and tell."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--kind", choices=KINDS, required=True)
    parser.add_argument("--wire", choices=WIRES, required=True)
    parser.add_argument("--fault", choices=FAULTS, default="none")
    parser.add_argument("--step", type=int, default=1)
    parser.add_argument("--at", type=float, default=float("inf"))
    options = parser.parse_args()
    print(json.dumps(fly(options.kind, options.wire, options.fault, options.step, options.at)))


if __name__ == "__main__":
    main()
