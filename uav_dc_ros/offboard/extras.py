"""Packages that only a real vehicle needs."""

import importlib
from typing import Any

from uav_dc_ros.errors import VehicleError


def load(module: str, need: str) -> Any:
    """A module of the extra `mavlink`; raises VehicleError with the need if it is not installed."""
    try:
        return importlib.import_module(module)
    except ImportError:
        raise VehicleError(f"{need}; expected it installed: pip install 'uav_dc_ros[mavlink]'") from None
