"""A process that runs one node of the node table, or several.

The process ends with its standard input, so it never outlives run_all. Its output is passed on line by line.
The executor's thread sends reports through a pipe, also while idle: a process without reports hangs.
"""

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path

from uav_dc_ros.errors import NodeError
from uav_dc_ros.nodes.framework import process_control
from uav_dc_ros.nodes.framework.node_table import NODES
from uav_dc_ros.nodes.framework.process_control import FINALIZED, REPORTS, SUPERVISED, NodeReport
from uav_dc_ros.nodes.ros import environment

READ_BYTES = 1 << 16  # capacity of a pipe
BLOCKED_S = 0.5  # a process that is silent for so long may wait for the disk or for a CPU
READER_S = 1.0  # timeout for the last lines of output


def waits_for_disk(process_id: int) -> bool:
    """Whether the main thread of a process waits within the kernel, as for a disk that stalls.

    It does not hang: it goes on when the disk does, and until then a kill ends neither it nor its wait.
    """
    try:
        return _state(Path(f"/proc/{process_id}")).startswith(b"D")
    except OSError:  # it has ended
        return False


def _state(folder: Path) -> bytes:
    """State of a process or thread, a letter, and what follows it in its folder of /proc."""
    return (folder / "stat").read_bytes().rpartition(b") ")[2]


class CpuWaits:
    """How long the threads of a process had no CPU while they were ready to run, since the first look."""

    def __init__(self, process_id: int) -> None:
        self._threads = Path(f"/proc/{process_id}/task")
        self._began_s: dict[str, float] = {}  # finished waits of each thread at its first look
        self._changed: dict[str, tuple[str, float]] = {}  # its counters, and when they had changed last

    def longest_s(self, now_s: float) -> float:
        """Wait of the thread that waited longest; 0.0 where the kernel does not count."""
        longest_s = 0.0
        with contextlib.suppress(OSError):  # the process has ended
            for thread in self._threads.iterdir():
                with contextlib.suppress(OSError, IndexError):  # the thread has ended
                    longest_s = max(longest_s, self._wait_s(thread, now_s))
        return longest_s

    def _wait_s(self, thread: Path, now_s: float) -> float:
        counters = (thread / "schedstat").read_text()  # time on a CPU, time of finished waits, ns; turns
        finished_s = int(counters.split()[1]) / 1e9
        if self._changed.get(thread.name, ("", 0.0))[0] != counters:
            self._changed[thread.name] = counters, now_s
        wait_s = finished_s - self._began_s.setdefault(thread.name, finished_s)
        if _state(thread).startswith(b"R"):  # it has waited since its counters changed last
            wait_s += now_s - self._changed[thread.name][1]
        return wait_s


class Silence:
    """Time without a sign of life of a process, less the time for which it waited for the disk or for a CPU.

    On a busy computer a process may wait for most of the time. It does not hang: a kill would only add load.
    """

    def __init__(self, process_id: int) -> None:
        self._process_id = process_id
        self.end()

    def end(self) -> None:
        """Note a sign of life."""
        self._passed_s = 0.0
        self._waits: CpuWaits | None = None  # from `BLOCKED_S` on
        self.silent_s = 0.0

    def add(self, passed_s: float) -> None:
        """Add time without a sign of life."""
        if self._passed_s < BLOCKED_S or not waits_for_disk(self._process_id):
            self._passed_s += passed_s
        if self._passed_s < BLOCKED_S:
            self.silent_s = self._passed_s
            return
        # All threads count: they wait for one another's locks, in the middleware and in Python.
        self._waits = self._waits or CpuWaits(self._process_id)
        self.silent_s = max(0.0, self._passed_s - self._waits.longest_s(time.monotonic()))


