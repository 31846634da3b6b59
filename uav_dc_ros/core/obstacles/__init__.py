"""Buildings and no-fly zones: prisms that close cells and moves, and buildings that cut lines of sight."""

from uav_dc_ros.core.obstacles.checks import moves_to_dock, problems
from uav_dc_ros.core.obstacles.moves import UNREACHABLE, Moves
from uav_dc_ros.core.obstacles.prisms import Obstacle
from uav_dc_ros.core.obstacles.sight import Buildings

__all__ = ["UNREACHABLE", "Buildings", "Moves", "Obstacle", "moves_to_dock", "problems"]
