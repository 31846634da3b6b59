"""ROS itself: executor, QoS, messages, middleware, environment. Nothing here knows a mission."""
