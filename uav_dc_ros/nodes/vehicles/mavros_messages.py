"""What of mavros_msgs is used, where that package is installed. Nothing here needs it to be."""

import importlib
from dataclasses import dataclass
from typing import Any

from uav_dc_ros.errors import VehicleError

PACKAGE = "mavros_msgs"
HOW = "expected it installed: sudo apt install ros-jazzy-mavros-msgs"
LOCAL_POSITION_NED, ESTIMATOR_STATUS, EXTENDED_SYS_STATE = 32, 230, 245  # MAVLink's numbers


@dataclass(frozen=True, kw_only=True)
class MavrosMsgs:
    """Its messages and services, as far as they are used.

    Attributes:
        state, extended_state, sys_status, estimator_status, statustext, home, target: classes of messages.
        set_mode, command_bool, command_tol, message_interval: classes of services.
    """

    state: Any
    extended_state: Any
    sys_status: Any
    estimator_status: Any
    statustext: Any
    home: Any
    target: Any
    set_mode: Any
    command_bool: Any
    command_tol: Any
    message_interval: Any


def load(*, needed_for: str = "") -> MavrosMsgs | None:
    """The package; None if it is not installed, and not needed.

    Args:
        needed_for: what cannot be done without it; empty: all can.

    Raises:
        VehicleError: it is needed, and not installed, or another than MAVROS's of ROS 2.
    """
    try:
        messages = importlib.import_module(f"{PACKAGE}.msg")
        services = importlib.import_module(f"{PACKAGE}.srv")
    except ImportError:
        if needed_for:
            raise VehicleError(f"{needed_for} through MAVROS needs the package {PACKAGE}; {HOW}") from None
        return None
    try:
        return MavrosMsgs(
            state=messages.State,
            extended_state=messages.ExtendedState,
            sys_status=messages.SysStatus,
            estimator_status=messages.EstimatorStatus,
            statustext=messages.StatusText,
            home=messages.HomePosition,
            target=messages.PositionTarget,
            set_mode=services.SetMode,
            command_bool=services.CommandBool,
            command_tol=services.CommandTOL,
            message_interval=services.MessageInterval,
        )
    except AttributeError as error:
        raise VehicleError(
            f"{PACKAGE}: {error}; expected the one that MAVROS of this ROS distribution brings"
        ) from None
