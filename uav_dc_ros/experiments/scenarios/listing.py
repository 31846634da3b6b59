"""The verbs `list` and `show`, and a scenario in one line."""

import argparse

from uav_dc_ros import scenarios
from uav_dc_ros.core import channel
from uav_dc_ros.core.scenario import Scenario


def run(options: argparse.Namespace) -> int:
    """Print the shipped scenarios; the exit status."""
    for name in scenarios.names():
        print(f"{name}: {description(scenarios.load(name))}")
    return 0


def show(options: argparse.Namespace) -> int:
    """Print the text of a valid scenario; the exit status."""
    scenarios.load(options.scenario)
    print(scenarios.read(options.scenario), end="")
    return 0


def description(scenario: Scenario) -> str:
    """A scenario in one line."""
    grid, mission = scenario.grid, scenario.mission
    return (
        f"{scenario.n_users} users in {scenario.n_clusters} clusters, "
        f"{grid.n_x} x {grid.n_y} x {grid.n_z} cells of {grid.cell_m:g} m, "
        f"{mission.max_steps} steps of {mission.step_s:g} s, channel {channel.title(scenario.radio)}, "
        f"fingerprint {scenario.fingerprint}"
    )
