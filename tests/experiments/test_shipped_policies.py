"""The shipped policies perform as their cards state."""

import re
import shlex

import pytest
from msgspec import UNSET

from uav_dc_ros import scenarios
from uav_dc_ros.agents import policy
from uav_dc_ros.agents.set_policy import SetPolicyConfig
from uav_dc_ros.experiments.evaluate.evaluation import COLUMNS, card_seeds, evaluate, rows
from uav_dc_ros.experiments.train.cli import PROG, options_parser
from uav_dc_ros.experiments.train.generalist import card as generalist_card
from uav_dc_ros.experiments.train.generalist import cli as generalist_cli
from uav_dc_ros.experiments.train.training import VALIDATION_SEEDS

NAMES = policy.names()
FOR_ANY_FIELD = [name for name in NAMES if isinstance(policy.load(name).config, SetPolicyConfig)]
OF_A_FIELD = [name for name in NAMES if name not in FOR_ANY_FIELD]


def card(name):
    return (policy.load(name).folder / policy.CARD).read_text("utf-8")


def test_there_is_one_for_each_scenario_and_one_with_the_papers_state():
    loaded = [policy.load(name) for name in NAMES]
    assert {one.scenario.name for one in loaded} >= set(scenarios.names())
    assert "position" in {one.config.observation for one in loaded}
    assert all(one.name == name for one, name in zip(loaded, NAMES, strict=True))


@pytest.mark.parametrize("name", NAMES)
def test_it_has_one_name_however_it_is_loaded(name, monkeypatch):
    """Also the renamed ones, whose config has the name of before, and that of their world."""
    folder = policy.load(name).folder
    monkeypatch.chdir(folder.parent)
    for where in (name, folder, f"./{name}", f"../{folder.parent.name}/{name}"):
        loaded = policy.load(where)
        assert loaded.name == name
        assert loaded.scenario.fingerprint == scenarios.load(loaded.scenario.name).fingerprint


@pytest.mark.parametrize("name", OF_A_FIELD)
def test_the_figures_on_the_card_come_out_again(name):
    loaded = policy.load(name)
    scenario = scenarios.load(loaded.scenario.name)
    result = evaluate(loaded, scenario, card_seeds(scenario))
    assert result.seeds == (0, 1 if scenario.name == "farm" else 100), "in the farm nothing is drawn"
    lines = [tuple(cell.strip() for cell in line.split("|")[1:-1]) for line in card(name).splitlines()]
    assert COLUMNS in lines
    assert set(rows(result)) <= set(lines)


@pytest.mark.parametrize("name", FOR_ANY_FIELD)
def test_the_figures_of_one_for_any_field_come_out_again(name):
    loaded = policy.load(name)
    for scenario in ("three_clusters", "farm"):
        assert generalist_card.row(loaded, scenarios.load(scenario)) in card(name).splitlines()


@pytest.mark.parametrize("name", FOR_ANY_FIELD)
def test_the_command_of_one_for_any_field_says_how_it_was_made(name):
    command = shlex.split(re.search(r"```\n(.+)\n```", card(name))[1].removeprefix(PROG))
    config = policy.load(name).config
    algorithm = command[command.index("--algo") + 1]
    assert isinstance(config.hyperparameters, generalist_cli.SETTINGS[algorithm])
    options = generalist_cli.options_parser(PROG, algorithm).parse_args(command)
    assert (options.out.name, options.width, tuple(options.hidden)) == (name, config.width, config.hidden)
    assert options.seed == config.seed
    for key in config.hyperparameters.__struct_fields__:
        assert getattr(options, key) == getattr(config.hyperparameters, key)


@pytest.mark.parametrize("name", OF_A_FIELD)
def test_the_command_on_the_card_says_how_it_was_made(name):
    command = re.search(r"```\n(.+)\n```", card(name))[1]
    assert command.startswith(PROG)
    options = options_parser().parse_args(shlex.split(command.removeprefix(PROG)))
    config = policy.load(name).config
    assert options.out.name == name
    assert (options.algo, options.observation) == (config.algorithm, config.observation)
    assert tuple(options.hidden) == config.hidden
    assert config.seed in range(options.seed, options.seed + options.runs)
    for key in config.hyperparameters.__struct_fields__:
        value = getattr(config.hyperparameters, key)
        assert getattr(options, key) == (1 if value is UNSET else value)  # n_step, in the policies of before


@pytest.mark.parametrize("name", [name for name in NAMES if "_hover_" in name])
def test_a_policy_of_version_0_1_0_learnt_from_the_data_so_far(name):
    """Its config has no reading of the data."""
    made = policy.load(name)
    assert "data" not in made.config.scenario["reward"]
    assert made.scenario.reward.data == "so_far"
    assert "form, data so far" in card(name)


@pytest.mark.parametrize("name", NAMES)
def test_it_learnt_in_the_scenario_as_it_is_now_but_for_the_reward(name):
    learnt, now = policy.load(name).scenario, scenarios.load(policy.load(name).scenario.name)
    for section in ("grid", "users", "mission", "radio"):
        assert getattr(learnt, section) == getattr(now, section)


@pytest.mark.parametrize("world", ["five_clusters", "five_clusters_hover"])
def test_the_default_is_worth_flying(world):
    """Also on missions that no card shows, and that chose nothing."""
    made, scenario = policy.load(f"{world}_dueling"), scenarios.load(world)
    fresh = range(5000, 5100)
    assert not set(fresh) & set(VALIDATION_SEEDS)
    for seeds in (range(100), fresh):
        result = evaluate(made, scenario, seeds)
        assert result.landing_rate.mean >= 0.95
        assert result.users_collected.mean >= 40.0
