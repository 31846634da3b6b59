"""Checks of run_all's options that depend on one another, or on this machine, before anything starts."""

import contextlib
import os
from datetime import datetime
from pathlib import Path

import msgspec

from uav_dc_ros import files
from uav_dc_ros.agents.agent import Agent
from uav_dc_ros.core import pace
from uav_dc_ros.core.objective import DEFAULT_WEIGHT
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import BagError, ParameterError, UavDcError
from uav_dc_ros.nodes.framework.node_table import CONTAINERS, NODES, STEPS
from uav_dc_ros.planners import PLANNERS
from uav_dc_ros.run_config import RunConfig
from uav_dc_ros.topics import SIMULATED, VEHICLES

# Options of a vehicle, and the vehicles that have them.
VEHICLE_OPTIONS = {
    "connect": ("mavlink",),
    "system": ("mavlink",),
    "arm": VEHICLES,
    "datum": VEHICLES,
    "upload_fence": ("mavlink",),
}
_SHARED = ("scenario", "policy", "search", "seed", "missions", "pace", "bag", "vehicle", *VEHICLE_OPTIONS)
# Parameters that are options of run_all, and their options.
OPTIONS = {name: name.replace("_", "-") for name in _SHARED} | {
    "objective_weight": "objective",
    "search_time_limit_s": "search-time-limit",
}


def nodes(config: RunConfig) -> list[str]:
    """Names of the nodes to start on this host; raises ParameterError for a contradiction."""
    known = [row.name for row in NODES.values() if row.process]
    selected = list(config.nodes or ())
    if config.nodes is None:
        selected = [name for name in known if not NODES[name].on_request]
        if config.vehicle != SIMULATED:
            selected.append("bridge")
        if not config.record:
            selected.remove("recorder")
    for name in selected:
        if name not in known:
            raise ParameterError(f"--nodes: {name!r}; expected some of {', '.join(known)}")
    if "bridge" in selected and config.vehicle == SIMULATED:
        raise ParameterError(f"--nodes: 'bridge'; expected it with --vehicle {', '.join(VEHICLES)} only")
    if config.live is not None:
        selected.append("live_view")
    if config.view is not None:
        selected.append("web_view")
    if "recorder" in selected and not config.record:
        raise ParameterError("--nodes: 'recorder', with --no-record; expected one or the other")
    if "recorder" not in selected and config.bag is not None:
        raise ParameterError(f"--bag {config.bag}: no recorder is started here; expected it among --nodes")
    return [name for name in known if name in selected]


def composed(config: RunConfig, nodes: list[str]) -> list[list[str]]:
    """Names of the nodes that share each process, by default in lockstep; may raise ParameterError."""
    if not (config.factor is None if config.compose is None else config.compose):
        return []
    found = {key: [name for name in nodes if name in names] for key, names in CONTAINERS.items()}
    if config.compose and len(found[STEPS]) < 2:
        expected = ", ".join(CONTAINERS[STEPS])
        raise ParameterError(f"--compose: expected two of {expected} among --nodes {','.join(nodes)}")
    return [names for names in found.values() if len(names) > 1]


def settings(config: RunConfig, nodes: list[str]) -> dict[str, dict[str, object]]:
    """Values of `--set`, by node and parameter; raises ParameterError for an invalid one."""
    checked: dict[str, dict[str, object]] = {}
    for key, value in config.settings.items():
        node, _, name = key.partition(".")
        option = f"--set {key}={value}"
        if node not in nodes:
            raise ParameterError(f"{option}: expected a node that is started here: {', '.join(nodes)}")
        row = next((row for row in NODES[node].parameters if row.name == name), None)
        if name in OPTIONS:
            raise ParameterError(f"{option}: expected --{OPTIONS[name]}, which sets it for all nodes")
        if row is None:
            known = ", ".join(row.name for row in NODES[node].parameters if row.name not in OPTIONS)
            expected = f"some of {known}" if known else "none: it has options of run_all only"
            raise ParameterError(f"{option}: node {node} has no such parameter; expected {expected}")
        if isinstance(value, str) and not isinstance(row.default, str):
            with contextlib.suppress(msgspec.DecodeError):
                value = msgspec.json.decode(value)
        try:
            row.value(value)
        except ParameterError as error:
            raise ParameterError(f"--set {node}.{error}") from None
        checked.setdefault(node, {})[name] = row.typed(value)
    return checked


