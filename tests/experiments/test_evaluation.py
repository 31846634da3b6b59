"""Evaluation: the same missions as the environment flies, and figures that add up."""

import json
import subprocess
import sys

import numpy as np
import pytest

from tests.small_worlds import changed, saved, tiny
from uav_dc_ros import scenarios
from uav_dc_ros.agents import policy
from uav_dc_ros.env.gym_env import DataCollectionEnv
from uav_dc_ros.experiments.evaluate import evaluate, rows, steer
from uav_dc_ros.experiments.evaluate_cli import main
from uav_dc_ros.experiments.fly import flight, fly


def command(*arguments):
    done = subprocess.run(
        [sys.executable, "-m", "uav_dc_ros.evaluate", *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
    )
    return done.returncode, done.stdout, done.stderr


def by_hand(env, act, seed):
    """One mission in the Gymnasium environment: all that `info` told, and the rewards."""
    seen, told = env.reset(seed=seed)
    course, rewards = [told], []
    while True:
        seen, reward, terminated, truncated, told = env.step(act(seen))
        course.append(told)
        rewards.append(reward)
        if terminated or truncated:
            return course, rewards


@pytest.mark.parametrize("end", ["at_time_limit", "on_arrival"])
def test_seed_s_is_the_mission_of_the_environment_with_seed_s(tmp_path, end):
    """To the last bit, however many missions fly side by side."""
    scenario = changed("five_clusters", mission={"episode_end": end, "max_steps": 30})
    made = policy.load(saved(tmp_path / "made", scenario))
    seeds = [3, 0, 11, 12, 13, 14, 15]
    missions = fly(scenario, steer(made, scenario), seeds)
    states = [state for state, _ in flight(scenario, steer(made, scenario), seeds)]
    for i, seed in enumerate(seeds):
        course, rewards = by_hand(DataCollectionEnv(scenario), made.act, seed)
        for state, told in zip(states, course, strict=False):
            for key in ("cell", "users_m", "data_bits", "collected"):
                np.testing.assert_array_equal(getattr(state, key)[i], told[key])
        assert missions.steps[i] == course[-1]["step"]
        assert missions.users_collected[i] == course[-1]["collected"].sum()
        assert missions.landed[i] == course[-1]["landed"]
        assert missions.data_bits[i] == course[-1]["data_bits"].sum()
        assert missions.episode_return[i] == pytest.approx(sum(rewards), rel=1e-12)
        rates = [told["sum_rate_bps"] for told in course[1:]]
        assert missions.sum_rate_bps[i] == pytest.approx(np.mean(rates), rel=1e-12)


def test_a_planned_flight_lands_when_it_should():
    """To the dock, away and back: the arrival that counts is the last one."""
    scenario = tiny(mission={"max_steps": 8})
    plan = [1, 1, 2, 2, 0, 1, 6, 6]  # over the dock after steps 4 and 6
    missions = fly(scenario, lambda state: np.full(state.step.shape, plan[state.step[0]]), [0, 1])
    assert missions.landed.tolist() == [True, True]
    assert missions.arrival_step.tolist() == [6, 6]
    away = fly(scenario, lambda state: np.full(state.step.shape, 6), [0])
    assert not away.landed[0]
    assert np.isnan(away.arrival_step[0])


def test_on_arrival_a_mission_ends_there():
    scenario = tiny(mission={"episode_end": "on_arrival"})
    plan = [[1, 1, 2, 2, 6, 6, 6, 6], [6] * 8]
    missions = fly(scenario, lambda state: np.array([one[state.step[0]] for one in plan]), [5, 5])
    assert missions.steps.tolist() == [4, 8]
    assert missions.landed.tolist() == [True, False]


def test_the_command_prints_and_writes_figures(tmp_path):
    made = saved(tmp_path / "made", scenarios.load("three_clusters"))
    picture = tmp_path / "mission.png"
    status, out, err = command(
        "--policy", made, "--seeds", 4, "--json", tmp_path / "x.json", "--picture", picture
    )
    assert (status, err) == (0, "")
    (written,) = json.loads((tmp_path / "x.json").read_text())
    expected = evaluate(policy.load(made), scenarios.load("three_clusters"), range(4))
    assert written["users_collected"]["mean"] == expected.users_collected.mean
    assert written["sha256"] == policy.load(made).sha256
    assert written["scenario"] == "three_clusters"
    assert all(title in out for title, *_ in rows(expected))
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ([], "--policy"),
        (["--policy", "nobody"], "'nobody'"),
        (["--policy", "MADE", "--scenario", "nowhere"], "'nowhere'"),
        (["--policy", "MADE", "--scenario", "five_clusters"], "expected 3"),
        (["--policy", "MADE", "--seeds", "0"], "'0'; expected a whole number of at least 1"),
        (["--policy", "MADE", "--seeds", "2", "--json", "/nowhere/x"], "/nowhere/x cannot be written"),
        (
            ["--policy", "MADE", "--seeds", "2", "--picture", "/nowhere/x.png"],
            "/nowhere/x.png cannot be written",
        ),
        (["--policy", "MADE", "--seeds", "2", "--picture", "x.mission"], "x.mission cannot be written"),
        (["--policy", "MADE", "MADE", "--picture", "x.png"], "expected one policy"),
        (["--policy", "MADE", "--seed", "3"], "--seed 3"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_mistake_is_one_line_and_status_2(tmp_path, capsys, arguments, complaint):
    made = str(saved(tmp_path / "made", scenarios.load("three_clusters")))
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
    made = saved(tmp_path / "made", scenarios.load("three_clusters"))
    code = (
        "import sys\n"
        "from uav_dc_ros.experiments.evaluate_cli import main\n"
        "try:\n"
        f"    main(['--policy', {str(made)!r}, '--seeds', '1'])\n"
        "except SystemExit as exit:\n"
        "    print(exit.code, {'torch', 'gymnasium', 'matplotlib'} & set(sys.modules))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "0 set()"
