"""Small worlds and policies that fit them, for tests that are not about flying well."""

import re
from pathlib import Path

import numpy as np
import pytest

from tests.small_worlds import config, saved
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


@pytest.fixture
def low(tmp_path: Path) -> tuple[object, ...]:
    """Options for a low world, where a flight takes a minute, and a policy that goes east to its dock."""
    path = tmp_path / "low.toml"
    text = SMALL
    for key, value in LOW.items():
        text, found = re.subn(rf"^{key} = .*$", f"{key} = {value}", text, flags=re.MULTILINE)
        assert found == 1, key
    path.write_text(text)
    scenario = scenarios.load(path)
    made = config(scenario, name="eastward")
    parameters = network.initial(made.architecture(scenario), np.random.default_rng(1))
    zeros = {name: np.zeros_like(array) for name, array in parameters.items()}
    zeros["advantage.bias"][int(Action.RIGHT)] = 1.0
    policies.save(tmp_path / "eastward", made, zeros, lambda _: "# test\n")
    return "--scenario", path, "--policy", tmp_path / "eastward"
