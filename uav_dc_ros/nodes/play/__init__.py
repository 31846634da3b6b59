"""Playback: a bag's messages onto the ROS graph."""
