"""A mission under another channel model than the paper's, with all that a channel draws.

Nodes, environment and `bag verify` agree to the last bit.
"""

import re
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from tests.conftest import WITHOUT_VISUALIZER, Ros, each_once, read_bag
from tests.nodes.conftest import SMALL
from tests.support.worlds import saved
from uav_dc_ros import bag as command
from uav_dc_ros import scenarios
from uav_dc_ros.core.grid import Action
from uav_dc_ros.env.registration import ENV_ID

URBAN = """model = "air_to_ground"
carrier_hz = 2e9
environment = "urban"
line_of_sight = "drawn"
shadowing = { sigma_db = 4.0, correlation_m = 50.0 }
fading = { model = "rician", k_db = 10.0 }
"""
# A tower in the middle, a pole beside the start, and a zone over the upper layer.
OBSTACLES = """
[[obstacles]]
name = "tower"
polygon_m = [[80.0, 80.0], [120.0, 80.0], [100.0, 120.0]]
height_m = 170.0
[[obstacles]]
polygon_m = [[40.0, 5.0], [60.0, 5.0], [60.0, 15.0], [40.0, 15.0]]
height_m = 90.0
[[obstacles]]
kind = "no_fly"
polygon_m = [[-20.0, 80.0], [20.0, 80.0], [20.0, 220.0], [-20.0, 220.0]]
base_m = 140.0
"""
COLUMNS = ("sinr", "rate_bps", "served", "data_bits", "collected")


def test_nodes_and_verify_follow_the_environment_to_the_last_bit(
    ros: Ros, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    free = r"ref_gain_db = .*\npath_loss_exponent = .*\n"
    text, found = re.subn(free, URBAN, SMALL)
    assert found == 1
    path = tmp_path / "urban.toml"
    path.write_text(text + OBSTACLES)
    scenario = scenarios.load(path)
    policy = saved(tmp_path / "untrained", scenario, name="untrained")
    status, output = ros.run_all(
        *("--scenario", path, "--policy", policy, "--pace", "lockstep", "--seed", 5),
        *WITHOUT_VISUALIZER,
        *("--bag", "bag"),
    )
    assert status == 0, output
    bag = read_bag(ros.folder / "bag")
    rates, moves = (
        {one["step"]: one for one in each_once([payload for name, payload in bag if name == topic])}
        for topic in ("/rates", "/move")
    )
    assert len(moves) == scenario.mission.max_steps
    env = gymnasium.make(ENV_ID, scenario=scenario).unwrapped
    _, info = env.reset(seed=5)
    for step in range(scenario.mission.max_steps):
        action = Action[moves[step]["action"].upper()]
        assert info["action_mask"][action], "a policy takes moves that have an effect"
        *_, info = env.step(action)
        for column in COLUMNS:
            np.testing.assert_array_equal(rates[step + 1][column], info[column], err_msg=f"{step} {column}")
    with pytest.raises(SystemExit) as end:
        command.main(["verify", str(ros.folder / "bag"), "--policy-dir", str(policy)])
    out = capsys.readouterr().out
    assert end.value.code == 0, out
    n_steps = scenario.mission.max_steps + 1
    assert f"channel: {n_steps} of {n_steps} steps recomputed, equal to the last bit" in out
    users = each_once([payload for name, payload in bag if name == "/users"])
    assert len({one["shadowing_seed"] for one in users}) == 1
    assert len({one["link_seed"] for one in users}) == n_steps
