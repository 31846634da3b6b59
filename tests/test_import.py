"""What importing the package does, and does not do."""

import subprocess
import sys

import pytest

NAME = "uav_dc_ros/DataCollection-v0"


def python(code: str) -> str:
    """Run code in a fresh Python; what it printed."""
    return subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout


@pytest.mark.parametrize(
    "code",
    [
        f"import gymnasium, uav_dc_ros; e = gymnasium.make('{NAME}', scenario='three_clusters')",
        f"import gymnasium; e = gymnasium.make('uav_dc_ros:{NAME}', scenario='three_clusters')",
    ],
)
def test_gymnasium_knows_the_environment(code: str) -> None:
    assert python(f"{code}; print(e.reset(seed=1)[1]['step'])").strip() == "0"


def test_the_package_alone_brings_nothing_heavy() -> None:
    heavy = ("gymnasium", "torch", "numpy", "rclpy", "matplotlib")
    assert python(f"import sys, uav_dc_ros; print(*[m for m in {heavy} if m in sys.modules])").strip() == ""
