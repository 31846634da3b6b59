"""Trainings whose replay starts with recorded flights."""

import shutil

import msgspec
import numpy as np
import pytest
import torch

from tests.experiments.test_train_cli import TINY as TINY_TOML
from tests.recordings.made import about, flight, write
from tests.support.worlds import population, run, tiny
from uav_dc_ros import scenarios
from uav_dc_ros.agents import policy
from uav_dc_ros.env.gym_env import DataCollectionEnv
from uav_dc_ros.errors import BagError, TrainingError
from uav_dc_ros.experiments.train.cli import main
from uav_dc_ros.experiments.train.replay_from_bags import prefill_replay
from uav_dc_ros.experiments.train.training import Training

pytestmark = pytest.mark.usefixtures("one_thread")

TINY = tiny()
STEPS = TINY.mission.max_steps
CPU = torch.device("cpu")


def act(mission, step):
    return [1, 2, 2, 1, 3, 6, 0][(mission + step) % 7]


def recorded(folder, scenario=TINY, missions=3, seed=0, **values):
    messages = flight(scenario, act=act, missions=missions, seed=seed)
    return write(folder, messages, about(scenario, seed), **values)


def rows(training):
    """What each run's replay buffer holds, `[N, T, 2 D + 3]`: s, s', a, r, terminated."""
    return training.state()[0]["buffer.rows"].numpy()


def in_environment(scenario, seeds, observation):
    """The same transitions, from the Gymnasium environment, as rows of the buffer."""
    env, made = DataCollectionEnv(scenario, observation), []
    for mission, seed in enumerate(seeds):
        seen, _ = env.reset(seed=seed)
        for step in range(STEPS):
            after, reward, terminated, _, _ = env.step(act(mission, step))
            numbers = np.float32([act(mission, step), reward, terminated])
            made.append(np.concatenate([seen, after, numbers]))
            seen = after
    return np.stack(made)


@pytest.mark.parametrize("observation", ["position", "mission", "map"])
@pytest.mark.parametrize("form", ["immediate", "episode"])
@pytest.mark.parametrize("data", ["step", "so_far"])
def test_the_buffer_holds_what_the_environment_gives(tmp_path, observation, form, data):
    """Bit for bit, in every run, with the reward of the training, not that of the recorded scenario."""
    bags = [recorded(tmp_path / "a"), recorded(tmp_path / "b", seed=20, missions=2, namespace="/uav2")]
    paid = {"form": form, "beta": 3.0, "zeta": 0.5, "r_plus": "binary", "data": data}
    runs = [run(TINY, seed, **paid) for seed in (0, 1)]
    training = Training(population(TINY, *runs, observation=observation), CPU)
    found = prefill_replay(training, bags)
    assert (found.missions, found.transitions, found.held) == (5, 5 * STEPS, 5 * STEPS)
    world = tiny(reward=paid)
    expected = [in_environment(world, range(s, s + n), observation) for s, n in ((0, 3), (20, 2))]
    held = rows(training)
    assert held.shape[0] == 2
    for one in held:
        assert one.tobytes() == np.concatenate(expected).tobytes()


def test_a_buffer_that_is_too_small_keeps_the_latest(tmp_path):
    training = Training(population(TINY, run(TINY, buffer_size=10)), CPU)
    found = prefill_replay(training, [recorded(tmp_path / "a")])
    assert (found.transitions, found.held) == (24, 10)
    assert str(found) == "24 transitions of 3 recorded missions (a), of which the latest 10 fit into it"
    expected = in_environment(TINY, range(3), "mission")[-10:]
    assert sorted(map(bytes, rows(training)[0])) == sorted(map(bytes, expected))


def test_it_learns_from_them_and_equal_commands_learn_the_same(tmp_path):
    bag = recorded(tmp_path / "a")

    def learnt(bags):
        training = Training(population(TINY, run(TINY, 3)), CPU)
        if bags:
            prefill_replay(training, bags)
        training.fly_episode()
        return training.learner.state()["theta"].numpy().tobytes()

    assert learnt([bag]) == learnt([bag])
    assert learnt([bag]) != learnt([])


