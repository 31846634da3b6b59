"""The verb `log`: an autopilot's own log of a flight, aligned in time with its bag."""
