"""What holds for a command's ROS and that of its nodes, unless the user's environment says otherwise."""

import os

from uav_dc_ros.errors import ParameterError
from uav_dc_ros.nodes import fastdds

LINES = "RCUTILS_CONSOLE_OUTPUT_FORMAT"
LINE_OF_NODE = "{severity}: {message}"  # whose line it is says who passes it on
LINE_OF_ONE_OF_MANY = "{severity}: {name}: {message}"
DOMAIN_MAX = 232  # the ports of higher ones do not exist


def prepare(*, alone: bool) -> None:
    """Set it; to be called before ROS is imported.

    Args:
        alone: is all that takes part on this host? Then nobody else on the network sees it by accident.

    Raises:
        ParameterError: an environment in which ROS cannot start.
    """
    domain = os.environ.get("ROS_DOMAIN_ID", "0")
    if not (domain.isdecimal() and int(domain) <= DOMAIN_MAX):
        raise ParameterError(f"ROS_DOMAIN_ID is {domain!r}; expected a whole number from 0 to {DOMAIN_MAX}")
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST" if alone else "SUBNET")
    os.environ.setdefault(LINES, LINE_OF_NODE)
    fastdds.use_profiles()
