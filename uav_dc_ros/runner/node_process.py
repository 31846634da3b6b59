"""Runs a node of the node table as a process, or several in one.

Such a process ends when its standard input ends, so none outlives a run_all that was killed. What it prints
is passed on with its name in front. The thread that runs its callbacks sends reports through a pipe, also
while there is nothing to do: a process that sends none hangs.
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

READ_MAX = 1 << 16  # bytes; no pipe holds more


class NodeProcess:
    """A process of one node, or of several.

    Args:
        parameters: ROS parameters of its nodes, by name of their rows in the node table.
        namespace: that they live in; their clock is that of the namespace, too.
        restarts: how often they were started before.
        folder: for a file with the parameters.
        on_line: called, from a thread, with each line that the process prints.

    Raises:
        NodeError: the file cannot be written.

    Attributes:
        name: of the module that it runs.
        who: it, in words.
        failure: why it was killed; empty if it was not.
        reports: the last report of each of its nodes, by name; empty until it has started.
        silent_s: time since its last report, or its start, seconds.
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
        alone = len(names) == 1
        self.name = names[0] if alone else "container"
        self.who = f"node {self.name}" if alone else f"the container of {', '.join(names)}"
        file = folder / f"{self.name}.yaml"
        of_nodes = {f"/**/{name}": {"ros__parameters": values} for name, values in parameters.items()}
        try:  # JSON is YAML: any text arrives as it is
            file.write_text(json.dumps(of_nodes, ensure_ascii=False), "utf-8")
        except (OSError, UnicodeEncodeError) as error:
            raise NodeError(f"parameters of {self.who} cannot be written to {file}: {error}") from None
        self._pipe, theirs = os.pipe()
        os.set_blocking(self._pipe, False)
        own = {SUPERVISED: str(restarts), REPORTS: str(theirs)}
        if not alone and os.environ.get(environment.LINES) == environment.LINE_OF_NODE:
            own[environment.LINES] = environment.LINE_OF_ONE_OF_MANY
        self.process = subprocess.Popen(
            [
                *(sys.executable, "-m", f"uav_dc_ros.nodes.{self.name}", *([] if alone else names)),
                *("--ros-args", "--params-file", str(file)),
                *("-r", f"__ns:={namespace}", "-r", "/clock:=clock"),
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env={**os.environ, **own},
            pass_fds=(theirs,),
            start_new_session=True,  # Ctrl-C reaches the launcher alone, which stops nodes in order
        )
        os.close(theirs)
        self.failure = ""
        self.silent_s = 0.0
        self.reports: Mapping[str, NodeReport] = {}
        self._unread = b""  # the beginning of a report
        self._on_line = on_line
        self.last_line = ""
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for raw in self.process.stdout:
            self.last_line = raw.decode(errors="replace").rstrip()
            self._on_line(self.name, self.last_line)

    def watch(self, passed_s: float) -> None:
        """Take in reports; `passed_s` seconds have passed since this was done last."""
        try:
            received = os.read(self._pipe, READ_MAX)
        except BlockingIOError:
            received = b""
        self.silent_s = 0.0 if received else self.silent_s + passed_s
        *lines, self._unread = (self._unread + received).split(b"\n")
        if lines:
            self.reports = process_control.decode(lines[-1])

    def command(self, transition: str, node: str) -> None:
        """Command a transition of one of its nodes."""
        assert self.process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # it has ended, which is seen as any other end
            os.write(self.process.stdin.fileno(), process_control.command(transition, node))

    def kill(self, why: str) -> None:
        """End a process that hangs."""
        self.failure = why
        self.process.kill()

    def how_it_ended(self) -> str:
        """How the process ended, and its last line, in words."""
        self._reader.join(1.0)
        status = self.process.returncode
        how = f"was killed by {signal.Signals(-status).name}" if status < 0 else f"ended with {status}"
        how = f"{self.failure}, and {how}" if self.failure else how
        return f"{how}: {self.last_line or 'it printed nothing'}"

    @property
    def ended(self) -> bool:
        """Has the process ended."""
        return self.process.poll() is not None

    @property
    def is_silent(self) -> bool:
        """Have all its nodes said their last, or has the process ended."""
        self.watch(0.0)
        states = {report.state for report in self.reports.values()}
        return states == {FINALIZED} or self.ended

    def ask_to_stop(self) -> None:
        """Send SIGTERM: unlike SIGINT it ends a Python that still starts without a traceback."""
        if not self.ended:
            self.process.terminate()

    def wait(self, deadline_s: float) -> int:
        """Wait for the end until `deadline_s` of the monotonic clock, then kill. Returns the status."""
        try:
            status = self.process.wait(max(0.0, deadline_s - time.monotonic()))
        except subprocess.TimeoutExpired:
            self.process.kill()
            status = self.process.wait()
        self.close()
        return status

    def close(self) -> None:
        """Let go of the pipes of a process that has ended."""
        self._reader.join(1.0)
        if self._pipe >= 0:
            os.close(self._pipe)
            self._pipe = -1
        for pipe in (self.process.stdin, self.process.stdout):
            assert pipe is not None
            pipe.close()
