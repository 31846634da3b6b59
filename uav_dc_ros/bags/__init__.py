"""MCAP bags without a ROS installation.

write   a rosbag2 folder from serialised messages
"""
