"""Stand-ins for an autopilot, which cannot exist here: on MAVLink, behind MAVROS, with PX4's topics."""
