"""The verb `check`: whether a scenario can be flown, with the line of each problem."""

import argparse
import sys
from pathlib import Path
from typing import Any

import msgspec

from uav_dc_ros import cli, files, scenarios
from uav_dc_ros.agents import policy as policies
from uav_dc_ros.core.keys import path_of
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import PolicyError
from uav_dc_ros.experiments.evaluate.evaluation import ONE_MISSION
from uav_dc_ros.experiments.scenarios import listing
from uav_dc_ros.scenarios.generation import flyable
from uav_dc_ros.scenarios.generation.flyable import Flyable
from uav_dc_ros.scenarios.lines import Lines
from uav_dc_ros.scenarios.problems import Problem, find, line_of

FINE, NOT_FLYABLE = 0, 1
CLUSTERS_MAX = 30  # listed one by one


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    parser.add_argument("scenario", metavar="FILE|NAME|random:SEED")
    json = "JSON instead, into a file or to the output"
    parser.add_argument("--json", nargs="?", const="-", metavar="FILE", help=json)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Print what a check of a scenario's file finds; the exit status."""
    name, json = options.scenario, options.json
    text = scenarios.read(name)
    scenario, problems = find(text, scenarios.folder(name))
    found: dict[str, Any] = {"file": name, "valid": scenario is not None}
    if scenario is not None:
        examined = flyable.examine(scenario)
        lines = Lines(text)
        problems = [Problem(line_of(lines, path_of(one)), one) for one in examined.problems]
        found |= {"scenario": scenario.name, "fingerprint": scenario.fingerprint}
        found |= {"policies": fitting(scenario), **msgspec.to_builtins(examined)}
        if json is None:
            print(f"{name}: {listing.description(scenario)}")
            print("\n".join(words(scenario, examined)))
            print(f"shipped policies that fit: {', '.join(found['policies']) or '(none): train one'}")
            print("problems: none" if not problems else f"problems: {len(problems)}")
    for problem in problems:
        cli.print_error(problem.within(name))
    found["problems"] = [{"line": problem.line, "text": problem.text} for problem in problems]
    content = msgspec.json.format(msgspec.json.encode(found), indent=2) + b"\n"
    if json == "-":
        sys.stdout.write(content.decode())
    elif json is not None:
        files.write(Path(json), content)
    return cli.FAILED if scenario is None else NOT_FLYABLE if problems else FINE


def fitting(scenario: Scenario) -> list[str]:
    """Names of the shipped policies that can fly a scenario."""
    found = []
    for name in policies.names():
        try:
            policies.load(name).check(scenario)
        except PolicyError:
            continue
        found.append(name)
    return found


def words(scenario: Scenario, examined: Flyable) -> list[str]:
    """The facts of a check, one line each."""
    tour, limits = examined.tour, scenario.mission
    lines = [] if scenario.is_random else [f"missions: {ONE_MISSION}"]
    lines += [
        f"way: {examined.moves_to_dock} of {limits.max_steps} steps from start to dock, "
        f"a move takes {examined.speed_mps:.1f} m/s",
        f"tour: lands in {tour.landed} of {tour.missions} missions, collects {tour.collected:.1f} of "
        f"{examined.users} users"
        + (f", docks at step {tour.docked_step:.1f}" if tour.docked_step is not None else "")
        + (f", takes up to {tour.energy_used_j:.4g} J" if tour.energy_used_j is not None else ""),
        "tour without a limit: "
        + (f"{tour.without_limit:.1f} steps" if tour.without_limit else "cannot collect every cluster"),
    ]
    names = scenario.users.cluster_names or (None,) * len(examined.clusters)
    for i, (name, cluster) in enumerate(zip(names, examined.clusters[:CLUSTERS_MAX], strict=False)):
        title = f"cluster {i}" if name is None else f"cluster {i} {name!r}"
        x_m, y_m = cluster.centre_m
        lines.append(
            f"{title} at {x_m:.0f}, {y_m:.0f} m: {cluster.in_reach:.0%} in reach (farthest point "
            f"{cluster.reach_m:.0f} m from a cell, d_cons {limits.d_cons_m:g} m), {cluster.collected:.1f} of "
            f"{cluster.users} users collected"
        )
    if (left := len(examined.clusters) - CLUSTERS_MAX) > 0:
        lines.append(f"and {left} more clusters: --json")
    return lines
