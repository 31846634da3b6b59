"""A field of a user's own, with users from a file in degrees: nodes, environment, bag and report agree."""

import json
from pathlib import Path

import numpy as np
import pymap3d
import pytest
from pyarrow import parquet

from tests.conftest import WITHOUT_VISUALIZER, Ros, each_once, read_bag
from tests.nodes.conftest import SMALL
from tests.support.worlds import saved
from uav_dc_ros import bag as command
from uav_dc_ros import scenarios
from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.users.service import FIGURES
from uav_dc_ros.env.gym_env import DataCollectionEnv
from uav_dc_ros.recordings import step_reader
from uav_dc_ros.recordings.pages.missions import read_missions

DATUM = (47.397742, 8.545594)
USERS = """
file = "users.csv"

[users.mobility]
model = "gauss_markov"
alpha = 0.7
mean_speed_mps = 1.5
"""
# x, y (m), cluster, radius_m, data_bits, priority
PLACES = [
    (40, 60, "a", 5, "", 3),
    (90, 110, "", 0, 1e5, ""),
    (60, 50, "a", "", 4e5, ""),
    (30, 130, "b", 10, "", 0.5),
    (35, 120, "b", 10, "", ""),
]


def own_field(folder: Path) -> Path:
    """A scenario file, and the users that it names."""
    lines = ["name,latitude,longitude,cluster,radius_m,data_bits,priority"]
    for i, (x_m, y_m, *others) in enumerate(PLACES):
        latitude, longitude, _ = pymap3d.enu2geodetic(x_m, y_m, 0.0, *DATUM, 0.0)
        lines.append(",".join(map(str, (f"sensor {i}", float(latitude), float(longitude), *others))))
    (folder / "users.csv").write_text("\n".join(lines))
    before, rest = SMALL.split("[users]\n")
    after = rest[rest.index("\n[mission]") :]
    path = folder / "own.toml"
    path.write_text(f"datum_deg = {list(DATUM)}\n{before}[users]{USERS}{after}")
    return path


def test_nodes_and_bag_follow_the_environment_to_the_last_bit(
    ros: Ros, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = own_field(tmp_path)
    scenario = scenarios.load(path)
    assert scenario.users.sizes == (2, 1, 2)
    policy = saved(tmp_path / "untrained", scenario, name="untrained")
    status, output = ros.run_all(
        *("--scenario", path, "--policy", policy, "--pace", "lockstep", "--seed", 5),
        *WITHOUT_VISUALIZER,
        *("--bag", "bag", "--summary", "summary.json"),
    )
    assert status == 0, output
    bag = read_bag(ros.folder / "bag")
    users, rates, moves = (
        {one["step"]: one for one in each_once([payload for name, payload in bag if name == topic])}
        for topic in ("/users", "/rates", "/move")
    )
    env = DataCollectionEnv(scenario)
    env.reset(seed=5)
    for step in range(scenario.mission.max_steps):
        *_, info = env.step(np.int64(Action[moves[step]["action"].upper()]))
        np.testing.assert_array_equal([users[step + 1][key] for key in ("x_m", "y_m")], info["users_m"].T)
        for column in ("sinr", "rate_bps", "served", "data_bits", "collected"):
            np.testing.assert_array_equal(rates[step + 1][column], info[column], err_msg=f"{step} {column}")

    summary = json.loads((ros.folder / "summary.json").read_text())
    expected = {name: None if np.isnan(info[name]) else float(info[name]) for name in FIGURES}
    assert {name: summary[name] for name in FIGURES} == expected

    (tmp_path / "users.csv").unlink()  # the bag and the policy hold the users themselves
    with pytest.raises(SystemExit) as end:
        command.main(["verify", str(ros.folder / "bag"), "--policy-dir", str(policy), "--complete"])
    out = capsys.readouterr().out
    assert end.value.code == 0, out
    assert f"users: age of information {expected['mean_age_s']:.1f} s, fairness " in out
    with pytest.raises(SystemExit) as end:
        command.main(["export", str(ros.folder / "bag"), "--out", str(tmp_path / "tables")])
    assert end.value.code == 0
    table = parquet.read_table(tmp_path / "tables" / "missions.parquet")
    assert {name: table[name].to_pylist()[0] for name in FIGURES} == expected
    with BagReader(ros.folder / "bag") as reader:
        flown = step_reader.scenario(reader, "")
        assert flown == scenario
        steps = step_reader.Steps(reader, "", flown.step_ns)
        (mission,) = read_missions(steps, flown, False)
    assert {name: mission.summary()[name] for name in FIGURES} == expected
    assert mission.summary()["reward"] == summary["reward"]
