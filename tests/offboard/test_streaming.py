"""The pace of setpoints while other processes burn the processor, and a policy loads and is killed."""

import multiprocessing
import os
import threading
import time

import pytest

from tests.conftest import PATIENCE_S
from tests.support.fake_autopilot.streaming import off_beat_ms
from uav_dc_ros.offboard.mavlink.vehicle import MavlinkVehicle
from uav_dc_ros.offboard.setpoint_stream import use_realtime_priority

AIM_MS = 10.0


def _may() -> bool:
    """Does this machine let a thread run when it is due; in a thread that ends then."""
    answers: list[bool] = []
    thread = threading.Thread(target=lambda: answers.append(use_realtime_priority()))
    thread.start()
    thread.join()
    return answers[0]


@pytest.mark.long  # it occupies all CPUs for as long as it measures
def test_setpoints_keep_their_pace_on_a_busy_computer() -> None:
    found = []
    for _ in range(3):  # one hiccup of a virtual machine is two of the eighty gaps of a try
        ours_ms, bare_ms = off_beat_ms(4.0, ("transport", "bare"), burning=os.cpu_count() or 1, loading=True)
        found.append(f"{ours_ms:.1f} ms; a bare loop {bare_ms:.1f} ms")
        # Where the system does not let it run when due: no better than any other process, and not much worse.
        if ours_ms < (AIM_MS if _may() else AIM_MS + 2 * bare_ms):
            return
    raise AssertionError(found)


def test_the_thread_that_streams_runs_when_it_is_due() -> None:
    if not _may():
        pytest.skip("this process may not set it")
    with MavlinkVehicle("tcp:127.0.0.1:1") as vehicle:
        end_s = time.monotonic() + PATIENCE_S
        while "refused" not in str(vehicle.telemetry().missing):  # by then it runs
            assert time.monotonic() < end_s
            time.sleep(0.01)
        thread = next(thread for thread in threading.enumerate() if thread.name == "mavlink")
        assert thread.native_id is not None
        assert os.sched_getscheduler(thread.native_id) & ~os.SCHED_RESET_ON_FORK == os.SCHED_RR


def test_what_is_started_from_a_thread_that_runs_when_due_is_ordinary() -> None:
    if not _may():
        pytest.skip("this process may not set it")
    seen: dict[str, int] = {}

    def look() -> None:
        use_realtime_priority()
        seen["realtime"] = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK
        child = threading.Thread(target=lambda: seen.update(thread=os.sched_getscheduler(0)))
        child.start()
        child.join()
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            seen["process"] = pool.apply(os.sched_getscheduler, (0,))

    thread = threading.Thread(target=look)
    thread.start()
    thread.join()
    assert seen == {"realtime": os.SCHED_RR, "thread": os.SCHED_OTHER, "process": os.SCHED_OTHER}
