"""Missions of a policy that searches: nodes, rollout and bag agree to the last bit."""

import numpy as np
import pytest

from tests.conftest import WITHOUT_VISUALIZER, Ros, read_bag
from uav_dc_ros import bag as command
from uav_dc_ros import scenarios
from uav_dc_ros.agents import agent as agents
from uav_dc_ros.core.grid import ACTION_LABELS
from uav_dc_ros.core.world import rollout_steps

SEED, WEIGHT, N = 5, 0.8, 16
NAME = "three_clusters_hover"
GIVEN = ("--scenario", NAME, "--seed", SEED, "--search", N, "--objective", WEIGHT, "--bag", "bag")


def verified(ros: Ros, capsys: pytest.CaptureFixture[str]) -> str:
    """What `bag verify` prints of the bag, in which nothing differs."""
    with pytest.raises(SystemExit) as end:
        command.main(["verify", str(ros.folder / "bag")])
    out = capsys.readouterr().out
    assert end.value.code == 0, out
    return out


def test_a_search_flies_in_nodes_as_in_a_rollout(ros: Ros, capsys: pytest.CaptureFixture[str]) -> None:
    nodes = (*WITHOUT_VISUALIZER, "--pace", "lockstep")
    status, output = ros.run_all(*GIVEN, *nodes)
    assert status == 0, output
    scenario, actions = scenarios.load(NAME), []
    search = agents.load(f"{NAME}_dueling", search=N).act_in(scenario, WEIGHT)

    def act(state):
        actions.append(int(search(state)[0]))
        return np.asarray(actions[-1:])

    list(rollout_steps(scenario, act, [SEED]))
    bag = read_bag(ros.folder / "bag", "/move")
    assert [payload["action"] for _, payload in bag] == [ACTION_LABELS[action] for action in actions]
    assert not any("search_timed_out" in payload for _, payload in bag)
    out, n_steps = verified(ros, capsys), scenario.mission.max_steps
    assert f", search {N}, w = 0.8)" in out
    assert f"decisions: {n_steps} of {n_steps} steps recomputed, equal to the last bit" in out


@pytest.mark.long
def test_searches_out_of_time_are_recorded_and_published(
    ros: Ros, capsys: pytest.CaptureFixture[str]
) -> None:
    status, output = ros.run_all(*GIVEN, "--pace", 60, "--search-time-limit", 0.004)
    assert status == 0, output
    moves = [payload for _, payload in read_bag(ros.folder / "bag", "/move")]
    n_late = sum("search_timed_out" in move for move in moves)
    assert n_late > 0
    assert f"{n_late} searches ran out of time: their moves are the policy's own" in verified(ros, capsys)
    reports = [message.status[0] for _, message in read_bag(ros.folder / "bag", "/diagnostics")]
    own = [report for report in reports if report.name == "policy"]
    assert any("searches ran out of time" in report.message for report in own)
    counts = [int(value.value) for one in own for value in one.values if value.key == "searches out of time"]
    assert 0 < max(counts) <= n_late
