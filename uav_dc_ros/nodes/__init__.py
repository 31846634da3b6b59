"""The ROS side: nodes hold no maths; messages become the core's arrays in `convert`, `cdr` and `drawing`.

The tables, each the only list of its kind:

table            NODES: what each node is, hears and says, when it starts, and how often again
parameters       every parameter: description, unit, range
bridge_parameters  those of the bridge: the way to the vehicle, and how carefully it is flown
qos              profiles of the topics of `uav_dc_ros.topics`, and the peers that do not match

What all nodes are made of, the lower ones first:

managed_node     the life cycle, and the parameters
mission_node     topics from the tables, peers, diagnostics
diagnostics      what a node counts, once a second
rivals           who else publishes what a mission has one publisher of
journal          what a node that was killed must know again
executor         one thread that handles what is ready
fastdds          the middleware's settings
runtime          a node as a process, or several in one: from the start to the last word
usage            the command line of a node: its parameters, for --help
container        a process of several nodes
executable       what `ros2 run` starts: any of the nodes, by the name that it is called

The nodes:

world            the vehicle in simulation, and the users who walk about; surroundings, around a real one
bridge           a real vehicle; vehicles/ are the ways to it (MAVLink, MAVROS, PX4's topics); lease notices
                 that a policy was killed
channel_monitor  SINR, rates, and the data collected
policy           decides moves with a trained policy; pairs brings together what belongs to one step
recorder         writes the mission's bag; record, whatever anybody publishes (`bag record`); both are made of
                 recording; hearing is one topic of it; message_types finds the types of any package
visualizer       draws path and markers; track knows which poses belong to the mission, drawing draws
live_view        serves the mission to Foxglove; foxglove_server is its server

What run_all is made of:

flight           one run: check everything, start, follow, stop, tell
options          what of its options needs more than the command line to be checked
supervisor       brings nodes up in order, starts dead ones again, takes them down in reverse
launcher         a node, or several, as a child process; control is what both ends of its pipes agree on
mission_monitor  follows the missions of a run_all, for its progress display and summary
display          what the user sees of it
output           standard output and error, which can neither delay a mission nor end it

Between them: convert (ROS messages and plain values), cdr (serialised messages, where speed matters).
"""

import importlib.util
import sys
from pathlib import Path

from uav_dc_ros.errors import ParameterError, UavDcError
from uav_dc_ros.nodes.ros import environment

MISSING = (
    "ROS 2 is missing: no module rclpy. On a machine without it: pip install 'uav_dc_ros[ros]'. "
    "With Jazzy from apt: source /opt/ros/jazzy/setup.bash"
)


class RosMissingError(UavDcError, ImportError):
    """ROS 2 is missing, or cannot start in this environment: the message names the cure."""


def _refuse(why: str) -> None:
    """Raise RosMissingError. A node that is started as a command ends with one line and status 2 instead.

    Python looks for the module of `python -m` while `sys.argv[0]` is `-m`; `ros2 run` starts executables in
    `lib/uav_dc_ros`.
    """
    if sys.argv[:1] == ["-m"] or Path(sys.argv[0]).parts[-3:-1] == ("lib", "uav_dc_ros"):
        print(why, file=sys.stderr)
        raise SystemExit(2)
    raise RosMissingError(why)


# Looked for, not imported: wheels from PyPI start Python anew on their first import, and whoever reads the
# node table only should not be started anew.
if importlib.util.find_spec("rclpy") is None:
    _refuse(MISSING)
try:
    environment.check_import()
except ParameterError as error:
    _refuse(f"error: {error}")
