"""The transports to a real vehicle, by the value of the parameter `vehicle`."""

from collections.abc import Mapping, Sequence
from typing import Any

from rclpy.node import Node

from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import ParameterError
from uav_dc_ros.nodes.vehicles import mavros, px4
from uav_dc_ros.offboard.frames import Enu, Geodetic
from uav_dc_ros.offboard.mavlink.connection import Address
from uav_dc_ros.offboard.mavlink.vehicle import MavlinkVehicle, load_codec
from uav_dc_ros.offboard.vehicle import Vehicle


def make(
    node: Node,  # the bridge
    values: Mapping[str, Any],  # of its parameters
    scenario: Scenario,  # at its start the vehicle stands when its first position comes (ENU of the grid)
    datum: Geodetic | None,  # replaces start and `datum_deg`. Through MAVROS, the start gives the height
    grid_origin: str,  # of an earlier bridge in the same flight, which replaces all of them; empty: none
    system: int | None,  # MAVLink system of the vehicle then, unless the parameter names one
    restarted: bool,  # whether an earlier bridge was killed, which the ROS graph may still list
    fence: Sequence[Enu] = (),  # corners of a polygon to upload (ENU of the grid); empty: none
) -> Vehicle:
    """The vehicle that a bridge's parameters name; not opened yet. Call `check` before."""
    start = Enu(*scenario.mission.start_m)._replace(up_m=0.0)
    datum_deg = None if values["datum"] or grid_origin else scenario.datum_deg
    grid: dict[str, Any] = {"start": start, "datum": datum, "datum_deg": datum_deg}
    grid["grid_origin"] = grid_origin
    if values["vehicle"] == "mavlink":
        return MavlinkVehicle(values["connect"], **grid, system=values["system"] or system, fence=fence)
    if values["vehicle"] == "mavros":
        return mavros.MavrosVehicle(node, **grid, arms=values["arm"], restarted=restarted)
    return px4.Px4Vehicle(node, **grid, restarted=restarted)


def check(kind: str, connect: str, system: int, arm: bool, upload_fence: bool) -> None:
    """Check parameters against each other (ParameterError), and that the transport is available.

    Raises VehicleError if it is not, or cannot arm, or the address is invalid.
    """
    if kind != "mavlink" and connect:
        raise ParameterError(f"connect: {connect!r}; expected none with a vehicle on {kind}")
    if kind != "mavlink" and system:
        raise ParameterError(f"system: {system}; expected none (0) with a vehicle on {kind}")
    if kind != "mavlink" and upload_fence:
        raise ParameterError(f"upload_fence: true; expected false with a vehicle on {kind}")
    if kind == "mavlink":
        if not connect:
            raise ParameterError("connect: none given; expected an address such as tcp:127.0.0.1:5760")
        Address.parse(connect)
        load_codec()
    elif kind == "px4":
        px4.load_messages()
    elif arm:
        mavros.load_messages(needed_for="arming")
