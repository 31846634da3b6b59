"""MCAP bags without a ROS installation.

read         messages of a whole bag, of any recorder, as a stream; storage opens its files
write        a rosbag2 folder from serialised messages; part is one of its files
mend         a whole bag, in place, of what a killed recorder left; scan reads a torn file
metadata     metadata.yaml
definitions  message types as text
"""
