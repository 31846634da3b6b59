"""Locks on this host that let one run_all at a time publish a mission's topics.

DDS discovery takes time, more on a busy machine: two commands that start together may both find the network
empty. The kernel answers at once. A lock is an abstract Unix socket: it belongs to the network namespace, as
the middleware's own sockets do, holds across the users and containers of a host, and ends with its process.
"""

import errno
import hashlib
import socket
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from uav_dc_ros.nodes.framework.other_publishers import AnotherMissionError

SOCKETS = Path("/proc/net/unix")  # lists the names of all Unix sockets of this network namespace


@contextmanager
def held(domain: int, nodes: Sequence[str], run: str) -> Iterator[None]:
    """Hold the locks of nodes, by full names such as `/uav1/world`, in a ROS domain.

    `run` is shown to others that are refused; empty: unknown. Raises AnotherMissionError if another process
    holds one of the locks.
    """
    with ExitStack() as stack:
        for node in nodes:
            name = f"uav_dc_ros/{domain}{node}"
            if len(name) > 80:  # an address has 107 bytes, of which a run takes 21
                name = f"uav_dc_ros/{hashlib.sha256(name.encode()).hexdigest()}"
            lock = _bound(name)
            if lock is None:
                run = _run(name)
                of_run = f" (run {run})" if run else ""
                raise AnotherMissionError(f"another mission is being flown here by {node}{of_run}")
            stack.enter_context(lock)
            if run and (shown := _bound(f"{name}?run={run}")) is not None:
                stack.enter_context(shown)
        yield


def _bound(name: str) -> socket.socket | None:
    """A socket of an abstract name; None: another process has it."""
    lock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        lock.bind(b"\0" + name.encode())
    except OSError as error:
        lock.close()
        if error.errno == errno.EADDRINUSE:
            return None
        raise
    return lock


def _run(name: str) -> str:
    """Identity of the run that holds a lock; empty: unknown."""
    head = f"@{name}?run="
    found = (line.rpartition(" ")[2] for line in SOCKETS.read_text(errors="replace").splitlines())
    return next((entry.removeprefix(head) for entry in found if entry.startswith(head)), "")
