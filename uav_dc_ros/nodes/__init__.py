"""The ROS side: nodes hold no maths, and only `convert` knows both messages and the core.

table            NODES: what each node is, what it hears and says: the only list
runtime          what all nodes share: parameters, topics from the tables, peers, the way to the end
pairs            what belongs to one step, brought together
convert          messages to and from the core's arrays
world            the vehicle in simulation, and the users who walk about
channel_monitor  SINR, rates, and the data collected
policy           decides moves with a trained policy
recorder         writes the bag
visualizer       draws path and markers; track knows which poses belong to the mission, drawing and cdr make
                 the messages
live_view        serves the mission to Foxglove; foxglove_server is its server
observer         run_all's own eyes: progress and summary
launcher         starts, watches and stops the nodes of a mission
executable       what `ros2 run` starts: any of the nodes, by the name that it is called
"""

import importlib.util
import sys

# Looked for, not imported: wheels from PyPI start Python anew on their first import, and whoever reads the
# node table only should not be started anew.
if importlib.util.find_spec("rclpy") is None:
    print(
        "ROS 2 is missing: no module rclpy. On a machine without it: pip install 'uav_dc_ros[ros]'. "
        "With Jazzy from apt: source /opt/ros/jazzy/setup.bash",
        file=sys.stderr,
    )
    raise SystemExit(2)
