"""Several nodes in one process, which ROS 2 calls a container.

    python -m uav_dc_ros.nodes.container world channel_monitor policy --ros-args --params-file mission.yaml

Nodes that wait for one another in every step do not run in parallel. In one process the middleware delivers a
message in the thread that publishes it; between processes each message wakes two threads and a node. Nodes of
one process also receive one copy of a message from another. But a node that dies ends the others, too.
"""

import importlib
import sys
from typing import NoReturn

from uav_dc_ros import cli
from uav_dc_ros.nodes.framework import node_main
from uav_dc_ros.nodes.framework.mission_node import MissionNode
from uav_dc_ros.nodes.framework.node_table import CONTAINERS, NODES


def parser() -> cli.Parser:
    """The command line before --ros-args."""
    options = cli.Parser(
        prog="python -m uav_dc_ros.nodes.container",
        description="Run several nodes in one process. Parameters follow --ros-args, as of any node; those "
        "of one node come from a file (--params-file).",
    )
    choices = [name for names in CONTAINERS.values() for name in names]
    options.add_argument("nodes", nargs="+", choices=choices, metavar="NODE", help=", ".join(choices))
    return options


def _node_class(name: str) -> type[MissionNode]:
    """The class of a composable node: `ChannelMonitorNode` in the module `channel_monitor`."""
    module = importlib.import_module(f"uav_dc_ros.nodes.{name}")
    found: type[MissionNode] = getattr(module, f"{name.title().replace('_', '')}Node")
    return found


def main(arguments: list[str] | None = None) -> NoReturn:
    """Run the nodes until a stop request."""
    own, for_ros = node_main.split(sys.argv[1:] if arguments is None else arguments)
    names = dict.fromkeys(parser().parse_args(own).nodes)
    in_order = sorted(names, key=lambda name: NODES[name].rank)
    node_main.main(*map(_node_class, in_order), arguments=for_ros)


if __name__ == "__main__":
    main()