def weight(config: RunConfig, agent: Agent) -> float:
    """The weight of the objective; raises ParameterError for one that a policy or planner does not use."""
    if config.objective is None:
        return DEFAULT_WEIGHT
    if not agent.weighs:
        weighed = ", ".join(planner.name for planner in PLANNERS.values() if planner.weighs)
        raise ParameterError(
            f"--objective {config.objective:g}: the moves of {agent.name!r} do not depend on it; expected it "
            f"with {weighed}, --search, or a policy that observes 'entities'"
        )
    return float(config.objective)


def search_time_limit_s(config: RunConfig, scenario: Scenario) -> float:
    """The time of a search, seconds, 0 without a limit; raises ParameterError where it has no use."""
    limit_s, factor = config.search_time_limit, config.factor if config.vehicle == SIMULATED else 1.0
    if limit_s is None:
        return pace.period_s(scenario, factor) / 2.0 if config.search else 0.0
    if not config.search or factor is None:
        expected = "a --pace in real time: a lockstep waits" if config.search else "--search with it"
        raise ParameterError(f"--search-time-limit {limit_s:g}: expected {expected}")
    return float(limit_s)


def check_vehicle(config: RunConfig, nodes: list[str], scenario: Scenario) -> None:
    """Raise UavDcError for contradicting options of a vehicle, or a connection that this machine lacks."""
    simulated = config.vehicle == SIMULATED
    for name, vehicles_with_it in VEHICLE_OPTIONS.items():
        value = getattr(config, name)
        option = f"--{name.replace('_', '-')}"
        if value and simulated:
            raise ParameterError(f"{option}: expected --vehicle {', '.join(vehicles_with_it)} with it")
        if value and "bridge" not in nodes:
            raise ParameterError(f"{option}: expected the node 'bridge' among --nodes")
    if simulated:
        return
    if config.pace != pace.WATCHABLE:
        raise ParameterError(f"--pace: expected none with --vehicle {config.vehicle}, which has its own")
    if config.missions != 1:
        raise ParameterError(f"--missions {config.missions}: expected 1 with --vehicle {config.vehicle}")
    if "bridge" in nodes:
        from uav_dc_ros.nodes import vehicles
        from uav_dc_ros.offboard import datums  # a simulated run needs no autopilot

        datums.parse(config.datum or "", scenario, config.vehicle, arm=config.arm)
        address, system = config.connect or "", config.system or 0
        vehicles.check(config.vehicle, address, system, config.arm, config.upload_fence)


def check_summary(summary: Path, bag: Path | None) -> None:
    """Raise ParameterError if the summary cannot be written."""
    if summary.absolute() == bag:
        raise ParameterError(f"--summary {summary}: it is the folder of the bag; expected another path")
    try:
        files.check_writable(summary)
    except UavDcError as error:
        raise ParameterError(f"--summary {error}; expected a file in an existing folder") from None


def new_bag(wanted: Path | None) -> Path:
    """Folder of the new bag, by default a dated one; raises BagError if it exists or cannot be created."""
    bag = wanted
    if bag is None:
        dated = bag = Path("bags") / datetime.now().astimezone().strftime("%Y-%m-%d_%H-%M-%S")
        number = 2
        while bag.exists():
            bag, number = dated.with_name(f"{dated.name}_{number}"), number + 1
    elif bag.exists():
        raise BagError(f"--bag {bag}: it exists already, and is not overwritten; expected a new folder")
    bag = bag.absolute()
    try:
        str(bag).encode()
    except UnicodeEncodeError:
        raise BagError(f"--bag {bag}: a ROS parameter cannot hold this path; expected one in UTF-8") from None
    existing = next(parent for parent in bag.parents if parent.exists())
    if not existing.is_dir() or not os.access(existing, os.W_OK):
        raise BagError(f"--bag {bag}: {existing} is not a folder that can be written; expected one")
    return bag
