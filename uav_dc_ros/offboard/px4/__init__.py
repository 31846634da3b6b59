"""State of a vehicle on PX4's own topics."""
