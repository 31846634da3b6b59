"""Starts the nodes of a mission as processes, watches them, and stops them in order.

A node under the launcher ends when its standard input ends, so no node outlives a launcher that was
killed. What nodes print on standard error is passed on with the node's name in front.
"""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Self

from uav_dc_ros.errors import NodeError
from uav_dc_ros.nodes.runtime import SUPERVISED
from uav_dc_ros.nodes.table import NODES

STOP_S = 5.0  # for a node to end after it was asked to


class NodeProcess:
    """One node as a process of its own.

    Args:
        name: of a row of the node table.
        parameters: its ROS parameters.
        on_line: called, from a thread, with each line that the node prints.
    """

    def __init__(
        self, name: str, parameters: Mapping[str, object], on_line: Callable[[str, str], None]
    ) -> None:
        self.name = name
        arguments = [sys.executable, "-m", f"uav_dc_ros.nodes.{name}", "--ros-args"]
        for key, value in parameters.items():
            arguments += ["-p", f"{key}:={json.dumps(value)}"]  # JSON is YAML: any text arrives as it is
        environment = {**os.environ, SUPERVISED: "1"}
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
        self._reader.join(1.0)
        for pipe in (self.process.stdin, self.process.stdout):
            assert pipe is not None
            pipe.close()
        return status


class Launcher:
    """The nodes of a mission; a context manager that leaves no process behind.

    Args:
        on_line: called, from threads, with each line that a node prints.
    """

    def __init__(self, on_line: Callable[[str, str], None]) -> None:
        self._on_line = on_line
        self.nodes: list[NodeProcess] = []

    def start(self, name: str, parameters: Mapping[str, object]) -> None:
        """Start a node of the node table with its ROS parameters."""
        self.nodes.append(NodeProcess(name, parameters, self._on_line))

    def __enter__(self) -> Self:
        """Use the launcher in a `with` statement."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop whatever still runs."""
        self.stop()

    def check(self) -> None:
        """Make sure that every node runs.

        Raises:
            NodeError: one has ended.
        """
        for node in self.nodes:
            if node.ended:
                node._reader.join(1.0)
                status = node.process.returncode
                how = (
                    f"was killed by {signal.Signals(-status).name}" if status < 0 else f"ended with {status}"
                )
                raise NodeError(f"node {node.name} {how}: {node.last_line or 'it printed nothing'}")

    def stop(self) -> dict[str, int]:
        """Stop all nodes, lower ranks of the node table first. Returns their exit statuses."""
        statuses = {}
        for rank in sorted({NODES[node.name].stop_rank for node in self.nodes}):
            group = [node for node in self.nodes if NODES[node.name].stop_rank == rank]
            for node in group:
                node.ask_to_stop()
            deadline_s = time.monotonic() + STOP_S
            for node in group:
                statuses[node.name] = node.wait(deadline_s)
        self.nodes = []
        return statuses
