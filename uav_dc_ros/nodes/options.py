"""Options of run_all that are looked at together, or need this machine: checked before anything starts."""

import argparse
import os
from datetime import datetime
from pathlib import Path

import msgspec

from uav_dc_ros import files
from uav_dc_ros.core import pace
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import BagError, ParameterError, UavDcError
from uav_dc_ros.nodes import datums, vehicles
from uav_dc_ros.nodes.table import COMPOSABLE, NODES
from uav_dc_ros.topics import SIMULATED, VEHICLES

# Parameters that are options of run_all.
OPTIONS = (
    "scenario",
    "policy",
    "seed",
    "missions",
    "pace",
    "bag",
    "vehicle",
    "connect",
    "system",
    "arm",
    "datum",
)


def nodes(options: argparse.Namespace) -> list[str]:
    """Names of the nodes to start here.

    Raises:
        ParameterError: a node that does not exist, or contradicts another option.
    """
    known = [row.name for row in NODES.values() if row.process]
    wanted = options.nodes
    if wanted is None:
        wanted = [name for name in known if not NODES[name].on_request]
        if options.vehicle != SIMULATED:
            wanted.append("bridge")
        if options.no_record:
            wanted.remove("recorder")
    for name in wanted:
        if name not in known:
            raise ParameterError(f"--nodes: {name!r}; expected some of {', '.join(known)}")
    if "bridge" in wanted and options.vehicle == SIMULATED:
        raise ParameterError(f"--nodes: 'bridge'; expected it with --vehicle {', '.join(VEHICLES)} only")
    if options.live is not None and "live_view" not in wanted:
        wanted = [*wanted, "live_view"]
    if "recorder" in wanted and options.no_record:
        raise ParameterError("--nodes: 'recorder', with --no-record; expected one or the other")
    if "recorder" not in wanted and options.bag is not None:
        raise ParameterError(f"--bag {options.bag}: no recorder is started here; expected it among --nodes")
    return [name for name in known if name in wanted]


def together(options: argparse.Namespace, nodes: list[str]) -> list[str]:
    """Names of the nodes that share a process: in lockstep, unless told, those that wait for one another.

    Raises:
        ParameterError: it is asked for, and there are no two such nodes.
    """
    if not (options.pace is None if options.compose is None else options.compose):
        return []
    found = [name for name in nodes if name in COMPOSABLE]
    if options.compose and len(found) < 2:
        able = ", ".join(COMPOSABLE)
        raise ParameterError(f"--compose: expected two of {able} among --nodes {','.join(nodes)}")
    return found


def settings(options: argparse.Namespace, nodes: list[str]) -> dict[str, dict[str, object]]:
    """Values of `--set`, checked, by node and parameter.

    Raises:
        ParameterError: a node that is not started here, or a parameter or value that cannot be.
    """
    given: dict[str, dict[str, object]] = {}
    for node, name, text in options.settings:
        told = f"--set {node}.{name}={text}"
        if node not in nodes:
            raise ParameterError(f"{told}: expected a node that is started here: {', '.join(nodes)}")
        row = next((row for row in NODES[node].parameters if row.name == name), None)
        if name in OPTIONS:
            raise ParameterError(f"{told}: expected --{name}, which tells all nodes alike")
        if row is None:
            known = ", ".join(row.name for row in NODES[node].parameters if row.name not in OPTIONS)
            raise ParameterError(f"{told}: node {node} has no such parameter; expected some of {known}")
        try:
            value = text if isinstance(row.default, str) else msgspec.json.decode(text)
        except msgspec.DecodeError:
            value = text
        try:
            row.value(value)
        except ParameterError as error:
            raise ParameterError(f"--set {node}.{error}") from None
        given.setdefault(node, {})[name] = row.typed(value)
    return given


def check_vehicle(options: argparse.Namespace, nodes: list[str], scenario: Scenario) -> None:
    """Refuse options that do not go together, and a way to the vehicle that this machine does not have.

    Raises:
        UavDcError: what was wrong.
    """
    simulated = options.vehicle == SIMULATED
    for name in ("connect", "system", "arm", "datum"):
        value = getattr(options, name)
        if value and simulated:
            raise ParameterError(f"--{name}: expected --vehicle {', '.join(VEHICLES)} with it")
        if value and "bridge" not in nodes:
            raise ParameterError(f"--{name}: expected the node 'bridge' among --nodes")
    if simulated:
        return
    if options.pace != pace.WATCHABLE:
        raise ParameterError(f"--pace: expected none with --vehicle {options.vehicle}, which has its own")
    if options.missions != 1:
        raise ParameterError(f"--missions {options.missions}: expected 1 with --vehicle {options.vehicle}")
    if "bridge" in nodes:
        datums.parse(options.datum or "", scenario, options.vehicle, arm=options.arm)
        vehicles.check(options.vehicle, options.connect or "", options.system or 0, options.arm)


def check_writable(summary: Path, bag: Path | None) -> None:
    """Refuse a file for the summary that could not be written.

    Raises:
        ParameterError: why.
    """
    if summary.absolute() == bag:
        raise ParameterError(f"--summary {summary}: it is the folder of the bag; expected another path")
    try:
        files.refuse_unwritable(summary)
    except UavDcError as error:
        raise ParameterError(f"--summary {error}; expected a file in an existing folder") from None


def new_bag(wanted: Path | None) -> Path:
    """Folder of the new bag: the one wanted, or a dated one.

    Raises:
        BagError: it exists, or cannot be made.
    """
    if wanted is None:
        dated = Path("bags") / datetime.now().astimezone().strftime("%Y-%m-%d_%H-%M-%S")
        wanted = dated
        again = 2
        while wanted.exists():
            wanted, again = dated.with_name(f"{dated.name}_{again}"), again + 1
    elif wanted.exists():
        raise BagError(
            f"--bag {wanted}: it exists already, and no bag is ever overwritten; expected a new folder"
        )
    wanted = wanted.absolute()
    try:
        str(wanted).encode()
    except UnicodeEncodeError:
        raise BagError(
            f"--bag {wanted}: a ROS parameter cannot hold this path; expected one in UTF-8"
        ) from None
    above = next(parent for parent in wanted.parents if parent.exists())
    if not above.is_dir() or not os.access(above, os.W_OK):
        raise BagError(f"--bag {wanted}: {above} is not a folder that can be written; expected one")
    return wanted
