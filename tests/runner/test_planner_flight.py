"""Missions in any field: nodes and bag agree with the rollout to the last bit."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import WITHOUT_VISUALIZER, Ros, read_bag
from tests.nodes.test_bridge import NODES, beside
from tests.recordings.report_bags import unpacked
from tests.support.fake_autopilot.flight import fake
from uav_dc_ros import bag as command
from uav_dc_ros import scenarios
from uav_dc_ros.agents import policy
from uav_dc_ros.core.grid import ACTION_LABELS
from uav_dc_ros.core.world import rollout_steps
from uav_dc_ros.experiments.evaluate.cli import candidates
from uav_dc_ros.planners import PLANNERS

SEED, WEIGHT = 5, 0.8


@pytest.mark.parametrize(
    "name", ["generalist", *(pytest.param(name, marks=pytest.mark.long) for name in ("search", "plan"))]
)
def test_what_flies_any_field_flies_in_nodes_as_in_a_rollout(
    ros: Ros, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    status, output = ros.run_all(
        *("--scenario", "random:2", "--policy", name, "--objective", WEIGHT, "--pace", "lockstep"),
        *("--seed", SEED, *WITHOUT_VISUALIZER, "--bag", "bag"),
        *("--summary", "summary.json"),
    )
    assert status == 0, output
    assert "another world" not in output
    scenario, actions = scenarios.load("random:2"), []
    decide = candidates([name])[0].act_in(scenario, WEIGHT)

    def act(state):
        actions.append(int(decide(state)[0]))
        return np.asarray(actions[-1:])

    *_, (last, _) = rollout_steps(scenario, act, [SEED])
    bag = read_bag(ros.folder / "bag", "/move", "/rates")
    moves = {payload["step"]: payload["action"] for name, payload in bag if name == "/move"}
    assert moves == {step: ACTION_LABELS[action] for step, action in enumerate(actions)}
    rates = [payload for name, payload in bag if name == "/rates"][-1]
    np.testing.assert_array_equal(rates["data_bits"], last.data_bits[0])
    summary = json.loads((ros.folder / "summary.json").read_text())
    assert (summary["policy"], summary["outcome"]) == (name, "landed")

    def run(*arguments: object) -> str:
        with pytest.raises(SystemExit) as end:
            command.main([str(one) for one in arguments])
        out = capsys.readouterr().out
        assert end.value.code == 0, out
        return out

    out = run("verify", ros.folder / "bag", "--complete")
    kind, what = (
        ("planner", "") if name in PLANNERS else ("policy", f"sha256 {policy.load(name).sha256[:12]}, ")
    )
    assert f"in scenario 'random_2', {kind} {name!r} ({what}w = 0.8)" in out
    n_steps = scenario.mission.max_steps
    assert f"decisions: {n_steps} of {n_steps} steps recomputed, equal to the last bit" in out
    out = run("verify", ros.folder / "bag", "--policy", "tour")
    assert "'tour' decides differently in " in out
    out = run("info", ros.folder / "bag")
    assert name in out
    run("report", ros.folder / "bag", "--out", tmp_path / "report.html")
    shown = unpacked(tmp_path / "report.html")["data"]
    assert (shown["policy"], shown["about"]["objective_weight"]) == (name, "0.8")


@pytest.mark.long
def test_search_lands_beside_an_autopilot(ros: Ros, capsys: pytest.CaptureFixture[str]) -> None:
    """It gets the users' positions from the world beside the bridge."""
    scenario = scenarios.load("three_clusters_hover")
    with fake("ardupilot", "tcp", speed=200.0) as autopilot:
        given = ("--scenario", scenario.name, "--policy", "search", "--seed", 3, "--compose", "--arm")
        status, output = ros.run_all(
            *beside(autopilot, *given, "--bag", "bag", "--summary", "summary.json", *NODES)
        )
    assert status == 0, output
    summary = json.loads((ros.folder / "summary.json").read_text())
    assert (summary["outcome"], summary["steps"]) == ("landed", scenario.mission.max_steps)
    assert summary["users_collected"] >= 29
    with pytest.raises(SystemExit) as end:
        command.main(["verify", str(ros.folder / "bag")])
    out = capsys.readouterr().out
    assert end.value.code == 0, out
    assert "planner 'search' (w = 0.909091)" in out
