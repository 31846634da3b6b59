"""A UAV collects data from IoT users on the ground, steered by a dueling DQN, on ROS 2."""

__version__ = "0.1.0"
