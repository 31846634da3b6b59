"""A UAV collects data from IoT users on the ground, steered by a dueling DQN, on ROS 2."""

import importlib
import sys

__version__ = "0.1.0"

# Gymnasium looks for no plug-ins: `import gymnasium, uav_dc_ros` is what makes the environment known. Without
# Gymnasium nothing is imported, since what flies does not need it.
if sys.modules.get("gymnasium"):
    importlib.import_module("uav_dc_ros.env.registration")
