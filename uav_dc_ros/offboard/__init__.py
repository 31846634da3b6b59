"""Flying a real vehicle. Nothing here knows ROS, nor whether an autopilot is reached by MAVLink or by topics."""
