"""What importing the package does, and does not do."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

NAME = "uav_dc_ros/DataCollection-v0"


def python(code: str) -> str:
    """Run code in a fresh Python; what it printed."""
    return subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout


@pytest.mark.parametrize(
    "code",
    [
        f"import gymnasium, uav_dc_ros; e = gymnasium.make('{NAME}', scenario='three_clusters_hover')",
        f"import uav_dc_ros, gymnasium; e = gymnasium.make('{NAME}', scenario='three_clusters_hover')",
        f"import uav_dc_ros; from gymnasium.envs.registration import make\ne = make('{NAME}')",
        f"import gymnasium; e = gymnasium.make('uav_dc_ros:{NAME}', scenario='three_clusters_hover')",
    ],
)
def test_gymnasium_knows_the_environment(code: str) -> None:
    assert python(f"{code}; print(e.reset(seed=1)[1]['step'])").strip() == "0"


def test_the_package_alone_brings_nothing_heavy() -> None:
    heavy = ("gymnasium", "torch", "numpy", "rclpy", "matplotlib")
    assert python(f"import sys, uav_dc_ros; print(*[m for m in {heavy} if m in sys.modules])").strip() == ""


def test_without_gymnasium_its_import_fails_as_ever() -> None:
    code = (
        "import sys, uav_dc_ros; sys.path[:] = []; sys.path_importer_cache.clear()\n"
        "try: import gymnasium\nexcept ModuleNotFoundError as error: print(error.name)"
    )
    assert python(code).strip() == "gymnasium"


def loaded(code: str, *modules: str) -> list[str]:
    """Those of the modules that are there after running code in a fresh Python."""
    return python(f"import sys\n{code}\nprint(*[m for m in {modules} if m in sys.modules])").split()


@pytest.mark.parametrize(
    ("module", "unwanted"),
    [
        ("env.gym_env", ("matplotlib", "torch", "rclpy", "mcap", "rosbags")),
        ("env.vector_env", ("matplotlib", "torch", "rclpy", "mcap", "rosbags")),
        ("experiments.train.cli", ("matplotlib", "rclpy", "mcap", "rosbags", "ruamel")),
        ("experiments.train.training", ("matplotlib", "rclpy", "mcap", "rosbags", "ruamel")),
        ("run_all", ("numpy", "rclpy", "rich", "msgspec")),
        (
            "runner.mission_runner",
            (
                *("rosbags", "mcap", "ruamel", "rich", "matplotlib", "gymnasium"),
                *("uav_dc_ros.nodes.vehicles", "uav_dc_ros.offboard.mavlink.vehicle", "pymavlink"),
            ),
        ),
    ],
)
def test_a_module_brings_nothing_that_it_does_not_need(module: str, unwanted: tuple[str, ...]) -> None:
    assert loaded(f"import uav_dc_ros.{module}", *unwanted) == []


def test_a_simulated_run_brings_no_way_to_an_autopilot() -> None:
    code = (
        "from uav_dc_ros.runner.mission_runner import MissionRunner\n"
        "from uav_dc_ros.run_config import RunConfig\n"
        "MissionRunner(RunConfig(record=False))"
    )
    vehicles = ("uav_dc_ros.nodes.vehicles", "uav_dc_ros.offboard.datums", "pymavlink", "pymap3d", "px4_msgs")
    assert loaded(code, *vehicles) == []


def test_a_numpy_scalar_brings_no_wrapper_of_numpy() -> None:
    """It imports f2py: a tenth of a node's start."""
    code = "import numpy as np\nfrom uav_dc_ros.core.arrays import array_namespace\n"
    code += "assert array_namespace(np.float64(2.0)).exp(np.float64(2.0)) == np.exp(2.0)"
    assert loaded(code, "numpy.f2py", "array_api_compat.numpy") == []


def test_nodes_without_ros_name_the_cure() -> None:
    code = (
        "import sys; sys.modules['rclpy'] = None\n"
        "try: import uav_dc_ros.nodes\nexcept ImportError as error: print(error)"
    )
    assert "pip install 'uav_dc_ros[ros]'" in python(code)


@pytest.mark.parametrize("node", ["world", "channel_monitor", "policy", "bridge", "recorder", "visualizer"])
def test_a_node_that_flies_brings_nothing_that_it_does_not_need(node: str) -> None:
    """It may have to be started again in the air, on a small computer."""
    heavy = ("torch", "gymnasium", "matplotlib", "rich", "mcap", "rosbags", "ruamel")
    code = f"import sys, uav_dc_ros.nodes.{node}; print(*[m for m in {heavy} if m in sys.modules])"
    assert python(code).strip() == ""


BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.mark.parametrize("benchmark", sorted(path.stem for path in BENCHMARKS.glob("*.py")))
def test_a_benchmark_can_be_started(benchmark: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if benchmark == "sb3_dqn":
        pytest.importorskip("stable_baselines3")
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    spec = importlib.util.spec_from_file_location(benchmark, BENCHMARKS / f"{benchmark}.py")
    assert spec is not None
    assert spec.loader is not None
    spec.loader.exec_module(importlib.util.module_from_spec(spec))
