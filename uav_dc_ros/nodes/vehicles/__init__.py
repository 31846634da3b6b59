"""The ways to a real vehicle, by the name that the parameter `vehicle` has for them."""

from collections.abc import Mapping
from typing import Any

from rclpy.node import Node

from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import ParameterError
from uav_dc_ros.nodes.vehicles import mavros_messages
from uav_dc_ros.nodes.vehicles.mavros import MavrosVehicle
from uav_dc_ros.nodes.vehicles.px4 import Px4Vehicle, load_messages
from uav_dc_ros.offboard.frames import Enu, Geodetic
from uav_dc_ros.offboard.mavlink.connection import Address
from uav_dc_ros.offboard.mavlink.vehicle import MavlinkVehicle, load_codec
from uav_dc_ros.offboard.vehicle import Vehicle


def make(
    node: Node,
    values: Mapping[str, Any],
    scenario: Scenario,
    datum: Geodetic | None,
    grid_origin: str,
    system: int | None = None,
    restarted: bool = False,
) -> Vehicle:
    """The vehicle that a bridge's parameters name; not opened yet.

    Args:
        node: of the bridge, for ways that are made of topics.
        values: its parameters.
        scenario: whose start the vehicle stands under, unless there is a datum.
        datum: of the grid; None: see `scenario`.
        grid_origin: of the same vehicle before the bridge was started again; empty: there was none.
        system: likewise its number on the link, where the parameter names none; None: see `grid_origin`.
        restarted: was a bridge killed before it? Topics may still tell of that one.

    Raises:
        VehicleError: there is no such way on this machine.
        ParameterError: parameters that do not go together.
    """
    east_m, north_m, _ = scenario.mission.start_m
    place = Enu(east_m, north_m, 0.0)
    kind, connect = values["vehicle"], values["connect"]
    check(kind, connect, values["system"], values["arm"])
    if kind == "mavlink":
        named = values["system"] or system
        return MavlinkVehicle(connect, datum=datum, place=place, grid_origin=grid_origin, system=named)
    if kind == "mavros":
        return MavrosVehicle(
            node, place=place, grid_origin=grid_origin, datum=datum, arms=values["arm"], restarted=restarted
        )
    return Px4Vehicle(node, place=place, grid_origin=grid_origin, datum=datum, restarted=restarted)


def check(kind: str, connect: str, system: int, arm: bool) -> None:
    """Refuse a way that this machine does not have, or cannot arm by; an address that is none.

    Raises:
        VehicleError: what was wrong.
        ParameterError: an address or system where none belongs, or no address where one is needed.
    """
    if kind != "mavlink" and connect:
        raise ParameterError(f"connect: {connect!r}; expected none with a vehicle on {kind}")
    if kind != "mavlink" and system:
        raise ParameterError(f"system: {system}; expected none (0) with a vehicle on {kind}")
    if kind == "mavlink":
        if not connect:
            raise ParameterError("connect: none given; expected where the vehicle is: tcp:127.0.0.1:5760")
        Address.parse(connect)
        load_codec()
    elif kind == "px4":
        load_messages()
    elif arm:
        mavros_messages.load(needed_for="arming")
