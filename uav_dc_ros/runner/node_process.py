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
from uav_dc_ros.nodes.framework.process_control import FINALIZED, REPORTS, SUPERVISED, NodeReport
from uav_dc_ros.nodes.ros import environment

READ_BYTES = 1 << 16  # capacity of a pipe
DISK_WAIT_S = 0.5  # a process that is silent for so long may wait for the disk
READER_S = 1.0  # timeout for the last lines of output


def waits_for_disk(process_id: int) -> bool:
    """Whether the main thread of a process waits within the kernel, as for a disk that stalls.

    It does not hang: it goes on when the disk does, and until then a kill ends neither it nor its wait.
    """
    try:
        stat = Path(f"/proc/{process_id}/stat").read_bytes()
    except OSError:  # it has ended
        return False
    return stat.rpartition(b") ")[2].startswith(b"D")


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
        self.name = names[0] if is_single else "container"
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
                *(sys.executable, "-m", f"uav_dc_ros.nodes.{self.name}", *([] if is_single else names)),
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
        self.silent_s = 0.0  # since the last report, or the start
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

    def receive_reports(self, passed_s: float) -> None:
        """Update `reports` and `silent_s`; `passed_s` is the time since the last call."""
        try:
            received = os.read(self._pipe, READ_BYTES)
        except BlockingIOError:
            received = b""
        if received:
            self.silent_s = 0.0
        elif self.silent_s < DISK_WAIT_S or not waits_for_disk(self.process.pid):
            self.silent_s += passed_s
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
