"""Missions against the fake autopilot, in a process of their own, with a fault on the way or without one.

    python -m tests.support.fake_autopilot.faulty "px4,udp,jump away" "ardupilot,tcp,freeze,250.0"

One flight at a time in a process, as on a companion computer: several bridges in one would starve one
another's streams. It prints one line of JSON when a mission is over: what the bridge decided, and what the
autopilot saw.
"""

import json
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import msgspec

from tests.support.fake_autopilot.flight import ROOT, SCENARIO, Flight, fake
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.messages import Phase
from uav_dc_ros.offboard.mission.fault_detector import SafetySettings
from uav_dc_ros.offboard.setpoint_stream import use_realtime_priority

SPEED = 100.0
AT_ONCE = 4
LIMIT_S = 900.0  # a flight of 20 s takes minutes where other processes have the cores
# The clock runs a hundredth as fast as the vehicle's: what is a blink of it is half a minute of a flight.
CAREFUL = SafetySettings(
    arm=True,
    position_timeout_s=0.5,
    heartbeat_timeout_s=0.8,
    fault_timeout_s=10.0,
    link_lost_timeout_s=2.0,
    policy_timeout_s=1.0,
    landing_progress_timeout_s=3600.0,
)
# A landing from 200 m takes a minute where other processes have the cores: the fake autopilot waits for its
# client's heartbeats.
PATIENT = replace(CAREFUL, link_lost_timeout_s=15.0)
ON_GROUND = (Phase.CONNECTING, Phase.PREFLIGHT)
PILOT = {"ardupilot": "ALT_HOLD", "px4": "POSCTL"}
MENDED = ("freeze 0", "jump 0 0 0", "lose 0", "battery 1")

# What is done, one after the other; what is done half a second later (nothing: it lasts), and how it may end;
# "" is a landing at the dock.
AWAY = ("no heartbeat", "no position", "mode AUTO.RTL: changed by")
FAULTS: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "none": ("", "", ("",)),
    "refuse": ("refuse 1", "refuse 0", ("",)),
    "drop": ("drop 0.3", "", ("", *AWAY)),
    "drop long": ("drop 1.5", "", ("", *AWAY)),
    "freeze": ("freeze 1", "", ("no position", "")),
    "freeze short": ("freeze 1", "freeze 0", ("", "no position")),
    "jump": (
        "jump 300 0 0",
        "",
        ("jumped", "outside the fence", "mode AUTO.RTL: changed by", "from the dock", ""),
    ),
    "jump away": ("jump 5000 0 0", "", ("jumped", "from the dock", "no position for", "")),
    "mode": ("pilot", "", ("changed by a pilot", "")),
    "battery": ("battery 0.1", "battery 1", ("battery 10%", "battery 9%", "")),
    # On the ground it is believed: nobody knows better there.
    "miscounted": ("counted 0.05", "battery 1", ("", "battery ")),
    "lose": ("lose 1", "", ("position estimate", "")),
    "lose short": ("lose 1", "lose 0", ("", "position estimate")),
    "late": ("late 4", "", ("",)),
    "disarm": ("disarm", "", ("disarmed by", "disarmed in the air", "")),
    "odd messages": ("late_position 1.5; zero_time; nonsense; twice 1", "twice 0", ("",)),
    "late message": ("late_position 1.5", "", ("",)),
    "silent policy": ("policy", "", ("no move from the policy", "")),
    "wind": ("wind 20 0", "", ("outside the fence", "no nearer", "not at the start", "")),
    "fence": (
        "param FENCE_ENABLE 1; param FENCE_RADIUS 300; param GF_MAX_HOR_DIST 300",
        "",
        ("circular fence ends 300 m", "does not accept the setpoint", "no nearer", "RTL: changed by", ""),
    ),
    "motor": ("motor 600", "", ("too low", "on the ground", "outside the fence", "not at the start", "")),
    "low voltage": ("volts 9.0", "", ("under load", "low or broken", "")),
    "slow": ("param WPNAV_SPEED_DN 50; param MPC_Z_VEL_MAX_DN 0.5", "", ("",)),
    "lost commands": ("ignore 22 2; ignore 176 1; ignore 400 1", "", ("",)),
    "second bridge": ("second_bridge_heartbeats 1", "", ("another system commands", "")),
    "second target": (
        "second_bridge_target 100 100 -100",
        "",
        ("another system commands", "does not accept the setpoint", "no nearer", "not at the start", ""),
    ),
}


def low() -> Scenario:
    """The same world, flown near the ground, with a dock half-way: a climb of 20 m, and twelve steps."""
    grid = msgspec.structs.replace(SCENARIO.grid, altitude_min_m=10.0, altitude_step_m=5.0)
    start_m, dock_m = SCENARIO.mission.start_m, SCENARIO.mission.dock_m
    mission = msgspec.structs.replace(
        SCENARIO.mission,
        start_m=(*start_m[:2], 20.0),
        dock_m=((start_m[0] + dock_m[0]) / 2, (start_m[1] + dock_m[1]) / 2),
        max_steps=12,
    )
    return msgspec.structs.replace(SCENARIO, grid=grid, mission=mission)


