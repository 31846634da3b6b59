"""Locks on this host that let one run_all at a time publish a mission's topics."""

import os
import subprocess
import sys
from collections.abc import Iterator

import pytest

from tests.conftest import until
from uav_dc_ros.nodes.framework.other_publishers import AnotherMissionError
from uav_dc_ros.runner import node_locks

# No domain of ROS, so that no mission of this machine is refused for a test.
DOMAIN = 1_000_000 + os.getpid()
NODES = ["/uav1/world", "/uav1/policy"]
LONG = "/" + "/".join(["a_namespace_of_a_fleet"] * 8) + "/world"


def refused(nodes: list[str], domain: int = DOMAIN) -> str | None:
    """Why the locks cannot be had, if so."""
    try:
        with node_locks.held(domain, nodes, "fedcba9876543210"):
            return None
    except AnotherMissionError as error:
        return str(error)


@pytest.mark.parametrize("run", ["0123456789abcdef", ""])
@pytest.mark.parametrize("node", [NODES[1], LONG])
def test_a_node_is_published_by_one_command_at_a_time(run: str, node: str) -> None:
    of_run = f" (run {run})" if run else ""
    with node_locks.held(DOMAIN, [NODES[0], node], run):
        told = refused(["/uav1/recorder", node])
        assert told is not None
        assert told.startswith(f"another mission is being flown here by {node}{of_run}: give this one")
        assert refused(["/uav1/recorder"]) is None, "what was locked before the refusal is free again"
        assert refused(["/uav2/policy"]) is None, "another namespace"
        assert refused([node], DOMAIN + 1) is None, "another domain"
    assert refused([NODES[0], node]) is None


@pytest.fixture
def holder() -> Iterator[subprocess.Popen[str]]:
    """A process that holds a lock."""
    code = f"""
from uav_dc_ros.runner import node_locks
with node_locks.held({DOMAIN}, {NODES!r}, "0123456789abcdef"):
    print("held", flush=True)
    input()
"""
    command = [sys.executable, "-c", code]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    yield process
    process.kill()
    process.communicate()


def test_a_lock_ends_with_its_process(holder: subprocess.Popen[str]) -> None:
    assert holder.stdout is not None
    assert holder.stdout.readline() == "held\n"
    told = refused(NODES[1:])
    assert told is not None
    assert "/uav1/policy (run 0123456789abcdef)" in told
    holder.kill()
    until(lambda: refused(NODES) is None)
