"""What a mission prints can neither delay it nor end it."""

import fcntl
import json
import os
import subprocess
import sys
import termios
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.conftest import PATIENCE_S, Ros
from uav_dc_ros import cli
from uav_dc_ros.cli import Output

MISSION = ("--pace", "lockstep", "--no-record", "--nodes", "world,channel_monitor,policy", "--compose")
MISSION = (*MISSION, "--scenario", "three_clusters_hover", "--summary")


def test_pieces_are_written_in_their_order(tmp_path: Path) -> None:
    out = Output()
    with (tmp_path / "a").open("w", encoding="ascii") as stream:
        for console in (out.console(stream), out.console(stream)):
            console.print("ä\udcff", 1)
        out.drain()
    assert (tmp_path / "a").read_bytes() == 2 * b"\\xe4\\udcff 1\n"


def test_what_cannot_be_written_is_lost() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    out = Output()
    with open("/dev/full", "w") as full, os.fdopen(writer, "w") as closed:
        for stream in (full, closed):
            out.console(stream).print("lost")
        out.drain()


def test_a_reader_that_takes_nothing_delays_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cli, "QUEUE_MAX", 10)
    monkeypatch.setattr(cli, "DRAIN_S", 0.05)
    reader, writer = os.pipe()
    with os.fdopen(reader, "rb") as stalled, os.fdopen(writer, "w") as stream:
        out = Output()
        console = out.console(stream)
        for _ in range(100):
            console.print("x" * 10_000)  # ten times what pipe and queue hold
        out.drain()
        os.set_blocking(stalled.fileno(), False)
        while stalled.read():  # so that the thread's last write ends
            time.sleep(0.01)


def own_terminal(descriptor: int) -> Callable[[], None]:
    """To be called in a child: the terminal is its controlling one, and hangs up on it."""

    def take() -> None:
        os.setsid()
        fcntl.ioctl(descriptor, termios.TIOCSCTTY, 0)

    return take


def test_missions_outlive_their_terminal_and_a_full_disk(ros: Ros) -> None:
    """One loses its terminal, with SIGHUP, when the first step is shown; one never had a place to print."""
    ours, theirs = os.openpty()
    command = [sys.executable, "-m", "uav_dc_ros.run_all", *MISSION]
    process = subprocess.Popen(
        [*command, "terminal.json", "--pace", "200"],
        env=ros.environment,
        cwd=ros.folder,
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        preexec_fn=own_terminal(theirs),
    )
    os.close(theirs)
    shown = b""
    while b"Mbit/s" not in shown:
        shown += os.read(ours, 4096)
    os.close(ours)
    assert process.wait(120) == 0
    with open("/dev/full", "w") as full:
        full_disk = subprocess.run(
            [*command, "full.json"],
            env=ros.environment,
            cwd=ros.folder,
            stdout=full,
            stderr=full,
            timeout=PATIENCE_S,
            check=False,
        )
    assert full_disk.returncode == 0
    for name in ("terminal.json", "full.json"):
        assert json.loads((ros.folder / name).read_text())["outcome"] == "landed"
