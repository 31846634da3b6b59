"""Options of run_all that are looked at together, or need this machine: checked before anything starts."""

import contextlib
import os
from datetime import datetime
from pathlib import Path

import msgspec

from uav_dc_ros import files
from uav_dc_ros.core import pace
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import BagError, ParameterError, UavDcError
from uav_dc_ros.nodes.framework.node_table import COMPOSABLE, NODES
from uav_dc_ros.run_config import RunConfig
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


def nodes(config: RunConfig) -> list[str]:
    """Names of the nodes to start here.

    Raises:
        ParameterError: a node that does not exist, or contradicts another option.
    """
    known = [row.name for row in NODES.values() if row.process]
    wanted = list(config.nodes or ())
    if config.nodes is None:
        wanted = [name for name in known if not NODES[name].on_request]
        if config.vehicle != SIMULATED:
            wanted.append("bridge")
        if not config.record:
            wanted.remove("recorder")
    for name in wanted:
        if name not in known:
            raise ParameterError(f"--nodes: {name!r}; expected some of {', '.join(known)}")
    if "bridge" in wanted and config.vehicle == SIMULATED:
        raise ParameterError(f"--nodes: 'bridge'; expected it with --vehicle {', '.join(VEHICLES)} only")
    if config.live is not None and "live_view" not in wanted:
        wanted = [*wanted, "live_view"]
    if "recorder" in wanted and not config.record:
        raise ParameterError("--nodes: 'recorder', with --no-record; expected one or the other")
    if "recorder" not in wanted and config.bag is not None:
        raise ParameterError(f"--bag {config.bag}: no recorder is started here; expected it among --nodes")
    return [name for name in known if name in wanted]


def together(config: RunConfig, nodes: list[str]) -> list[str]:
    """Names of the nodes that share a process: in lockstep, unless told, those that wait for one another.

    Raises:
        ParameterError: it is asked for, and there are no two such nodes.
    """
    if not (config.factor is None if config.compose is None else config.compose):
        return []
    found = [name for name in nodes if name in COMPOSABLE]
    if config.compose and len(found) < 2:
        able = ", ".join(COMPOSABLE)
        raise ParameterError(f"--compose: expected two of {able} among --nodes {','.join(nodes)}")
    return found


def settings(config: RunConfig, nodes: list[str]) -> dict[str, dict[str, object]]:
    """Values of the settings (`--set`), checked, by node and parameter.

    Raises:
        ParameterError: a node that is not started here, or a parameter or value that cannot be.
    """
    given: dict[str, dict[str, object]] = {}
    for key, setting in config.settings.items():
        node, _, name = key.partition(".")
        told = f"--set {key}={setting}"
        if node not in nodes:
            raise ParameterError(f"{told}: expected a node that is started here: {', '.join(nodes)}")
        row = next((row for row in NODES[node].parameters if row.name == name), None)
        if name in OPTIONS:
            raise ParameterError(f"{told}: expected --{name}, which tells all nodes alike")
        if row is None:
            known = ", ".join(row.name for row in NODES[node].parameters if row.name not in OPTIONS)
            expected = (
                f"expected some of {known}" if known else "expected none: it has options of run_all only"
            )
            raise ParameterError(f"{told}: node {node} has no such parameter; {expected}")
        value = setting
        if isinstance(setting, str) and not isinstance(row.default, str):
            with contextlib.suppress(msgspec.DecodeError):
                value = msgspec.json.decode(setting)
        try:
            row.value(value)
        except ParameterError as error:
            raise ParameterError(f"--set {node}.{error}") from None
        given.setdefault(node, {})[name] = row.typed(value)
    return given


def check_vehicle(config: RunConfig, nodes: list[str], scenario: Scenario) -> None:
    """Refuse options that do not go together, and a way to the vehicle that this machine does not have.

    Raises:
        UavDcError: what was wrong.
    """
    simulated = config.vehicle == SIMULATED
    for name in ("connect", "system", "arm", "datum"):
        value = getattr(config, name)
        if value and simulated:
            raise ParameterError(f"--{name}: expected --vehicle {', '.join(VEHICLES)} with it")
        if value and "bridge" not in nodes:
            raise ParameterError(f"--{name}: expected the node 'bridge' among --nodes")
    if simulated:
        return
    if config.pace != pace.WATCHABLE:
        raise ParameterError(f"--pace: expected none with --vehicle {config.vehicle}, which has its own")
    if config.missions != 1:
        raise ParameterError(f"--missions {config.missions}: expected 1 with --vehicle {config.vehicle}")
    if "bridge" in nodes:
        from uav_dc_ros.nodes import vehicles
        from uav_dc_ros.offboard import datums  # a simulated run needs no way to an autopilot

        datums.parse(config.datum or "", scenario, config.vehicle, arm=config.arm)
        vehicles.check(config.vehicle, config.connect or "", config.system or 0, config.arm)


def check_writable(summary: Path, bag: Path | None) -> None:
    """Refuse a file for the summary that could not be written.

    Raises:
        ParameterError: why.
    """
    if summary.absolute() == bag:
        raise ParameterError(f"--summary {summary}: it is the folder of the bag; expected another path")
    try:
        files.check_writable(summary)
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
