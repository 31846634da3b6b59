"""Lies that break no rule: no receiver can tell them from the truth. They may spoil a mission, never a node.

Only an authenticated network (SROS 2) keeps them out. What must hold without one: nothing crashes, and the
run comes to its end.
"""

import json
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import Ros, finish, wait_for
from tests.nodes.conftest import SMALL
from tests.nodes.test_fuzz import COMPARED, PEERS, flown, said_by_nodes
from tests.support.worlds import saved
from uav_dc_ros import scenarios
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.nodes.framework.node_table import NODES

MISSIONS = 120  # so many that the lie is told before they are over
LATER = 20  # a mission that is yet to come when the lie is told
FAR_NS = 2**62


def lies(scenario: Scenario) -> dict[str, tuple[str, dict[str, Any]]]:
    """Topic and payload (or pose) of each lie, by name."""
    n = scenario.n_users
    users = {
        "mission": LATER,
        "step": 3,
        "stamp_ns": 0,
        "cluster": scenario.user_cluster.tolist(),
        "x_m": [0.0] * n,
        "y_m": [0.0] * n,
    }
    rates = {
        "mission": LATER,
        "step": 3,
        "sum_rate_bps": 0.0,
        **{name: [1e7] * n for name in ("sinr", "rate_bps", "data_bits")},
        **{name: [True] * n for name in ("served", "collected")},
    }
    mission = {
        "mission": LATER,
        "step": 3,
        "phase": "ready",
        "cell": [0, 0, 0],
        "remaining_steps": 3,
        "seed": LATER,
        "scenario": scenario.name,
        "fingerprint": scenario.fingerprint,
    }
    return {
        "users of a later step": ("users", users),
        "users at the start of another mission": ("users", users | {"step": 0}),
        "users whose pose is far away in time": ("users", users | {"stamp_ns": FAR_NS}),
        "users beyond all distances": ("users", users | {"step": 0, "x_m": [1.7e308] * n}),
        "rates of a later step": ("rates", rates),
        "rates of a later step, without bounds": ("rates", rates | {"data_bits": [1e308] * n}),
        "rates of no step": ("rates", rates | {"step": 2**31 - 1}),
        "a later step": ("mission", mission),
        "a step in a cell of no grid": ("mission", mission | {"cell": [2**31 - 1] * 3}),
        "a step with more steps left than there are": ("mission", mission | {"remaining_steps": 2**31 - 1}),
        "the end of a later mission": ("mission", mission | {"phase": "aborted"}),
        "a mission with another seed": ("mission", mission | {"seed": 7}),
        "a move for a later step": ("move", {"mission": LATER, "step": 3, "action": "left"}),
        "of another run": ("mission", mission | {"run": "f" * 16, "phase": "landed"}),
        "ready, of nobody": ("ready", {"node": "nobody"}),
        "ready, of the policy": ("ready", {"node": "policy"}),
        "a pose of the past": ("pose", {"x": 1e3, "stamp_ns": -(10**9)}),
        "a pose of the far future": ("pose", {"x": 1e3, "stamp_ns": 2 * 10**18}),
        "a pose beyond all distances": ("pose", {"x": 1e308, "stamp_ns": 0}),
    }


def options(folder: Path) -> list[object]:
    """A run of small missions in lockstep, slow enough for a liar; an untrained policy does."""
    scenario = folder / "small.toml"
    if not scenario.exists():
        scenario.write_text(SMALL)
        saved(folder / "untrained", scenarios.load(scenario), name="untrained")
    nodes = ",".join(PEERS[:4])
    flown = ("--scenario", scenario, "--policy", folder / "untrained", "--missions", MISSIONS)
    return [*flown, "--pace", "lockstep", "--no-compose", "--nodes", nodes]


@pytest.fixture(scope="module")
def truth(module_ros: Ros) -> dict[str, list[Any]]:
    """What the nodes say when nobody lies to them."""
    bag = module_ros.folder / "bag"
    status, output = module_ros.run_all(*options(module_ros.folder), "--bag", bag)
    assert status == 0, output
    return said_by_nodes(bag)


# These change nothing.
HARMLESS = (
    "users of a later step",
    "users beyond all distances",
    "rates of no step",
    "a move for a later step",
    "ready, of nobody",
    "ready, of the policy",
    "a pose of the past",
    "a pose beyond all distances",
    "users whose pose is far away in time",
    "a pose of the far future",
    "a step in a cell of no grid",
    "a step with more steps left than there are",
    "of another run",
)
# These may change a move or a summary, or end the run: they say what only the true node should say.
HARMFUL = (
    "users at the start of another mission",  # the books of this one are closed: no further rates
    "rates of a later step",  # the policy decides that step, and the summary tells of it, by the lie
    "rates of a later step, without bounds",
    "a later step",  # the policy decides by the lie, if the rates come before the true word
    "the end of a later mission",
    "a mission with another seed",  # the policy decides by the lie, if the rates come before the true word
)


@pytest.mark.long
@pytest.mark.parametrize("lie", [*HARMLESS, *HARMFUL])
def test_a_lie_ends_no_node_and_no_run_hangs(ros: Ros, truth: dict[str, list[Any]], lie: str) -> None:
    given = options(ros.folder)
    topic, payload = lies(scenarios.load(ros.folder / "small.toml"))[lie]
    flight = ros.start("uav_dc_ros.run_all", *given, "--bag", ros.folder / "bag")
    assert flight.stdout is not None
    output = wait_for(flight.stdout, "mission 2 of")
    probe = ros.stranger("probe")
    assert probe.stdin is not None
    payload = payload if topic == "pose" else {"run": ros.run_id(), **payload}
    hearing = sum(topic in NODES[peer].subscribes for peer in PEERS)
    command = {"pose": payload["x"], "frame": "map", **payload} if topic == "pose" else {}
    command |= {"topic": topic, "hearing": hearing, "data": json.dumps(payload)}
    probe.stdin.write(json.dumps(command) + "\n")
    probe.stdin.close()
    status, rest = finish(flight, 120)
    probe.wait(90)
    output += rest

    assert "Traceback" not in output
    assert "it is restarted" not in output
    assert status in (0, 1)  # a mission that stands still is given up after a while
    if lie not in HARMFUL:
        assert status == 0, output
        said = said_by_nodes(ros.folder / "bag")
        for name in COMPARED:
            assert list(flown(said[name]).items()) == list(flown(truth[name]).items())


def test_every_lie_is_told() -> None:
    told = [*HARMLESS, *HARMFUL]
    assert sorted(told) == sorted(lies(scenarios.load("five_clusters_hover")))
