"""A policy node of your own in ROS 2: it flies over each cluster, then to the dock.

Start it beside the other nodes, which wait for it:

    python examples/own_policy_node.py &
    python -m uav_dc_ros.run_all --nodes world,channel_monitor,recorder --pace lockstep

The vehicle publishes on `mission` which step it is ready for, and a policy answers on `move`. Both are JSON
in a std_msgs/String. The node ends when the mission is over.
"""

import json

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String

import uav_dc_ros

LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
scenario = uav_dc_ros.load_scenario("five_clusters")
cell_m = scenario.grid.cell_m
clusters = sorted((round(x / cell_m), round(y / cell_m)) for x, y in scenario.cluster_centres_m)
way = [*clusters, scenario.dock_cell]

rclpy.init()
node = rclpy.create_node("policy")  # the name that the other nodes wait for
moves = node.create_publisher(String, "move", 10)
ready = node.create_publisher(String, "ready", LATCHED)
node.create_publisher(DiagnosticArray, "diagnostics", 10)  # the recorder waits for it


def on_mission(message: String) -> None:
    """Answer each step that the vehicle is ready for."""
    mission = json.loads(message.data)
    if mission["phase"] != "ready":
        print(f"mission over: {mission['phase']} after {mission['step']} steps")
        raise SystemExit
    if len(way) > 1 and tuple(mission["cell"][:2]) == tuple(way[0]):
        way.pop(0)
    east, north = way[0][0] - mission["cell"][0], way[0][1] - mission["cell"][1]
    along = ("left", "hover", "right")[(east > 0) - (east < 0) + 1]
    across = ("backward", "hover", "forward")[(north > 0) - (north < 0) + 1]
    answer = {key: mission[key] for key in ("run", "mission", "step")} | {"action": along if east else across}
    moves.publish(String(data=json.dumps(answer)))


node.create_subscription(String, "mission", on_mission, LATCHED)
node.create_subscription(String, "rates", lambda rates: None, LATCHED)  # what was collected, which it ignores
ready.publish(String(data=json.dumps({"run": "", "node": "policy"})))
rclpy.spin(node)
