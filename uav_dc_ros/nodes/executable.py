"""The body of `ros2 run uav_dc_ros NODE`: the same as `python -m uav_dc_ros.nodes.NODE`."""

import runpy
import sys
from pathlib import Path


def main() -> None:
    """Run the node that has the name of this executable."""
    runpy.run_module(f"uav_dc_ros.nodes.{Path(sys.argv[0]).name}", run_name="__main__", alter_sys=True)
