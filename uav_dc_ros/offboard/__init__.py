"""Flying a real vehicle: what depends neither on ROS nor on a way to talk to an autopilot.

frames   ENU and NED, yaw, and the grid around a datum on the Earth
fence    where the vehicle may be, and be sent
vehicle  what passes between the bridge and a transport
battery  is the battery low
watch    how carefully to fly, and what is wrong
hold     what keeps a vehicle from going on, for a while
patience how long a policy is waited for
asking   when to utter a wish
course   where a mission stands on the grid
ground   before the first step
crash    what shows that a vehicle does not fly any more
plausibility  telemetry that cannot be true
progress is it coming nearer
field_check  the autopilot's limits beside the field
descent  what brings a vehicle down
beat     of heartbeats and a stream of setpoints
priority running when it is due
bridge   from connecting to landing: phases, steps, faults
mavlink  a transport: an autopilot on MAVLink, over TCP, UDP or a serial line, with
  session   what is sent when, and what came
  links     TCP, UDP, a serial line
  hearing   what is known of the vehicle, with
    systems   which vehicle is meant
    ordering  which messages are news
    rivals    evidence of another controller
    limits    the autopilot's own, from its parameters
    dialects  what ArduCopter and PX4 do differently
"""
