"""Flying a real vehicle. Nothing here knows ROS."""
