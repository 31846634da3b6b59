"""`python -m uav_dc_ros.train`, as a user runs it."""

import itertools
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import PATIENCE_S, until
from tests.experiments.forks import Forks
from tests.support.worlds import tiny
from uav_dc_ros.agents import policy
from uav_dc_ros.experiments.evaluate.evaluation import evaluate, rows
from uav_dc_ros.experiments.train.cli import _saved_progress as saved_progress
from uav_dc_ros.experiments.train.cli import main

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


PICTURES = [policy.LEARNING_CURVE, policy.TRAJECTORY]


# A command that runs in this process sets torch up for training, for the tests after it too.
pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture
def field(tmp_path):
    path = tmp_path / "tiny.toml"
    path.write_text(TINY)
    return path


def refused(capsys, *arguments):
    """The one line with which a command is refused, with status 2."""
    with pytest.raises(SystemExit) as exit:
        main([str(argument) for argument in arguments])
    err = capsys.readouterr().err
    assert exit.value.code == 2, err
    assert len(err.splitlines()) == 1, err
    return err


def command(*arguments):
    done = subprocess.run(
        [sys.executable, "-m", "uav_dc_ros.train", *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        timeout=PATIENCE_S,
        env=os.environ | {"COLUMNS": "200"},
    )
    return done.returncode, done.stdout, done.stderr


@pytest.fixture(scope="module")
def forks(tmp_path_factory):
    """Starts trainings in processes of their own, and imports torch for all of them once."""
    forks = Forks(tmp_path_factory.mktemp("outputs"))
    yield forks
    forks.close()


def test_from_a_scenario_file_to_a_policy_that_flies(tmp_path, field, forks):
    """In a process of its own the command is run by tests/test_examples.py."""
    out = tmp_path / "made"
    arguments = ["--scenario", field, "--algo", "dueling_dqn", "--out", out, "--observation", "map"]
    arguments += ["--episodes", 6, "--runs", 2, "--seed", 5, "--checkpoint-every", 3, "--hidden", 12, 10]
    arguments += ["--batch-size", 16, "--gamma", 0.8, "--beta", 3, "--reward-form", "immediate"]
    arguments += ["--reward-data", "step", "--data-scale-bits", 4e5]
    arguments += ["--tensorboard", tmp_path / "scalars"]
    child = forks.start([str(argument) for argument in arguments])
    assert child.wait() == 0, child.output
    assert "brought home in validation" in child.output
    progress = [line.split()[1] for line in child.output.splitlines() if line.startswith("episode ")]
    assert progress == ["3", "6"], "plain lines off a terminal"
    left = sorted(path.name for path in tmp_path.iterdir())
    assert left == ["made", "scalars", "tiny.toml"], "no checkpoint is left"
    assert sorted(path.name for path in (tmp_path / "scalars" / "made").iterdir()) == ["seed_5", "seed_6"]
    files = sorted(path.name for path in out.iterdir())
    assert files == sorted([policy.CONFIG, policy.MODEL, policy.CARD, *PICTURES])
    assert all((out / name).read_bytes().startswith(b"\x89PNG") for name in PICTURES)

    made = policy.load(out)
    assert made.config.hidden == (12, 10)
    assert made.config.observation == "map"
    assert (made.config.hyperparameters.gamma, made.config.hyperparameters.batch_size) == (0.8, 16)
    assert made.config.seed in (5, 6)
    assert (made.scenario.reward.beta, made.scenario.reward.form) == (3.0, "immediate")
    assert (made.scenario.reward.data, made.scenario.reward.data_scale_bits) == ("step", 4e5)
    card = (out / policy.CARD).read_text()
    assert f"python -m uav_dc_ros.train --scenario {field} --algo dueling_dqn --out {out}" in card
    # The card judges by the scenario as it is in the file.
    assert "as it is shipped: beta 1, zeta 1, exponential R_plus, episode form, data so far" in card
    assert "learnt from: beta 3, zeta 1, exponential R_plus, immediate form, data of the step" in card
    for row in rows(evaluate(made, tiny())):
        assert f"| {' | '.join(row)} |" in card


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--scenario", "nowhere"], "'nowhere': no such name or file; expected one of farm, five_clusters,"),
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
        (["--data-scale-bits", "0"], "reward.data_scale_bits = 0.0; expected float > 0"),
        (["--reward-data", "mean"], "'mean'"),
        (["--device", "abacus"], "--device is 'abacus'"),
        (["--learning-rate", "inf"], "--learning-rate is inf; expected float <= 1"),
        (
            ["--out", "a policy"],
            "--out a policy: 'a policy' is no name of a policy; expected at most 64 letters",
        ),
        (["--out", "x/größe"], "--out x/größe: 'größe' is no name of a policy; expected at most 64 letters"),
        (["--out", "/proc/made"], "/proc/made.checkpoints cannot be made"),
        (["--overwrite"], "--overwrite"),
        (["--tensorboard", "/proc/made"], "--tensorboard /proc/made cannot be written"),
        (["--buffer-size", str(2**50)], "the training cannot be set up"),
        (["--episodes", str(2**50)], "the training cannot be set up"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_mistake_is_one_line_and_status_2(tmp_path, field, capsys, arguments, complaint):
    options = {"--scenario": field, "--algo": "dqn", "--out": tmp_path / "made", "--episodes": 1}
    assert complaint in refused(capsys, *itertools.chain(*options.items()), *arguments)
    assert list(tmp_path.iterdir()) == [field], "nothing is in the way of the next command"


def test_a_mistake_ends_a_whole_process_alike(tmp_path, field):
    status, out, err = command(
        "--scenario", field, "--algo", "dqn", "--out", tmp_path / "made", "--batch-size", 0
    )
    assert (status, out) == (2, "")
    assert "--batch-size is 0" in err
    assert len(err.splitlines()) == 1, err


@pytest.mark.parametrize("existing", ["made", "made.checkpoints"])
def test_an_existing_folder_is_refused_before_training(tmp_path, field, existing, capsys):
    (tmp_path / existing).mkdir()
    err = refused(capsys, "--scenario", field, "--algo", "dqn", "--out", tmp_path / "made")
    assert f"{existing}' exists; expected a new folder" in err
    assert (tmp_path / existing).is_dir()


def test_without_torch_there_is_one_line_that_helps(tmp_path, field):
    code = (
        "import sys; sys.modules['torch'] = None\n"
        "from uav_dc_ros.experiments.train.cli import main\n"
        f"main(['--scenario', {str(field)!r}, '--algo', 'dqn', '--out', {str(tmp_path / 'made')!r}])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert 'pip install "uav_dc_ros[train]"' in done.stderr


def test_ctrl_c_keeps_the_best_checkpoint(tmp_path, field, forks):
    arguments = ["--scenario", field, "--algo", "dqn", "--out", tmp_path / "made", "--episodes", 100_000]
    child = forks.start([str(argument) for argument in [*arguments, "--checkpoint-every", 2]])
    until(lambda: child.output.count("\n") >= 2)  # the first checkpoint may still be being written
    os.kill(child.process_id, signal.SIGINT)
    assert child.wait() == 130, child.output
    err = child.output
    last = err.splitlines()[-1]
    assert "stopped; the best policy until now is" in last
    folder, _, hint = last.rpartition(" is ")[-1].partition("; ")
    assert hint == "--resume continues"
    assert policy.load(folder).config.episode >= 2
    assert not (tmp_path / "made").exists()


def test_ctrl_c_before_the_first_checkpoint_leaves_nothing(tmp_path, field, capsys, monkeypatch):
    def interrupted(training):
        raise KeyboardInterrupt

    monkeypatch.setattr("uav_dc_ros.experiments.train.training.Training.fly_episode", interrupted)
    with pytest.raises(SystemExit) as exit:
        main(["--scenario", str(field), "--algo", "dqn", "--out", str(tmp_path / "made")])
    assert exit.value.code == 130
    assert capsys.readouterr().err.endswith("stopped; there is no checkpoint yet\n")
    assert list(tmp_path.iterdir()) == [field]


# A command that learns: its best policy is not that of its first checkpoint.
LEARNS = {
    "--algo": "dueling_dqn", "--seed": 4, "--runs": 2, "--episodes": 30, "--checkpoint-every": 10,
    "--hidden": 16, "--beta": 4, "--zeta": 4, "--reward-form": "immediate", "--target-every": 50,
    "--epsilon": 0.7, "--learning-rate": 0.003, "--buffer-size": 200,
}  # fmt: skip
# What is called, which of its calls a kill comes to, whether before or after it, and the checkpoints that
# are still to come when the training goes on.
MOMENTS = {
    "never": (None, [10, 20, 30]),
    "before the first state": (("os.fsync", 1, "before"), [10, 20, 30]),
    "before a state takes its name": (("pathlib.Path.replace", 4, "before"), [20, 30]),  # policy, state
    "in the midst of writing a best policy": (("uav_dc_ros.agents.policy.load", 2, "before"), [20, 30]),
    "between a best policy and its state": (
        ("uav_dc_ros.experiments.train.cli._save_best", 2, "after"),
        [20, 30],
    ),
    "between two checkpoints": (
        ("uav_dc_ros.experiments.train.training.Training.fly_episode", 23, "after"),
        [30],
    ),
    "in the midst of writing the result": (("uav_dc_ros.experiments.train.cli._draw", 1, "before"), []),
}


def learns(folder, **others):
    """Arguments of the command, with its result in a folder."""
    values = {"--scenario": folder.parent / "tiny.toml", "--out": folder / "made"} | LEARNS | others
    return [str(part) for pair in values.items() for part in pair]


FEW = ("between a best policy and its state",)
OTHERS = [pytest.param(name, marks=pytest.mark.long) for name in list(MOMENTS)[1:] if name not in FEW]


@pytest.fixture(scope="module")
def killed(tmp_path_factory, request, forks):
    """A folder for each moment: `killed` as a kill left it, `made` as `--resume` then ended."""
    root = tmp_path_factory.mktemp("killed")
    (root / "tiny.toml").write_text(TINY)
    selected = {
        item.callspec.params.get("moment") for item in request.session.items if hasattr(item, "callspec")
    }
    moments = {name: MOMENTS[name] for name in MOMENTS if name == "never" or name in selected}
    for moment, (kill, checkpoints) in moments.items():
        (root / moment).mkdir()
        arguments = learns(root / moment, **{"--tensorboard": root / moment / "scalars"})
        if kill:
            child = forks.start(arguments, kill)
            assert child.wait() == -signal.SIGKILL, child.output
        child = forks.start([*arguments, "--resume"])
        assert child.wait() == 0, child.output
        lines = [line.split() for line in child.output.splitlines()]
        assert [int(words[1]) for words in lines if words[0] == "episode"] == checkpoints, child.output
    (root / "left").mkdir()
    child = forks.start(learns(root / "left"), MOMENTS["between two checkpoints"][0])
    assert child.wait() == -signal.SIGKILL, child.output
    return root


def result(folder):
    """Every file of a policy but its card, which has the time and the command."""
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.name != policy.CARD}


@pytest.mark.parametrize("moment", [*FEW, *OTHERS])
def test_a_killed_training_goes_on_to_the_same_result(killed, moment):
    expected = result(killed / "never" / "made")
    assert sorted(expected) == sorted([policy.CONFIG, policy.MODEL, *PICTURES])
    found = result(killed / moment / "made")
    for name, content in expected.items():
        assert found[name] == content, name
    assert not (killed / moment / "made.checkpoints").exists()
    assert policy.load(killed / moment / "made").config.episode > 10, "the best came late enough to matter"


@pytest.mark.parametrize("moment", [*FEW, *OTHERS])
def test_its_scalars_are_those_of_a_training_never_interrupted(killed, moment):
    for seed in (4, 5):
        expected = scalars(killed / "never" / "scalars" / "made" / f"seed_{seed}")
        assert [step for step, _ in expected["training/reward"]] == list(range(1, 31))
        assert [step for step, _ in expected["validation/users_brought_home"]] == [10, 20, 30]
        assert scalars(killed / moment / "scalars" / "made" / f"seed_{seed}") == expected


def scalars(folder):
    """Step and value of every scalar, by TensorBoard's own reader."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    read = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    read.Reload()
    return {tag: [(event.step, event.value) for event in read.Scalars(tag)] for tag in read.Tags()["scalars"]}


def test_a_process_killed_from_outside_goes_on_to_the_same_result(killed, tmp_path, forks):
    (tmp_path / "tiny.toml").write_text(TINY)
    arguments = learns(tmp_path / "run")
    state = tmp_path / "run" / "made.checkpoints" / "training.safetensors"
    child = forks.start(arguments)
    until(state.exists)
    os.kill(child.process_id, signal.SIGKILL)
    assert child.wait() == -signal.SIGKILL, child.output
    assert state.exists()
    child = forks.start([*arguments, "--resume"])
    assert child.wait() == 0, child.output
    err = child.output
    assert "episode 10 " not in err, "the first ten episodes are not flown again"
    assert "episode 30 " in err
    assert result(tmp_path / "run" / "made") == result(killed / "never" / "made")


@pytest.fixture
def left(killed, tmp_path):
    """What a kill between two checkpoints left, and the field beside it."""
    (tmp_path / "tiny.toml").write_text(TINY)
    return Path(shutil.copytree(killed / "left", tmp_path / "left"))


def test_what_a_kill_leaves_is_whole(left):
    folder = left / "made.checkpoints"
    names = sorted(path.name for path in folder.iterdir())
    assert names == ["episode_000010", "episode_000020", "training.safetensors"]
    best = policy.load(folder / names[1])
    assert best.config.episode == 20
    assert "checkpoint" in (folder / names[1] / policy.CARD).read_text()
    assert not (left / "made").exists()


@pytest.mark.parametrize(
    ("others", "complaint"),
    [
        ({"--gamma": 0.5}, "runs[0].hyperparameters.gamma = 0.9; expected 0.5, as in this command"),
        ({"--seed": 5}, "runs[0].seed = 4; expected 5, as in this command"),
        ({"--runs": 3}, "the number of runs = 2; expected 3, as in this command"),
        ({"--beta": 3}, "reward.beta = 4.0; expected 3.0, as in this command"),
        ({"--hidden": 17}, "hidden[0] = 16; expected 17, as in this command"),
        ({"--algo": "dqn"}, "runs[0].algorithm = 'dueling_dqn'; expected 'dqn', as in this command"),
        ({"--episodes": 50}, "hyperparameters.episodes = 30; expected 50, as in this command"),
        ({"--scenario": "three_clusters_hover"}, "scenario"),
        ({"--checkpoint-every": 7}, "checkpoint_every = 10; expected 7, as in this command"),
    ],
    ids=str,
)
def test_the_state_of_another_command_is_refused(left, capsys, others, complaint):
    before = sorted(left.rglob("*"))
    err = refused(capsys, *learns(left, **others), "--resume")
    assert "training.safetensors is the state of a training with" in err
    assert complaint in err
    assert sorted(left.rglob("*")) == before, "nothing is lost by a mistake"


@pytest.mark.parametrize("size", [0, 7, 1000, -1])
def test_a_damaged_state_is_refused(left, capsys, size):
    state = left / "made.checkpoints" / "training.safetensors"
    state.write_bytes(state.read_bytes()[:size])
    err = refused(capsys, *learns(left), "--resume")
    assert "training.safetensors: cannot be read, or not the state of a training" in err


@pytest.mark.parametrize(
    ("values", "expected"), [({"merit": None}, None), ({"merit": 0.835}, 0.85), ({"objective": 0.85}, 0.85)]
)
def test_a_checkpoint_of_version_0_2_0_has_the_score_as_merit(values, expected):
    """Which is 1.1 J - 0.1."""
    assert saved_progress({"every": 10, **values}).selection_score == pytest.approx(expected)


def test_a_foreign_file_is_refused(left, capsys):
    folder = left / "made.checkpoints"
    shutil.copy(folder / "episode_000010" / policy.MODEL, folder / "training.safetensors")
    assert "not the state of a training" in refused(capsys, *learns(left), "--resume")


def test_a_missing_best_policy_is_an_error_at_once(left, capsys):
    shutil.rmtree(left / "made.checkpoints" / "episode_000020")
    assert "episode_000020" in refused(capsys, *learns(left), "--resume")


def test_without_resume_what_is_there_is_refused(left, capsys):
    assert "made.checkpoints' exists" in refused(capsys, *learns(left))


def test_a_result_that_is_there_is_refused_also_to_resume(left, capsys):
    (left / "made").mkdir()
    assert "made' exists; expected a new folder" in refused(capsys, *learns(left), "--resume")


@pytest.mark.parametrize("there", [False, True], ids=["no folder", "an empty folder"])
def test_resume_without_a_checkpoint_starts(tmp_path, field, there):
    if there:
        (tmp_path / "made.checkpoints").mkdir()
    arguments = [
        "--scenario",
        field,
        "--algo",
        "dqn",
        "--out",
        tmp_path / "made",
        "--episodes",
        2,
        "--resume",
    ]
    with pytest.raises(SystemExit) as exit:
        main([str(argument) for argument in arguments])
    assert exit.value.code == 0
    assert policy.load(tmp_path / "made").config.hyperparameters.episodes == 2
