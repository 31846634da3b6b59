"""Runs a node of the node table as a process.

Such a node ends when its standard input ends, so no node outlives a run_all that was killed. What it prints
is passed on with its name in front.
"""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping

from uav_dc_ros.nodes.mission_node import SUPERVISED


class NodeProcess:
    """One node as a process of its own.

    Args:
        name: of a row of the node table.
        namespace: that it lives in; its clock is that of the namespace, too.
        parameters: its ROS parameters.
        restarts: how often it was started before.
        on_line: called, from a thread, with each line that the node prints.
    """

    def __init__(
        self,
        name: str,
        namespace: str,
        parameters: Mapping[str, object],
        restarts: int,
        on_line: Callable[[str, str], None],
    ) -> None:
        self.name = name
        arguments = [sys.executable, "-m", f"uav_dc_ros.nodes.{name}", "--ros-args"]
        arguments += ["-r", f"__ns:={namespace}", "-r", "/clock:=clock"]
        for key, value in parameters.items():
            arguments += ["-p", f"{key}:={json.dumps(value)}"]  # JSON is YAML: any text arrives as it is
        environment = {**os.environ, SUPERVISED: str(restarts)}
        self.process = subprocess.Popen(
            arguments,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env=environment,
            start_new_session=True,  # Ctrl-C reaches the launcher alone, which stops nodes in order
        )
        self._on_line = on_line
        self.last_line = ""
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for raw in self.process.stdout:
            self.last_line = raw.decode(errors="replace").rstrip()
            self._on_line(self.name, self.last_line)

    def how_it_ended(self) -> str:
        """How the process ended, and its last line, in words."""
        self._reader.join(1.0)
        status = self.process.returncode
        how = f"was killed by {signal.Signals(-status).name}" if status < 0 else f"ended with {status}"
        return f"{how}: {self.last_line or 'it printed nothing'}"

    @property
    def ended(self) -> bool:
        """Has the process ended."""
        return self.process.poll() is not None

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
        for pipe in (self.process.stdin, self.process.stdout):
            assert pipe is not None
            pipe.close()
