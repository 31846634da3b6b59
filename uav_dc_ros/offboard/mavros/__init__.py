"""State of a vehicle behind MAVROS."""
