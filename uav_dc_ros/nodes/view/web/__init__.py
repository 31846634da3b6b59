"""The live view in a browser: what it shows, its server and its page. Needs no ROS."""
