"""A scenario is read once and never changes; its fingerprint tells any two worlds apart."""

import copy
import os
import pickle
import subprocess
import sys

import msgspec
import pytest

from uav_dc_ros import scenarios
from uav_dc_ros.core.scenario import Scenario, from_values

VALUES = msgspec.to_builtins(scenarios.load("five_clusters_hover"))
# Another value for each key that no rule of thumb can find.
OTHER = {
    "cell_m": 500.0,
    "altitude_step_m": 100.0,
    "altitude_min_m": 150.0,
    "start_m": [0.0, 0.0, 150.0],
    "dock_m": [1000.0, 900.0],
    "cluster_centres_m": [*VALUES["users"]["cluster_centres_m"][:4], [800.0, 700.5]],
    "episode_end": "on_arrival",
    "interference": "none",
    "r_plus": "binary",
    "form": "immediate",
    "data": "step",
}


def neighbours(*tables):
    """The shipped world with one value changed, for each value of the tables."""
    for table in tables:
        for key in VALUES[table].keys() - {"model"}:  # another model has other keys: see test_channel
            values = copy.deepcopy(VALUES)
            values[table][key] = OTHER[key] if key in OTHER else values[table][key] + 1
            yield f"{table}.{key}", from_values(values, "test")


def test_every_value_of_the_world_is_in_the_fingerprint():
    worlds = dict(neighbours("grid", "users", "mission", "radio"))
    worlds["name"] = from_values(VALUES | {"name": "another"}, "test")
    worlds[""] = scenarios.load("five_clusters_hover")
    prints = {scenario.fingerprint: path for path, scenario in worlds.items()}
    assert sorted(prints.values()) == sorted(worlds), "two worlds share a fingerprint"
    assert all(len(print_) == 12 and int(print_, 16) >= 0 for print_ in prints)


def test_what_an_agent_is_paid_is_not_in_the_fingerprint():
    """A policy trained for another reward flies in the same world."""
    for path, scenario in neighbours("reward"):
        assert scenario != scenarios.load("five_clusters_hover"), path
        assert scenario.fingerprint == scenarios.load("five_clusters_hover").fingerprint, path


def test_the_smallest_difference_is_in_the_fingerprint():
    values = copy.deepcopy(VALUES)
    values["mission"]["r_min_bits"] += 1e-9
    assert from_values(values, "test").fingerprint != scenarios.load("five_clusters_hover").fingerprint


def test_order_and_spelling_of_values_are_not():
    values = {table: VALUES[table] for table in reversed(VALUES)}
    values["users"] = dict(reversed(VALUES["users"].items())) | {"v_max_mps": 1}
    assert from_values(values, "test").fingerprint == scenarios.load("five_clusters_hover").fingerprint


def test_the_fingerprint_is_the_same_in_every_process():
    program = (
        "from uav_dc_ros import scenarios; print(*(scenarios.load(n).fingerprint for n in scenarios.names()))"
    )
    expected = [scenarios.load(name).fingerprint for name in scenarios.names()]
    for seed in ("1", "2"):
        answer = subprocess.run(
            [sys.executable, "-c", program],
            env=os.environ | {"PYTHONHASHSEED": seed},
            capture_output=True,
            text=True,
            check=True,
        )
        assert answer.stdout.split() == expected


@pytest.mark.parametrize(
    "path",
    ["name", "grid", "grid.n_x", "users.v_max_mps", "mission.start_m", "radio.tx_power_w", "reward.beta"],
)
def test_nothing_can_be_assigned(path):
    scenario = scenarios.load("three_clusters_hover")
    *tables, key = path.split(".")
    holder = getattr(scenario, tables[0]) if tables else scenario
    with pytest.raises(AttributeError):
        setattr(holder, key, getattr(holder, key))


def test_lists_of_the_file_are_tuples():
    scenario = scenarios.load("three_clusters_hover")
    assert isinstance(scenario.mission.start_m, tuple)
    assert all(isinstance(centre, tuple) for centre in scenario.users.cluster_centres_m)
    assert isinstance(scenario.users.cluster_centres_m, tuple)


@pytest.mark.parametrize("name", scenarios.names())
def test_a_copy_from_another_process_has_the_same_text(name):
    """A default that is an object of its own is left out of the text of the original only."""
    scenario = scenarios.load(name)
    assert msgspec.json.encode(pickle.loads(pickle.dumps(scenario))) == msgspec.json.encode(scenario)


def test_no_default_that_is_left_out_is_an_object_of_its_own():
    """msgspec leaves out the very object that is the default, and writes one that is equal."""
    waiting, seen = [Scenario], set()
    while waiting:
        table = waiting.pop()
        seen.add(table)
        for key in msgspec.inspect.type_info(table).fields:
            if table.__struct_config__.omit_defaults and key.default is not msgspec.NODEFAULT:
                assert key.default is None or key.default in ((), ""), f"{table.__name__}.{key.name}"
            kinds = key.type.types if isinstance(key.type, msgspec.inspect.UnionType) else (key.type,)
            tables = (kind.cls for kind in kinds if isinstance(kind, msgspec.inspect.StructType))
            waiting += [one for one in tables if one not in seen]
    assert len(seen) > 8
