"""MCAP bags without a ROS installation.

read         messages of a bag, of any recorder, as a stream; storage and mcap_storage open its files
read_ahead   the same, read in a thread before they are wanted
write        a rosbag2 folder from serialised messages; series is its parts, part one of them, sync their way
             to the disk; compression names its ways
mend         a whole bag, in place, of what a killed recorder left
recover      a whole bag, in a new folder, of a torn or damaged one
scan         reads a torn or damaged file as far as it goes; frames are its records
metadata     metadata.yaml
definitions  message types as text
"""
