"""Is the policy gone: soon when it was killed, and never while the computer is only busy."""

import contextlib
import os
import signal
import subprocess
import sys
import time

import pytest

from tests.conftest import Ros, finish
from tests.support.fake_autopilot.mavros_flight import node_in, spin
from uav_dc_ros.nodes.ros.liveliness import CONFIRMED_S, LivelinessFilter, LivelinessMonitor
from uav_dc_ros.topics import TOPICS

TICK_S = 0.02


def test_liveliness_that_comes_back_at_once_was_not_lost() -> None:
    now_s = 100.0
    confirmed = LivelinessFilter(lambda: now_s)
    assert not confirmed.is_lost(False), "no publisher yet"
    assert not confirmed.is_lost(True)
    lost = []
    for alive in (*[False] * 10, True, *[False] * 14):
        now_s += TICK_S
        lost.append(confirmed.is_lost(alive))
    assert lost == [*[False] * 24, True]
    assert 12 * TICK_S < CONFIRMED_S <= 13 * TICK_S
    now_s += TICK_S
    assert not confirmed.is_lost(True)
    now_s += 3.0  # this process itself stood still: what it sees first is old
    assert not confirmed.is_lost(False)
    confirmed.reset()
    for _ in range(20):
        now_s += TICK_S
        assert not confirmed.is_lost(False), "another publisher without a lease"


def test_a_policy_that_was_killed_is_missed_and_one_that_was_held_up_is_not(ros: Ros) -> None:
    with (
        node_in(ros) as (node, executor),
        contextlib.closing(LivelinessMonitor(node, TOPICS["move"])) as lease,
    ):
        policy = ros.start("uav_dc_ros.nodes.policy")
        try:
            end_s = time.monotonic() + 60.0
            while not lease._filter._was_alive:
                assert time.monotonic() < end_s
                lease.is_lost()
                spin(executor, TICK_S)
            held_up(policy, 0.5)
            end_s = time.monotonic() + 1.0
            while time.monotonic() < end_s:
                assert not lease.is_lost(), "it was held up for a moment only"
                spin(executor, TICK_S)
        finally:
            policy.kill()
        killed_s = time.monotonic()
        while not lease.is_lost():
            assert time.monotonic() < killed_s + 60.0
            spin(executor, TICK_S)
        finish(policy)


def held_up(process: subprocess.Popen[str], seconds: float) -> None:
    """Have a process stand still, as on a computer that has other things to do."""
    process.send_signal(signal.SIGSTOP)
    time.sleep(seconds)
    process.send_signal(signal.SIGCONT)


@pytest.mark.long
def test_a_busy_computer_is_no_dead_policy(ros: Ros) -> None:
    """Eight busy processes for each core, for a minute: not once; killed among them, it is missed."""
    busy = [
        subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(8 * (os.cpu_count() or 1))
    ]
    try:
        with (
            node_in(ros) as (node, executor),
            contextlib.closing(LivelinessMonitor(node, TOPICS["move"])) as lease,
        ):
            policy = ros.start("uav_dc_ros.nodes.policy")
            times = []
            try:
                end_s = time.monotonic() + 300.0
                while not lease._filter._was_alive:
                    assert time.monotonic() < end_s
                    lease.is_lost()
                    spin(executor, TICK_S)
                end_s = time.monotonic() + 60.0
                while time.monotonic() < end_s:
                    times.append(lease.is_lost())
                    spin(executor, TICK_S)
            finally:
                policy.kill()
            killed_s = time.monotonic()
            while not lease.is_lost():
                assert time.monotonic() < killed_s + 60.0
                spin(executor, TICK_S)
            print(f"{sum(times)} of {len(times)} looks; missed after {time.monotonic() - killed_s:.2f} s")
            assert not any(times)
            finish(policy)
    finally:
        for process in busy:
            process.kill()
            process.wait()
