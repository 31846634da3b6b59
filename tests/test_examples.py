"""Each example runs, and does what it says."""

import csv
import itertools
import re
import shlex
import sys
import tomllib
from pathlib import Path

import pytest

from tests.conftest import ROOT, Ros, finish
from uav_dc_ros import scenarios, uav_dc
from uav_dc_ros.agents import policy as policies
from uav_dc_ros.core.scenario import from_values, read_values
from uav_dc_ros.experiments.evaluate.evaluation import evaluate_act
from uav_dc_ros.planners import PLANNERS

EXAMPLES = ROOT / "examples"


def test_these_are_all() -> None:
    assert {path.name for path in EXAMPLES.iterdir() if path.is_file()} == {
        *("one_episode.py", "own_scenario.toml", "own_policy_node.py"),
        *("own_users.csv", "train_and_deploy.py", "bag_to_table.py", "gain_map_sionna.py"),
    }


def run(ros: Ros, name: str, *arguments: object) -> str:
    """Run an example to its end; what it printed."""
    status, output = finish(ros.start_command(sys.executable, EXAMPLES / name, *arguments))
    assert status == 0, output
    return output


def test_one_episode(ros: Ros) -> None:
    assert run(ros, "one_episode.py").startswith("landed after 46 steps\n49 of 50 users collected, return ")


def test_own_scenario_can_be_flown() -> None:
    scenario = scenarios.load(EXAMPLES / "own_scenario.toml")
    flown = evaluate_act("tour", None, PLANNERS["tour"](scenario), scenario, range(5)).evaluation
    assert flown.landing_rate.mean == 1.0
    assert flown.users_collected.mean is not None
    assert flown.users_collected.mean > 5


def choices() -> list[str]:
    """The choices in comments: blocks of lines without a space after the `#`."""
    lines = (EXAMPLES / "own_scenario.toml").read_text("utf-8").splitlines()
    blocks = itertools.groupby(lines, lambda line: re.match(r"#[^ ]", line) is not None)
    return ["\n".join(line[1:] for line in block) for is_choice, block in blocks if is_choice]


def test_each_choice_in_own_scenario_works_with_those_above_it() -> None:
    path = EXAMPLES / "own_scenario.toml"
    values = read_values(path.read_text("utf-8"), str(path))
    made = []
    for text in choices():
        for table, value in tomllib.loads(text).items():
            if table == "obstacles" and table in values:
                value = [*values[table], *value]
            elif isinstance(value, dict) and value.keys() == {"mobility"}:
                value = values[table] | value
            values[table] = value
        made.append(from_values(scenarios.with_files(dict(values), EXAMPLES, str(path)), str(path)))
    last = made[-1]
    assert len({scenario.fingerprint for scenario in made}) == len(made), "each makes another world"
    assert [type(scenario.radio).__name__ for scenario in made[-4:]] == ["FreeSpace", *["AirToGround"] * 3]
    assert (last.n_users, last.users.moves.n_draws > 0, len(last.obstacles)) == (4, True, 2)
    assert last.energy is not None
    flown = evaluate_act("tour", None, PLANNERS["tour"](last), last, range(3)).evaluation
    assert flown.landing_rate.mean == 1.0


def test_the_commands_in_own_scenario_are_commands(monkeypatch: pytest.MonkeyPatch) -> None:
    """They are not run, but as far as their help goes."""
    text = (EXAMPLES / "own_scenario.toml").read_text("utf-8")
    lines = [line.removeprefix("#").partition("  #")[0].split() for line in text.splitlines()]
    commands = [words for words in lines if words[:1] == ["uav-dc"]]
    assert [words[1] for words in commands] == ["scenario", "evaluate", "train", "fly"]
    for words in commands:
        with pytest.raises(SystemExit) as ended:
            uav_dc.main([*words[1:], "--help"])
        assert ended.value.code == 0, shlex.join(words)


def test_gain_map_without_the_ray_tracer_is_one_line(ros: Ros) -> None:
    """With it the example was run by hand: see docs/channels.md."""
    command = (sys.executable, EXAMPLES / "gain_map_sionna.py", "three_clusters_hover", "gains.npz")
    status, output = finish(ros.start_command(*command))
    assert (status, output) == (2, "sionna-rt is missing (No module named 'sionna'): pip install sionna-rt\n")


def test_own_policy_node(ros: Ros) -> None:
    """It takes the place of the policy node, and the mission lands with what it collected."""
    node = ros.start_command(sys.executable, EXAMPLES / "own_policy_node.py")
    given = ("--nodes", "world,channel_monitor,recorder", "--pace", "lockstep", "--bag", "bag")
    status, output = ros.run_all(*given)
    assert status == 0, output
    assert "landed      46  50/50" in output
    status, output = finish(node)
    assert (status, output) == (0, "mission over: landed after 46 steps\n")


def test_train_and_deploy_and_the_bag_as_a_table(ros: Ros) -> None:
    output = run(ros, "train_and_deploy.py", 2, "own")
    assert "in numpy: " in output
    assert "in ROS 2: " in output
    learnt = policies.load(ros.folder / "own" / "policy")
    assert learnt.scenario.name == "own_scenario"
    output = run(ros, "bag_to_table.py", "own/bag")
    assert output == "25 steps: own/bag.csv, bag.png beside it\n"
    with Path(ros.folder, "own", "bag.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["step"]) for row in rows] == list(range(25))
    assert (ros.folder / "own" / "bag.png").is_file()
