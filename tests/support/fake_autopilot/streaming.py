"""The pace of setpoints, as the fake autopilot receives them, while other processes want the processor.

    python -m tests.support.fake_autopilot.streaming transport ADDRESS
    python -m tests.support.fake_autopilot.streaming bare ADDRESS

are the two senders: this project's transport, steered ten times a second as the bridge's node does, and
beside it a loop that sleeps until the next setpoint is due and sends the same message, as it is run without
further ado. Both go on until they are ended.
"""

import contextlib
import itertools
import subprocess
import sys
import time
from collections.abc import Iterator

import numpy as np
from pymavlink import mavutil

from tests.support.fake_autopilot.flight import ROOT, Fake, fake
from uav_dc_ros.offboard.mavlink.session import POSITION_ONLY
from uav_dc_ros.offboard.mavlink.vehicle import MavlinkVehicle
from uav_dc_ros.offboard.setpoint_stream import STREAM_S, use_realtime_priority

BURN = "while True: pass"
LOAD = "from uav_dc_ros.agents import policy; policy.load('five_clusters_hover_dueling')"


def transport(address: str) -> None:
    """Stream with the transport."""
    use_realtime_priority()
    with MavlinkVehicle(address) as vehicle:
        while True:
            vehicle.set_setpoint(vehicle.telemetry().position)
            time.sleep(0.1)


def bare(address: str) -> None:
    """Stream with a loop that does nothing else."""
    link = mavutil.mavlink_connection(address, source_system=255, dialect="ardupilotmega")
    link.recv_match(type="HEARTBEAT", blocking=True)
    due_s = time.monotonic()
    while True:
        link.mav.set_position_target_local_ned_send(0, 1, 1, 1, POSITION_ONLY, *([0.0] * 11))
        due_s += STREAM_S
        time.sleep(max(0.0, due_s - time.monotonic()))


@contextlib.contextmanager
def process(*command: str) -> Iterator[subprocess.Popen[bytes]]:
    """Another process, for the time of a block."""
    running = subprocess.Popen([sys.executable, *command], cwd=ROOT)
    try:
        yield running
    finally:
        running.kill()
        running.wait()


@contextlib.contextmanager
def stream(sender: str) -> Iterator[Fake]:
    """A fake autopilot on the ground, and a sender that streams to it by now."""
    with (
        fake("px4", "udp", ready_s=0.5) as autopilot,
        process("-m", "tests.support.fake_autopilot.streaming", sender, autopilot.address),
    ):
        end_s = time.monotonic() + 30.0
        while autopilot.report()["setpoints"] == 0:
            assert time.monotonic() < end_s, f"no setpoint from {sender}"
            time.sleep(0.05)
        yield autopilot


def off_beat_ms(
    seconds: float, senders: tuple[str, ...], burning: int = 0, loading: bool = False
) -> list[float]:
    """How far gaps between setpoints are from what they should be, 99th percentile, of each sender.

    Args:
        seconds: how long to listen.
        senders: of this module, at the same time.
        burning: processes that want a core each.
        loading: does a policy load all the time, and is killed while it does?

    Returns:
        `|gap - 50 ms|`, milliseconds.
    """
    with contextlib.ExitStack() as stack:
        autopilots = [stack.enter_context(stream(sender)) for sender in senders]
        for _ in range(burning):
            stack.enter_context(process("-c", BURN))
        for autopilot in autopilots:
            autopilot.do("times")
        end_s = time.monotonic() + seconds
        for lives_s in itertools.cycle((0.1, 0.4, 1.5)):
            if (left_s := end_s - time.monotonic()) <= 0:
                break
            if not loading:
                time.sleep(left_s)
                continue
            with process("-c", LOAD) as policy, contextlib.suppress(subprocess.TimeoutExpired):
                policy.wait(min(left_s, lives_s))
        gaps_s = [np.diff(autopilot.report()["times"]) for autopilot in autopilots]
    for gaps in gaps_s:
        assert len(gaps) >= 0.8 * seconds / STREAM_S, f"{len(gaps)} setpoints in {seconds:g} s"
    return [float(np.percentile(np.abs(gaps - STREAM_S), 99)) * 1e3 for gaps in gaps_s]


if __name__ == "__main__":
    {"transport": transport, "bare": bare}[sys.argv[1]](sys.argv[2])
