"""`python -m uav_dc_ros.train`, as a user runs it."""

import os
import signal
import subprocess
import sys

import pytest

from tests.small_worlds import tiny
from uav_dc_ros.agents import policy
from uav_dc_ros.experiments.evaluate import evaluate, rows
from uav_dc_ros.experiments.train_cli import main

TINY = """
name = "tiny"
[grid]
n_x = 3
n_y = 3
n_z = 1
cell_m = 100.0
altitude_min_m = 100.0
altitude_step_m = 50.0
[users]
cluster_centres_m = [[100.0, 0.0]]
users_per_cluster = 4
cluster_radius_m = 120.0
v_max_mps = 1.0
[mission]
start_m = [0.0, 0.0, 100.0]
dock_m = [200.0, 200.0]
step_s = 15.0
max_steps = 8
d_cons_m = 250.0
r_min_bits = 6e6
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
r_plus = "exponential"
form = "episode"
data_scale_bits = 6e6
"""


@pytest.fixture
def field(tmp_path):
    path = tmp_path / "tiny.toml"
    path.write_text(TINY)
    return path


def start(*arguments):
    return subprocess.Popen(
        [sys.executable, "-m", "uav_dc_ros.train", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"COLUMNS": "200"},
    )


def command(*arguments):
    process = start(*arguments)
    out, err = process.communicate(timeout=100)
    return process.returncode, out, err


def test_from_a_scenario_file_to_a_policy_that_flies(tmp_path, field):
    out = tmp_path / "made"
    arguments = ["--scenario", field, "--algo", "dueling_dqn", "--out", out, "--observation", "map"]
    arguments += ["--episodes", 6, "--runs", 2, "--seed", 5, "--checkpoint-every", 3, "--hidden", 12, 10]
    arguments += ["--batch-size", 16, "--gamma", 0.8, "--beta", 3, "--reward-form", "immediate"]
    status, printed, progress = command(*arguments)
    assert status == 0, progress
    assert "brought home in validation" in printed
    assert [line.split()[1] for line in progress.splitlines()] == ["3", "6"], "plain lines off a terminal"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["made", "tiny.toml"], "no checkpoint is left"

    made = policy.load(out)
    assert made.config.hidden == (12, 10)
    assert made.config.observation == "map"
    assert (made.config.hyperparameters.gamma, made.config.hyperparameters.batch_size) == (0.8, 16)
    assert made.config.seed in (5, 6)
    assert (made.scenario.reward.beta, made.scenario.reward.form) == (3.0, "immediate")
    card = (out / policy.CARD).read_text()
    assert f"python -m uav_dc_ros.train --scenario {field} --algo dueling_dqn --out {out}" in card
    # The card judges by the scenario as it is in the file.
    assert "as it is shipped: beta 1, zeta 1, exponential R_plus, episode form" in card
    for row in rows(evaluate(made, tiny())):
        assert f"| {' | '.join(row)} |" in card


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--scenario", "nowhere"], "'nowhere': no such name or file; expected one of five_clusters"),
        (["--algo", "sarsa"], "'sarsa'"),
        (["--observation", "radar"], "'radar'"),
        (["--gamma", "1.5"], "--gamma is 1.5; expected float <= 1"),
        (["--gamma", "nan"], "--gamma is nan"),
        (["--gamma", "high"], "'high'"),
        (["--epsilon", "-0.1"], "--epsilon is -0.1; expected float >= 0"),
        (["--batch-size", "0"], "--batch-size is 0; expected int >= 1"),
        (["--learning-rate", "0"], "--learning-rate is 0.0; expected float > 0"),
        (["--hidden", "64", "5000"], "--hidden is [64, 5000]; expected int <= 4096"),
        (["--seed", "-1"], "--seed is -1; expected int >= 0"),
        (["--runs", "0"], "'0'; expected a whole number of at least 1"),
        (["--beta", "-1"], "reward.beta = -1.0; expected float >= 0"),
        (["--device", "abacus"], "--device is 'abacus'"),
        (["--learning-rate", "inf"], "--learning-rate is inf; expected float <= 1"),
        (["--out", "a policy"], "--out is 'a policy'; expected str matching"),
        (["--out", "/proc/made"], "/proc/made.checkpoints cannot be made"),
        (["--overwrite"], "--overwrite"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_mistake_is_one_line_and_status_2(tmp_path, field, capsys, arguments, complaint):
    options = {"--scenario": field, "--algo": "dqn", "--out": tmp_path / "made", "--episodes": 1}
    with pytest.raises(SystemExit) as exit:
        main([str(part) for pair in options.items() for part in pair] + arguments)
    assert exit.value.code == 2
    err = capsys.readouterr().err
    assert complaint in err
    assert len(err.splitlines()) == 1, err
    assert not (tmp_path / "made").exists()


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [(["--scenario", "nowhere"], "'nowhere'"), (["--batch-size", "0"], "--batch-size is 0")],
    ids=["scenario", "value"],
)
def test_so_it_is_for_a_whole_process(tmp_path, field, arguments, complaint):
    status, out, err = command("--scenario", field, "--algo", "dqn", "--out", tmp_path / "made", *arguments)
    assert (status, out) == (2, "")
    assert complaint in err
    assert len(err.splitlines()) == 1, err


@pytest.mark.parametrize("existing", ["made", "made.checkpoints"])
def test_an_existing_folder_is_refused_before_training(tmp_path, field, existing):
    (tmp_path / existing).mkdir()
    status, _, err = command("--scenario", field, "--algo", "dqn", "--out", tmp_path / "made")
    assert status == 2
    assert f"{existing}' exists; expected a new folder" in err
    assert len(err.splitlines()) == 1


def test_without_torch_there_is_one_line_that_helps(tmp_path, field):
    code = (
        "import sys; sys.modules['torch'] = None\n"
        "from uav_dc_ros.experiments.train_cli import main\n"
        f"main(['--scenario', {str(field)!r}, '--algo', 'dqn', '--out', {str(tmp_path / 'made')!r}])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert 'pip install "uav_dc_ros[train]"' in done.stderr


def test_ctrl_c_keeps_the_best_checkpoint(tmp_path, field):
    process = start(
        "--scenario", field, "--algo", "dqn", "--out", tmp_path / "made", "--episodes", 100_000,
        "--checkpoint-every", 2,
    )  # fmt: skip
    process.stderr.readline()  # the first checkpoint may still be being written
    process.stderr.readline()
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    last = err.splitlines()[-1]
    assert "stopped; the best policy until now is" in last
    folder = last.rsplit(maxsplit=1)[-1]
    assert policy.load(folder).config.episode >= 2
    assert not (tmp_path / "made").exists()
