"""An autopilot on MAVLink, over TCP, UDP or a serial line."""
