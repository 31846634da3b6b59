"""A policy node of your own in ROS 2: it waits over each cluster for a while, then flies to the dock.

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

scenario = uav_dc_ros.load_scenario("five_clusters")
cell_m = scenario.grid.cell_m
clusters = sorted((round(x / cell_m), round(y / cell_m)) for x, y in scenario.users.cluster_centres_m)
way = [cell for cell in clusters for _ in range(5)]  # a few steps over each cluster, from west to east
way.append(scenario.dock_cell)
LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)

rclpy.init()
node = rclpy.create_node("policy")  # the name that the other nodes wait for
moves = node.create_publisher(String, "move", 10)
ready = node.create_publisher(String, "ready", LATCHED)
node.create_publisher(DiagnosticArray, "diagnostics", 10)  # the recorder waits for it; may stay silent


def on_mission(message: String) -> None:
    """Answer each step that the vehicle is ready for."""
    mission = json.loads(message.data)
    if mission["phase"] != "ready":
        print(f"mission over: {mission['phase']} after {mission['step']} steps")
        raise SystemExit
    east, north, _ = mission["cell"]
    if len(way) > 1 and (east, north) == way[0]:
        way.pop(0)
    if east != way[0][0]:
        action = "right" if east < way[0][0] else "left"
    elif north != way[0][1]:
        action = "forward" if north < way[0][1] else "backward"
    else:
        action = "hover"
    answer = {"run": mission["run"], "mission": mission["mission"], "step": mission["step"], "action": action}
    moves.publish(String(data=json.dumps(answer)))


node.create_subscription(String, "mission", on_mission, LATCHED)
node.create_subscription(String, "rates", lambda rates: None, LATCHED)  # what was collected; unused here
ready.publish(String(data=json.dumps({"run": "", "node": "policy"})))
rclpy.spin(node)
