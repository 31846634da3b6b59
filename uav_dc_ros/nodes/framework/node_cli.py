"""The command line of a node: ROS arguments only; `--help` lists its parameters."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from uav_dc_ros import cli
from uav_dc_ros.nodes.framework.node_table import NODES
from uav_dc_ros.nodes.framework.parameters import COMMON, Parameter

ROS_ARGUMENTS = "--ros-args"


def split(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Arguments before those for ROS, and those for ROS."""
    at = arguments.index(ROS_ARGUMENTS) if ROS_ARGUMENTS in arguments else len(arguments)
    return list(arguments[:at]), list(arguments[at:])


def parser(name: str, description: str) -> cli.Parser:
    """The command line of a node of the table, or of another program that runs one."""
    own = NODES[name].parameters if name in NODES else ()
    return cli.Parser(
        prog=f"python -m uav_dc_ros.nodes.{name}",
        usage="%(prog)s [-h] [--ros-args -p PARAMETER:=VALUE ... -r __ns:=/NAMESPACE ...]",
        description=description,
        epilog="\n".join(["parameters:", *map(_line, (*own, *COMMON))]),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def _line(row: Parameter) -> str:
    value = str(row.default).lower() if isinstance(row.default, bool) else row.default  # as ROS reads it
    default = "" if value == "" else f" (default: {value})"
    return f"  {row.name:<20}  {row.help}{default}"


def ros_arguments(description: str) -> list[str]:
    """The ROS arguments of a node's command line; exits with 2 if there are others: ROS ignores those."""
    others, for_ros = split(sys.argv[1:])
    command = parser(Path(sys.argv[0]).stem, description)
    _, unknown = command.parse_known_args(others)
    if unknown:
        command.error(f"{' '.join(unknown)!r}; expected {ROS_ARGUMENTS} first, and -p PARAMETER:=VALUE")
    return for_ros