def test_flights_in_another_world_are_refused(tmp_path):
    other = recorded(tmp_path / "a", tiny(users={"v_max_mps": 2.0}))
    training = Training(population(TINY, run(TINY)), CPU)
    with pytest.raises(TrainingError, match=r"mission 0, step 0 is flown in 'tiny' \(\w{12}\); expected the"):
        prefill_replay(training, [other])
    with pytest.raises(BagError, match="no such folder"):
        prefill_replay(training, [tmp_path / "nowhere"])
    moves = [message for message in flight(TINY) if message.topic == "/move"]
    with pytest.raises(TrainingError, match="holds no transition; expected missions"):
        prefill_replay(training, [write(tmp_path / "moves", moves)])


def test_runs_with_different_rewards_are_refused(tmp_path):
    training = Training(population(TINY, run(TINY), run(TINY, 1, beta=2.0)), CPU)
    with pytest.raises(TrainingError, match="have 2 rewards; expected one"):
        prefill_replay(training, [recorded(tmp_path / "a")])


@pytest.fixture
def train(tmp_path, capsys):
    """The command in a small field, with more options: exit status and output."""
    (tmp_path / "tiny.toml").write_text(TINY_TOML)

    def command(out, *options):
        given = ["--scenario", tmp_path / "tiny.toml", "--algo", "dueling_dqn", "--out", tmp_path / out]
        given += ["--episodes", 4, "--checkpoint-every", 2, "--hidden", 8, "--runs", 2, *options]
        with pytest.raises(SystemExit) as exit:
            main([str(one) for one in given])
        out, err = capsys.readouterr()
        return exit.value.code, out + err

    return command


def test_from_bags_to_a_policy(tmp_path, train):
    field = scenarios.load(write_toml(tmp_path))
    bags = [recorded(tmp_path / "a", field), recorded(tmp_path / "b", field, seed=9)]
    status, out = train("made", "--from-bags", *bags)
    assert status == 0, out
    assert "replay starts with 48 transitions of 6 recorded missions (a, b)" in out
    card = (tmp_path / "made" / policy.CARD).read_text()
    assert "- the replay buffer began with 48 transitions of 6 recorded missions (a, b)\n" in card
    assert f"--from-bags {bags[0]} {bags[1]}" in card
    assert train("again", "--from-bags", *bags)[0] == 0
    assert train("alone")[0] == 0
    models = [(tmp_path / name / policy.MODEL).read_bytes() for name in ("made", "again", "alone")]
    assert models[0] == models[1] != models[2]
    assert "replay buffer began" not in (tmp_path / "alone" / policy.CARD).read_text()


def write_toml(folder):
    path = folder / "tiny.toml"
    path.write_text(TINY_TOML)
    return path


def test_resume_keeps_the_prefilled_replay(tmp_path, train, monkeypatch):
    """The buffer is in the checkpoint: bags are not read again, and may be gone."""
    field = scenarios.load(write_toml(tmp_path))
    bag = recorded(tmp_path / "a", field)
    assert train("whole", "--from-bags", bag)[0] == 0

    flown = Training.fly_episode

    def stop_after_three(training):
        if training.n_flown == 3:
            raise KeyboardInterrupt
        flown(training)

    monkeypatch.setattr(Training, "fly_episode", stop_after_three)
    status, out = train("made", "--from-bags", bag)
    assert status == 130
    assert "--resume continues" in out
    monkeypatch.undo()
    status, out = train("made", "--resume")
    assert status == 2
    assert f"is the state of a training with from_bags = ['{bag}']; expected None, as in this command" in out
    shutil.rmtree(bag)
    status, out = train("made", "--from-bags", bag, "--resume")
    assert status == 0, out
    assert "replay starts" not in out
    models = [(tmp_path / name / policy.MODEL).read_bytes() for name in ("made", "whole")]
    assert models[0] == models[1]
    assert (
        "began with 24 transitions of 3 recorded missions (a)"
        in (tmp_path / "made" / policy.CARD).read_text()
    )


def test_a_mistake_is_one_line_and_leaves_nothing_in_the_way(tmp_path, train):
    recorded(tmp_path / "a", TINY)
    other = msgspec.structs.replace(TINY.users, v_max_mps=3.0)
    bag = recorded(tmp_path / "b", msgspec.structs.replace(TINY, users=other))
    for given, complaint in (
        (bag, "expected the training's 'tiny'"),
        (tmp_path / "c", "no such folder or file"),
    ):
        status, out = train("made", "--from-bags", given)
        assert (status, len(out.splitlines())) == (2, 1), out
        assert complaint in out
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b", "tiny.toml"]
