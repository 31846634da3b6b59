"""Worlds small enough to learn in seconds, and policies made by hand."""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from uav_dc_ros import scenarios
from uav_dc_ros.agents import network, policy
from uav_dc_ros.agents.policy import Hyperparameters, PolicyConfig
from uav_dc_ros.core.scenario import RewardSettings, Scenario, from_values
from uav_dc_ros.experiments.train.population import Population, Run


def changed(shipped: str, **tables: Any) -> Scenario:
    """A shipped scenario with other values: `changed("five_clusters_hover", mission={"max_steps": 5})`."""
    values = msgspec.to_builtins(scenarios.load(shipped))
    for table, entries in tables.items():
        values[table] = values.get(table, {}) | entries if isinstance(entries, dict) else entries
    return from_values(values, "test")


def tiny(**tables: Any) -> Scenario:
    """A field of 3 x 3 cells in one layer, four users in one cluster, eight steps."""
    sections: dict[str, Any] = {
        "grid": {"n_x": 3, "n_y": 3, "n_z": 1},
        "users": {"cluster_centres_m": [[100.0, 0.0]], "users_per_cluster": 4},
        "mission": {"start_m": [0.0, 0.0, 100.0], "dock_m": [200.0, 200.0], "max_steps": 8},
    }
    for table, entries in tables.items():
        sections[table] = sections.get(table, {}) | entries
    return changed("three_clusters_hover", name="tiny", **sections)


def config(scenario: Scenario, **values: Any) -> PolicyConfig:
    """A policy's config for a scenario; small unless told."""
    defaults: dict[str, Any] = {
        "name": "test",
        "algorithm": "dueling_dqn",
        "observation": "mission",
        "hidden": (8, 8),
        "hyperparameters": Hyperparameters(episodes=2, batch_size=4, buffer_size=100, target_every=10),
        "seed": 0,
        "episode": 0,
        "version": "test",
        "scenario": msgspec.to_builtins(scenario),
    }
    return PolicyConfig(**defaults | values)


def run(scenario: Scenario, seed: int = 0, **values: Any) -> Run:
    """A small run: `run(tiny(), 3, algorithm="dqn", gamma=0.5, beta=2.0)`, whichever part a value is of."""
    learning: dict[str, Any] = {"episodes": 4, "batch_size": 8, "buffer_size": 100, "target_every": 10}
    paid = {key: values.pop(key) for key in RewardSettings.__struct_fields__ if key in values}
    learning |= {key: values.pop(key) for key in Hyperparameters.__struct_fields__ if key in values}
    return Run(
        seed=seed,
        reward=msgspec.structs.replace(scenario.reward, **paid),
        hyperparameters=Hyperparameters(**learning),
        **{"algorithm": "dueling_dqn"} | values,
    )


def population(scenario: Scenario, *runs: Run, **values: Any) -> Population:
    """Runs side by side in a scenario; small unless told."""
    return Population(**{"observation": "mission", "hidden": (8, 8)} | values, scenario=scenario, runs=runs)


def saved(folder: Path, scenario: Scenario, **values: Any) -> Path:
    """A policy with random parameters in a new folder."""
    made = config(scenario, **values)
    parameters = network.initial(made.architecture(scenario), np.random.default_rng(1))
    policy.save(folder, made, parameters, lambda _: "# test\n")
    return folder
