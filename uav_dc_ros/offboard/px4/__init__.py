"""What PX4 reports on its own topics."""
