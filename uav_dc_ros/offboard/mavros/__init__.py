"""What MAVROS reports of its vehicle."""
