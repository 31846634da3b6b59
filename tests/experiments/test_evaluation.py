"""Evaluation: the same missions as the environment flies, and figures that add up."""

import json
import subprocess
import sys
from importlib.resources import files
from typing import get_type_hints

import msgspec
import numpy as np
import pytest

from tests.support.worlds import changed, saved, tiny
from uav_dc_ros import scenarios
from uav_dc_ros.agents import policy
from uav_dc_ros.agents.agent import greedy_act
from uav_dc_ros.core.stats import interval
from uav_dc_ros.core.world import rollout_steps
from uav_dc_ros.env.gym_env import DataCollectionEnv
from uav_dc_ros.experiments.evaluate import cli
from uav_dc_ros.experiments.evaluate.cli import main
from uav_dc_ros.experiments.evaluate.evaluation import (
    Evaluation,
    EvaluationReport,
    Figure,
    compare,
    evaluate,
    evaluate_act,
    rows,
)
from uav_dc_ros.experiments.evaluate.rollout import roll_out


def command(*arguments):
    done = subprocess.run(
        [sys.executable, "-m", "uav_dc_ros.evaluate", *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
    )
    return done.returncode, done.stdout, done.stderr


def by_hand(env, act, seed):
    """One mission in the Gymnasium environment: every `info`, and the rewards."""
    observation, info = env.reset(seed=seed)
    infos, rewards = [info], []
    while True:
        observation, reward, terminated, truncated, info = env.step(act(observation))
        infos.append(info)
        rewards.append(reward)
        if terminated or truncated:
            return infos, rewards


@pytest.mark.parametrize(
    ("end", "data"), [("at_time_limit", "so_far"), ("on_arrival", "so_far"), ("on_arrival", "step")]
)
def test_seed_s_is_the_mission_of_the_environment_with_seed_s(tmp_path, end, data):
    """To the last bit, however many missions fly side by side."""
    scenario = changed(
        "five_clusters_hover", mission={"episode_end": end, "max_steps": 30}, reward={"data": data}
    )
    made = policy.load(saved(tmp_path / "made", scenario))
    seeds = [3, 0, 11, 12, 13, 14, 15]
    missions = roll_out(scenario, greedy_act(made, scenario), seeds)
    states = [state for state, _ in rollout_steps(scenario, greedy_act(made, scenario), seeds)]
    for i, seed in enumerate(seeds):
        infos, rewards = by_hand(DataCollectionEnv(scenario), made.act, seed)
        for state, info in zip(states, infos, strict=False):
            for key in ("cell", "users_m", "data_bits", "collected"):
                np.testing.assert_array_equal(getattr(state, key)[i], info[key])
        assert missions.steps[i] == infos[-1]["step"]
        assert missions.users_collected[i] == infos[-1]["collected"].sum()
        assert missions.landed[i] == infos[-1]["landed"]
        assert missions.data_bits[i] == infos[-1]["data_bits"].sum()
        assert missions.episode_return[i] == pytest.approx(sum(rewards), rel=1e-12)
        # The episode form pays r^t itself.
        expected = rewards[-1] if data == "so_far" else np.mean(rewards)
        assert missions.reward[i] == pytest.approx(expected, rel=1e-12)
        rates = [info["sum_rate_bps"] for info in infos[1:]]
        assert missions.sum_rate_bps[i] == pytest.approx(np.mean(rates), rel=1e-12)


def test_a_planned_flight_lands_when_it_should():
    """To the dock, away and back: the arrival that counts is the last one."""
    scenario = tiny(mission={"max_steps": 8})
    plan = [1, 1, 2, 2, 0, 1, 6, 6]  # over the dock after steps 4 and 6
    missions = roll_out(scenario, lambda state: np.full(state.step.shape, plan[state.step[0]]), [0, 1])
    assert missions.landed.tolist() == [True, True]
    assert missions.arrival_step.tolist() == [6, 6]
    away = roll_out(scenario, lambda state: np.full(state.step.shape, 6), [0])
    assert not away.landed[0]
    assert np.isnan(away.arrival_step[0])


def test_on_arrival_a_mission_ends_there():
    scenario = tiny(mission={"episode_end": "on_arrival"})
    plan = [[1, 1, 2, 2, 6, 6, 6, 6], [6] * 8]
    missions = roll_out(scenario, lambda state: np.array([one[state.step[0]] for one in plan]), [5, 5])
    assert missions.steps.tolist() == [4, 8]
    assert missions.landed.tolist() == [True, False]


def plan(*actions):
    """The same actions in every mission."""
    return lambda state: np.full(state.step.shape, actions[state.step[0]])


def test_a_figure_is_over_the_missions_that_have_it():
    scenario = tiny()
    flown = evaluate_act("plan", None, plan(1, 1, 2, 2, 6, 6, 6, 6), scenario, range(20))
    figures, missions = flown.evaluation, roll_out(scenario, plan(1, 1, 2, 2, 6, 6, 6, 6), range(20))
    assert figures.landing_rate == Figure(n=20, mean=1.0, low=1.0, high=1.0, min=1.0, max=1.0)
    assert figures.arrival_step.mean == 4.0
    mean, low, high = interval(missions.data_bits)
    data = figures.data_bits
    assert (data.n, data.mean, data.low, data.high) == (20, mean, low, high)
    assert (data.min, data.max) == (missions.data_bits.min(), missions.data_bits.max())
    assert data.min < data.low < data.mean < data.high < data.max

    lost = evaluate_act("hover", None, plan(*[6] * 8), scenario, range(20)).evaluation
    assert lost.landing_rate.mean == 0.0
    assert lost.arrival_step == Figure(n=0)
    once = evaluate_act("plan", None, plan(1, 1, 2, 2, 6, 6, 6, 6), scenario, [7]).evaluation
    assert (once.data_bits.low, once.data_bits.high) == (None, None), "one mission has no interval"
    assert ("arrival step", "4.0", "-", "4.0", "4.0") in rows(once)


@pytest.mark.parametrize(
    ("data", "title"), [("so_far", "reward r^t at the end"), ("step", "reward r^t, mean over the steps")]
)
def test_the_table_names_the_reward(data, title):
    evaluation = evaluate_act("hover", None, plan(*[6] * 8), tiny(reward={"data": data}), range(2)).evaluation
    assert evaluation.reward_data == data
    assert [row[0] for row in rows(evaluation) if row[0].startswith("reward")] == [title]


def test_the_objective_is_that_of_its_weight_and_0_without_a_landing():
    scenario, way = tiny(), plan(1, 1, 2, 2, 6, 6, 6, 6)
    for weight in (0.0, 0.5, 1.0):
        flown = evaluate_act("plan", None, way, scenario, range(20), weight=weight)
        users = flown.evaluation.users_collected.mean / scenario.n_users
        found = flown.evaluation.objective
        assert flown.evaluation.objective_weight == weight
        assert found.mean == pytest.approx(weight * users + (1.0 - weight) * (1.0 - 4 / 8))
    assert rows(flown.evaluation)[0][0] == "objective J, w = 1"
    lost = evaluate_act("hover", None, plan(*[6] * 8), scenario, range(20))
    assert lost.evaluation.objective == Figure(n=20, mean=0.0, low=0.0, high=0.0, min=0.0, max=0.0)


def test_policies_are_compared_mission_by_mission():
    scenario = tiny()
    late = evaluate_act("late", None, plan(6, 6, 1, 1, 2, 2, 6, 6), scenario, range(20))
    soon = evaluate_act("soon", None, plan(1, 1, 2, 2, 6, 6, 6, 6), scenario, range(20))
    comparison = compare(late, soon)
    assert (comparison.policy, comparison.baseline) == ("late", "soon")
    differences = comparison.differences
    assert differences["arrival_step"] == Figure(n=20, mean=2.0, low=2.0, high=2.0, min=2.0, max=2.0)
    by_hand = late.values["data_bits"] - soon.values["data_bits"]
    assert tuple(interval(by_hand)) == tuple(
        getattr(differences["data_bits"], key) for key in ("mean", "low", "high")
    )
    figures = {name for name, kind in get_type_hints(Evaluation).items() if kind is Figure}
    assert set(differences) == figures, "no figure is left out"

    lost = evaluate_act("hover", None, plan(*[6] * 8), scenario, range(20))
    assert compare(lost, soon).differences["arrival_step"].n == 0, "only one of the two landed"
    assert compare(lost, soon).differences["landing_rate"].mean == -1.0


def test_every_policy_flies_in_every_scenario_and_is_compared_with_the_first(tmp_path, capsys):
    made = saved(tmp_path / "made", scenarios.load("five_clusters_hover"), observation="position")
    arguments = [
        "--policy",
        "tour",
        made,
        "--scenario",
        "five_clusters_hover",
        "three_clusters_hover",
        "--seeds",
        3,
    ]
    with pytest.raises(SystemExit) as exit:
        main([*map(str, arguments), "--json", str(tmp_path / "x.json")])
    assert exit.value.code == 0
    report = msgspec.json.decode((tmp_path / "x.json").read_bytes(), type=EvaluationReport)
    flown = [(one.policy, one.scenario) for one in report.evaluations]
    fields = ("five_clusters_hover", "three_clusters_hover")
    assert flown == [(who, where) for where in fields for who in ("tour", "test")]
    compared = [(one.policy, one.baseline, one.scenario) for one in report.comparisons]
    assert compared == [("test", "tour", where) for where in fields]
    out = capsys.readouterr().out
    assert "Means and their 95% bootstrap intervals, 3 missions, seeds 0 to 2" in out
    assert out.count("less tour") == 2
    for evaluation in report.evaluations:
        mean = evaluation.users_collected.mean
        assert f"{mean:.1f}" in out


@pytest.mark.parametrize(("n", "note"), [(2, True), (1, False)])
def test_equal_missions_are_named(n, note, capsys):
    """In the farm nothing is drawn: its users and its channel are the same with each seed."""
    with pytest.raises(SystemExit) as exit:
        main(["--policy", "fixed_tour", "--scenario", "farm", "--seeds", str(n)])
    assert exit.value.code == 0
    out, err = capsys.readouterr()
    expected = (
        "farm: nothing is drawn in this world, so every seed gives the same mission; --seeds 1 is enough\n"
    )
    assert err.endswith(expected) if note else not err
    assert f"farm, 16 users, {'2 missions, seeds 0 to 1' if note else '1 mission, seed 0'}\n" in out


def test_policies_of_one_name_are_distinguished_by_their_folders(tmp_path, capsys):
    three = scenarios.load("three_clusters_hover")
    folders = [str(saved(tmp_path / name, three, name="same")) for name in ("a", "b")]
    with pytest.raises(SystemExit):
        main(["--policy", *folders, "--seeds", "2"])
    out = capsys.readouterr().out
    assert all(f"{folder} in three_clusters_hover, 30 users" in out for folder in folders)


def test_scenarios_of_one_name_are_refused(tmp_path, capsys):
    copy = tmp_path / "copy.toml"
    copy.write_bytes((files(scenarios) / "three_clusters_hover.toml").read_bytes())
    with pytest.raises(SystemExit) as exit:
        main(["--policy", "tour", "--scenario", "three_clusters_hover", str(copy)])
    assert exit.value.code == 2
    assert (
        "their names are three_clusters_hover, three_clusters_hover; expected different"
        in capsys.readouterr().err
    )


def test_nothing_is_flown_before_all_is_known_to_fit(tmp_path, capsys, monkeypatch):
    made = str(saved(tmp_path / "made", scenarios.load("three_clusters_hover")))
    monkeypatch.setattr(cli, "evaluate_act", None)
    monkeypatch.setattr(cli, "save_mission_picture", None)
    scenario = ["--scenario", "three_clusters_hover", "five_clusters_hover"]
    for arguments, complaint in (
        (["tour", made, *scenario], "'test' does not fit scenario 'five_clusters_hover'"),
        ([made, "--json", str(tmp_path)], f"{tmp_path} cannot be written: Is a directory"),
        ([made, "--json", "/nowhere/x", "--picture", "x.png"], "/nowhere/x cannot be written"),
        ([made, "--picture", "/nowhere/x.png"], "/nowhere/x.png cannot be written"),
    ):
        with pytest.raises(SystemExit) as exit:
            main(["--policy", *arguments])
        assert exit.value.code == 2
        assert complaint in capsys.readouterr().err


def test_the_command_prints_and_writes_figures(tmp_path):
    made = saved(tmp_path / "made", scenarios.load("three_clusters_hover"))
    picture, link = tmp_path / "mission.png", tmp_path / "link.png"
    link.symlink_to(picture)
    status, out, err = command(
        "--policy", made, "--seeds", 4, "--json", tmp_path / "x.json", "--picture", link
    )
    assert (status, err) == (0, "")
    assert link.is_symlink()
    report = json.loads((tmp_path / "x.json").read_text())
    (written,) = report["evaluations"]
    assert report["comparisons"] == []
    expected = evaluate(policy.load(made), scenarios.load("three_clusters_hover"), range(4))
    assert written["users_collected"] == msgspec.to_builtins(expected.users_collected)
    assert written["sha256"] == policy.load(made).sha256
    assert written["scenario"] == "three_clusters_hover"
    assert all(title in out for title, *_ in rows(expected))
    assert "Means and their" not in out, "nothing to compare"
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ([], "--policy"),
        (["--policy", "missing"], "'missing'"),
        (["--policy", "MADE", "--scenario", "nowhere"], "'nowhere'"),
        (["--policy", "MADE", "--scenario", "five_clusters_hover"], "expected 3"),
        (["--policy", "MADE", "--seeds", "0"], "'0'; expected a whole number of at least 1"),
        (["--policy", "MADE", "--seeds", "2", "--json", "/nowhere/x"], "/nowhere/x cannot be written"),
        (
            ["--policy", "MADE", "--seeds", "2", "--picture", "/nowhere/x.png"],
            "/nowhere/x.png cannot be written",
        ),
        (["--policy", "MADE", "--seeds", "2", "--picture", "x.mission"], "x.mission cannot be written"),
        (
            ["--policy", "MADE", "tour", "--scenario", "three_clusters_hover", "--picture", "x.png"],
            "expected one policy",
        ),
        (["--policy", "MADE", "MADE"], "given 2 times; expected once"),
        (
            ["--policy", "tour", "--scenario", "three_clusters_hover", "three_clusters_hover"],
            "given 2 times; expected once",
        ),
        (["--policy", "MADE", "--seed", "3"], "--seed 3"),
        (["--policy", "MADE", "--objective", "1.01"], "'1.01'; expected a weight between 0 (time only) and"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_mistake_is_one_line_and_status_2(tmp_path, capsys, arguments, complaint):
    made = str(saved(tmp_path / "made", scenarios.load("three_clusters_hover")))
    with pytest.raises(SystemExit) as exit:
        main([made if argument == "MADE" else argument for argument in arguments])
    assert exit.value.code == 2
    err = capsys.readouterr().err
    assert complaint in err
    assert len(err.splitlines()) == 1


def test_a_damaged_policy_is_one_line_and_status_2(tmp_path):
    made = saved(tmp_path / "made", tiny())
    (made / policy.MODEL).write_bytes((made / policy.MODEL).read_bytes()[:99])
    status, out, err = command("--policy", made)
    assert (status, out) == (2, "")
    assert f"{policy.MODEL}: damaged" in err
    assert len(err.splitlines()) == 1


def test_it_needs_no_torch(tmp_path):
    made = saved(tmp_path / "made", scenarios.load("three_clusters_hover"))
    code = (
        "import sys\n"
        "from uav_dc_ros.experiments.evaluate.cli import main\n"
        "try:\n"
        f"    main(['--policy', {str(made)!r}, '--seeds', '1'])\n"
        "except SystemExit as exit:\n"
        "    print(exit.code, {'torch', 'gymnasium', 'matplotlib'} & set(sys.modules))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "0 set()"
