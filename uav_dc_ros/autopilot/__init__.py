"""Flying a real vehicle: what depends neither on ROS nor on a way to talk to an autopilot.

frames   ENU and NED, yaw, and the grid around a datum on the Earth
fence    where the vehicle may be, and be sent
bridge   from connecting to landing: phases, steps, faults
"""
