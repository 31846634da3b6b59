"""The world as pure functions on arrays of numpy or torch: no ROS, no I/O; random draws are arguments."""
