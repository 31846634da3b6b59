"""Small worlds and policies for them, where it is not about flying well, and flights that tests share."""

import fcntl
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.conftest import PATIENCE_S, WITHOUT_VISUALIZER, Ros, ros_in
from tests.support.worlds import config, saved
from uav_dc_ros import scenarios
from uav_dc_ros.agents import network
from uav_dc_ros.agents import policy as policies
from uav_dc_ros.core.grid import Action

SMALL = """
name = "small"
[grid]
n_x = 3
n_y = 3
n_z = 2
cell_m = 100.0
altitude_min_m = 100.0
altitude_step_m = 50.0
[users]
cluster_centres_m = [[100.0, 100.0]]
users_per_cluster = 4
cluster_radius_m = 50.0
v_max_mps = 1.0
[mission]
start_m = [0.0, 0.0, 100.0]
dock_m = [200.0, 200.0]
step_s = 10.0
max_steps = 30
d_cons_m = 250.0
r_min_bits = 1e7
episode_end = "at_time_limit"
[radio]
bandwidth_hz = 1e6
tx_power_w = 5.0
noise_power_dbm = -110.0
ref_gain_db = -50.0
path_loss_exponent = 2.0
interference = "all"
[reward]
beta = 1.0
zeta = 1.0
r_plus = "binary"
form = "episode"
data_scale_bits = 1e7
"""


@pytest.fixture
def small_scenario(tmp_path: Path) -> Path:
    """A scenario file of a user's own: three by three cells, four users, thirty steps."""
    path = tmp_path / "small.toml"
    path.write_text(SMALL)
    return path


@pytest.fixture
def small_policy(tmp_path: Path, small_scenario: Path) -> Path:
    """An untrained policy for the small world."""
    return saved(tmp_path / "untrained", scenarios.load(small_scenario), name="untrained")


LOW = {  # other values than the small world's: a flight of minutes beside a fake autopilot
    "name": '"low"',
    "n_x": 8,
    "n_y": 2,
    "n_z": 1,
    "cell_m": 20.0,
    "altitude_min_m": 10.0,
    "cluster_centres_m": "[[60.0, 10.0]]",
    "cluster_radius_m": 10.0,
    "start_m": "[0.0, 0.0, 10.0]",
    "dock_m": "[140.0, 0.0]",
    "max_steps": 7,
    "d_cons_m": 50.0,
    "episode_end": '"on_arrival"',
}
LOW_BATTERY_J = 20_000.0  # of the scenario's model: a step takes about 1.6 kJ


@pytest.fixture
def low(tmp_path: Path) -> tuple[object, ...]:
    """Options for a low world with a battery: a flight of a minute, and a policy that goes east to dock."""
    path = tmp_path / "low.toml"
    text = SMALL
    for key, value in LOW.items():
        text, found = re.subn(rf"^{key} = .*$", f"{key} = {value}", text, flags=re.MULTILINE)
        assert found == 1, key
    path.write_text(f"{text}[energy]\nbattery_j = {LOW_BATTERY_J}\nends = 'both'\n")
    scenario = scenarios.load(path)
    made = config(scenario, name="eastward", observation="energy")
    parameters = network.initial(made.architecture(scenario), np.random.default_rng(1))
    zeros = {name: np.zeros_like(array) for name, array in parameters.items()}
    zeros["advantage.bias"][int(Action.RIGHT)] = 1.0
    policies.save(tmp_path / "eastward", made, zeros, lambda _: "# test\n")
    return "--scenario", path, "--policy", tmp_path / "eastward"


def flown_once(factory: pytest.TempPathFactory, name: str, fly: Callable[[Ros], None]) -> Path:
    """Folder of a flight that the workers share: whoever is the first to need it has it flown."""
    base = factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / name
    folder.mkdir(exist_ok=True)
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "flown").exists():
            for ros in ros_in(folder):
                fly(ros)
            (folder / "flown").touch()
    return folder


def small_in(folder: Path) -> tuple[Path, Path]:
    """The small world and the untrained policy, in a folder: files that are there stay as they are."""
    scenario, policy = folder / "small.toml", folder / "untrained"
    if not policy.exists():
        scenario.write_text(SMALL)
        saved(policy, scenarios.load(scenario), name="untrained")
    return scenario, policy


@dataclass(frozen=True)
class Alone:
    """Missions of the small world in lockstep, which nobody disturbed: that of seed i is the i-th."""

    scenario: Path
    policy: Path
    bag: Path


@pytest.fixture(scope="session")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Alone:
    """Four missions, one after another."""

    def fly(ros: Ros) -> None:
        scenario, policy = small_in(ros.folder)
        given = ("--scenario", scenario, "--policy", policy, "--pace", "lockstep", "--missions", 4)
        status, output = ros.run_all(*given, *WITHOUT_VISUALIZER, "--bag", "bag")
        assert status == 0, output

    folder = flown_once(tmp_path_factory, "alone", fly)
    return Alone(*small_in(folder), folder / "bag")


CLOCKS = 15  # of the thirty that a mission has: a busy machine's listener finds it late
LISTENER = """
import json, sys, time
import rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
rclpy.init()
node = rclpy.create_node("listener")
told = []
qos = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
node.create_subscription(
    Clock, sys.argv[1], lambda m: told.append((time.monotonic(), m.clock.sec + m.clock.nanosec * 1e-9)), qos
)
end = time.monotonic() + 90
while time.monotonic() < end and len(told) < int(sys.argv[2]):
    rclpy.spin_once(node, timeout_sec=0.1)
print(json.dumps(told))
"""


def python(ros: Ros, program: str, *arguments: object, **how: Any) -> subprocess.Popen[str]:
    """Run a program of a few lines beside the nodes."""
    return subprocess.Popen(
        [sys.executable, "-c", program, *map(str, arguments)],
        env=ros.environment,
        stdout=subprocess.PIPE,
        text=True,
        **how,
    )


@dataclass(frozen=True)
class Observed:
    """What a flight in a namespace left: its bag, and when a listener beside it heard which time."""

    bag: Path
    times: list[tuple[float, float]]


@pytest.fixture(scope="session")
def observed(tmp_path_factory: pytest.TempPathFactory) -> Observed:
    """A mission of three seconds of the small world, with every node: steps of a tenth of a second."""

    def fly(ros: Ros) -> None:
        scenario, policy = small_in(ros.folder)
        listener = python(ros, LISTENER, "/uav1/clock", CLOCKS)
        given = ("--scenario", scenario, "--policy", policy, "--pace", 100, "--namespace", "uav1")
        status, output = ros.run_all(*given, "--bag", "bag")
        assert status == 0, output
        (ros.folder / "times.json").write_text(listener.communicate(timeout=PATIENCE_S)[0])

    folder = flown_once(tmp_path_factory, "observed", fly)
    return Observed(folder / "bag", json.loads((folder / "times.json").read_text()))
