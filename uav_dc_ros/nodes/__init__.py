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
observer         run_all's own eyes: the mission so far, and its summary
display          what the user sees of it
output           standard output and error, which can neither delay a mission nor end it

Between them: convert (ROS messages and plain values), cdr (serialised messages, where speed matters).
"""

import importlib.util
import sys

from uav_dc_ros.errors import ParameterError
from uav_dc_ros.nodes import environment

# Looked for, not imported: wheels from PyPI start Python anew on their first import, and whoever reads the
# node table only should not be started anew.
if importlib.util.find_spec("rclpy") is None:
    print(
        "ROS 2 is missing: no module rclpy. On a machine without it: pip install 'uav_dc_ros[ros]'. "
        "With Jazzy from apt: source /opt/ros/jazzy/setup.bash",
        file=sys.stderr,
    )
    raise SystemExit(2)
try:
    environment.check_import()
except ParameterError as error:
    print(f"error: {error}", file=sys.stderr)
    raise SystemExit(2) from None