def fly(kind: str, wire: str, name: str, at_s: float | None) -> dict[str, Any]:
    """Fly one mission.

    Args:
        kind: of the autopilot.
        wire: to it.
        name: of the fault.
        at_s: the vehicle's time at which it begins. None: while the vehicle moves at its second step, in a
            world that is flown near the ground.
    """
    line, ending, _ = FAULTS[name]
    with fake(kind, wire, speed=SPEED) as autopilot:
        is_short = at_s is None
        flight = Flight(autopilot, CAREFUL if is_short else PATIENT, low() if is_short else SCENARIO)
        bridge = flight.bridge
        begun_s: float | None = None
        ended = False

        def meddle() -> None:
            nonlocal begun_s, ended
            now_s = time.monotonic()
            if at_s is None:
                due = bridge.step >= 1 and bridge.phase is Phase.MOVING
            else:
                due = flight.vehicle.telemetry().vehicle_s >= at_s
            if begun_s is None and line and due:
                begun_s = now_s
                if line == "policy":
                    flight.policy = None
                else:
                    for one in (f"mode {PILOT[kind]}" if line == "pilot" else line).split("; "):
                        autopilot.do(one)
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
            looks = []
            for _ in range(2):  # the node goes on a while, and nothing must come of it but what is on its way
                end_s = time.monotonic() + 0.2
                while time.monotonic() < end_s:
                    flight.tick()
                    time.sleep(0.01)
                looks.append(autopilot.report())
            lands_until_s = time.monotonic() + (0.0 if line in ("pilot", "") else 200.0)
            while looks[-1]["armed"] and time.monotonic() < lands_until_s:  # a busy machine is slow
                flight.tick()
                time.sleep(0.01)
                looks[-1] = autopilot.report()
            first, last = looks
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
            "unflown": flight.unflown,
            "armed": len(autopilot.all("armed")),
            "failsafe": any("failsafe" in event["why"] for event in autopilot.all("mode")),
            "modes": [event["mode"] for event in autopilot.all("mode")],
            "then": {key: (first[key], last[key]) for key in ("setpoints", "mode", "armed", "landed", "ned")},
            "interrupted": last["interrupted"],
        }


def flown(cases: list[tuple[Any, ...]]) -> list[dict[str, Any]]:
    """One after the other, in a process of their own: kind, wire, fault and time, or fewer of them."""
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "tests.support.fake_autopilot.faulty",
            *(",".join(map(str, case)) for case in cases),
        ],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=(LIMIT_S + 30.0) * len(cases),
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return [json.loads(line) for line in done.stdout.splitlines()]


def all_flown(cases: list[tuple[Any, ...]]) -> dict[tuple[Any, ...], dict[str, Any]]:
    """Many of them, a few at a time."""
    shares = [cases[number::AT_ONCE] for number in range(AT_ONCE)]
    with ThreadPoolExecutor(AT_ONCE) as threads:
        told = threads.map(flown, shares)
        return {
            case: one
            for share, ones in zip(shares, told, strict=True)
            for case, one in zip(share, ones, strict=True)
        }


def check(name: str, told: dict[str, Any]) -> None:
    """What holds for every mission, whatever happened to it."""
    assert told["outside"] == [], "no setpoint outside the fence"
    assert told["unflown"] == [] or name.startswith("jump"), "no step counts that was not flown"
    assert told["executed"] == sorted(set(told["executed"])), "no step twice"
    assert told["armed"] <= 1, "nobody arms again what was disarmed"
    assert told["unreasoned"] == [], "every change has its reason"
    expected = FAULTS[name][2] if told["begun"] else ("",)
    if told["failsafe"]:  # PX4's, at a hundredth of its patience: the machine was busy elsewhere for too long
        expected = (*expected, "mode AUTO.RTL: changed by")
    if told["phase"] == Phase.LANDED:
        assert "" in expected, told["log"]
    else:
        assert told["phase"] == Phase.ABORTED
        assert any(reason and reason in told["reason"] for reason in expected), told["log"]
    sent = told["then"]["setpoints"]
    assert sent[0] == sent[1], "nothing is sent any more"


def main() -> None:
    """Fly, and tell. Without a fault, in the whole world."""
    use_realtime_priority()  # as the bridge's node should
    for case in sys.argv[1:]:
        kind, wire, name, at_s, *_ = (*case.split(","), *[""] * 3)
        name = name or "none"
        at_s = at_s or ("0" if name == "none" else "")
        print(json.dumps(fly(kind, wire, name, float(at_s) if at_s else None)), flush=True)


if __name__ == "__main__":
    main()