class NodeProcess:
    """A running process of one node, or of several, with ROS parameters by node name.

    `restarts` counts earlier processes of these nodes. A thread calls `on_line` with the name of the process
    and each line of its output. Raises NodeError if the parameter file cannot be written into `folder`.
    """

    def __init__(
        self,
        parameters: Mapping[str, Mapping[str, object]],
        namespace: str,
        restarts: int,
        folder: Path,
        on_line: Callable[[str, str], None],
    ) -> None:
        names = list(parameters)
        is_single = len(names) == 1
        self.name = names[0] if is_single else NODES[names[0]].container
        self.description = f"node {self.name}" if is_single else f"the container of {', '.join(names)}"
        file = folder / f"{self.name}.yaml"
        of_nodes = {f"/**/{name}": {"ros__parameters": values} for name, values in parameters.items()}
        try:  # JSON is valid YAML, and keeps any text
            file.write_text(json.dumps(of_nodes, ensure_ascii=False), "utf-8")
        except (OSError, UnicodeEncodeError) as error:
            raise NodeError(
                f"parameters of {self.description} cannot be written to {file}: {error}"
            ) from None
        self._pipe, write_end = os.pipe()
        os.set_blocking(self._pipe, False)
        variables = {SUPERVISED: str(restarts), REPORTS: str(write_end)}
        if not is_single and os.environ.get(environment.LINES) == environment.LINE_OF_NODE:
            variables[environment.LINES] = environment.LINE_OF_ONE_OF_MANY
        self.process = subprocess.Popen(
            [
                *(sys.executable, "-m", f"uav_dc_ros.nodes.{self.name if is_single else 'container'}"),
                *([] if is_single else names),
                *("--ros-args", "--params-file", str(file)),
                *("-r", f"__ns:={namespace}", "-r", "/clock:=clock"),
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env={**os.environ, **variables},
            pass_fds=(write_end,),
            start_new_session=True,  # Ctrl-C reaches run_all only, which stops the nodes in order
        )
        os.close(write_end)
        self.kill_reason = ""  # empty: not killed
        self._silence = Silence(self.process.pid)
        self.reports: Mapping[str, NodeReport] = {}  # last one by node name; empty until the start
        self._partial = b""  # start of a report
        self._on_line = on_line
        self._last_line = ""
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for raw in self.process.stdout:
            self._last_line = raw.decode(errors="replace").rstrip()
            self._on_line(self.name, self._last_line)

    @property
    def silent_s(self) -> float:
        """Time since the last report or the start, without that for which the process was blocked."""
        return self._silence.silent_s

    def receive_reports(self, passed_s: float) -> None:
        """Update `reports` and `silent_s`; `passed_s` is the time since the last call."""
        try:
            received = os.read(self._pipe, READ_BYTES)
        except BlockingIOError:
            received = b""
        if received:
            self._silence.end()
        else:
            self._silence.add(passed_s)
        *lines, self._partial = (self._partial + received).split(b"\n")
        if lines:
            self.reports = process_control.decode(lines[-1])

    def command(self, transition: str, node: str) -> None:
        """Command a transition of one of its nodes."""
        assert self.process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # it has ended: see `has_ended`
            os.write(self.process.stdin.fileno(), process_control.command(transition, node))

    def kill(self, reason: str) -> None:
        """Kill a process that hangs."""
        self.kill_reason = reason
        self.process.kill()

    def exit_description(self) -> str:
        """How the process ended, and its last line of output."""
        self._reader.join(READER_S)
        status = self.process.returncode
        how = f"was killed by {signal.Signals(-status).name}" if status < 0 else f"ended with {status}"
        how = f"{self.kill_reason}, and {how}" if self.kill_reason else how
        return f"{how}: {self._last_line or 'it printed nothing'}"

    @property
    def has_ended(self) -> bool:
        """Whether the process has ended."""
        return self.process.poll() is not None

    @property
    def is_finalized(self) -> bool:
        """Whether none of its nodes publishes any more: all are finalized, or the process has ended."""
        self.receive_reports(0.0)
        return {report.state for report in self.reports.values()} == {FINALIZED} or self.has_ended

    def terminate(self) -> None:
        """Send SIGTERM: unlike SIGINT it ends a starting Python without a traceback."""
        self.process.terminate()

    def wait(self, deadline_s: float) -> int:
        """Wait for the end until a deadline of the monotonic clock, then kill; returns the exit status."""
        try:
            status = self.process.wait(max(0.0, deadline_s - time.monotonic()))
        except subprocess.TimeoutExpired:
            self.process.kill()
            status = self.process.wait()
        self.close()
        return status

    def close(self) -> None:
        """Close the pipes of an ended process."""
        self._reader.join(READER_S)
        if self._pipe >= 0:
            os.close(self._pipe)
            self._pipe = -1
        for pipe in (self.process.stdin, self.process.stdout):
            assert pipe is not None
            pipe.close()
