"""The state of a training on disk: what goes on from it is as if it had never been interrupted."""

import json
import os
import re

import msgspec
import numpy as np
import pytest
import safetensors.torch
import torch

from tests.support.worlds import population, run, tiny
from uav_dc_ros.core.propagation.stochastic import WAVES
from uav_dc_ros.core.scenario import from_values
from uav_dc_ros.errors import TrainingError
from uav_dc_ros.experiments.train import checkpoint
from uav_dc_ros.experiments.train.training import Training

CPU = torch.device("cpu")
# 2.5 episodes fill the buffer; a target network is copied in the midst of the second, fourth and fifth.
LEARNING = {"episodes": 5, "buffer_size": 20, "target_every": 11}


def made(end="at_time_limit", **values):
    scenario = tiny(mission={"episode_end": end, "start_m": [100.0, 100.0, 100.0]})
    return population(
        scenario,
        run(scenario, 1, algorithm="dqn", learning_rate=1e-2, epsilon=0.5, **LEARNING),
        run(scenario, 2**40, environment=4, batch_size=3, form="immediate", **LEARNING),
        run(scenario, 3, aggregation="max", batch_size=16, epsilon=0.2, data="step", **LEARNING),
        **values,
    )


def fly(training, n):
    for _ in range(n):
        training.fly_episode()
    return training


pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture
def path(tmp_path):
    return tmp_path / "training.safetensors"


@pytest.mark.parametrize(
    ("end", "worlds_in"),
    [pytest.param("at_time_limit", "torch", marks=pytest.mark.long), ("on_arrival", "numpy")],
)
def test_what_goes_on_ends_as_what_was_never_interrupted(path, end, worlds_in):
    """To the last bit, in everything there is, wherever it was interrupted, more than once too."""
    never = fly(Training(made(end), CPU, worlds_in), 5)
    expected, values = never.state()
    for stops in ([0], [1], [2], [3], [4], [5], [1, 2, 4]):
        training = Training(made(end), CPU, worlds_in)
        for stop in stops:
            fly(training, stop - training.n_flown)
            checkpoint.save(path, training, {"stop": stop})
            fly(training, min(1, 5 - stop))  # what comes after a checkpoint is lost, and does not reach it
            training = Training(made(end), CPU, worlds_in)
            assert checkpoint.restore(path, training) == {"stop": stop}
            assert training.n_flown == stop
        fly(training, 5 - training.n_flown)
        found, found_values = training.state()
        assert found_values == values
        assert found.keys() == expected.keys()
        for name, array in expected.items():
            assert found[name].dtype == array.dtype
            assert torch.equal(found[name], array), (stops, name)
        for name, curve in never.curves.items():
            np.testing.assert_array_equal(training.curves[name], curve)


def test_each_run_s_shadowing_is_in_the_checkpoint(path):
    """On arrival a mission goes on in the next episode, over its own field."""
    values = msgspec.to_builtins(made("on_arrival").scenario)
    values["radio"] |= {
        "shadowing": {"sigma_db": 6.0, "correlation_m": 50.0},
        "fading": {"model": "rayleigh"},
    }
    shaded = msgspec.structs.replace(made("on_arrival"), scenario=from_values(values, "test"))
    never = fly(Training(shaded, CPU), 3)
    checkpoint.save(path, fly(Training(shaded, CPU), 1), {})
    again = Training(shaded, CPU)
    checkpoint.restore(path, again)
    expected, found = never.state()[0], fly(again, 2).state()[0]
    assert all(torch.equal(found[name], array) for name, array in expected.items())
    waves = found["world.waves"]
    assert waves.shape == (3, 6, WAVES)
    assert len({one.numpy().tobytes() for one in waves}) == 3


@pytest.mark.parametrize("worlds_in", ["numpy", "torch"])
def test_a_checkpoint_of_version_0_1_0_goes_on(path, worlds_in):
    """It has no reading of the data: it is that so far. Then r^t is the reward of a mission in its midst."""
    population = made("on_arrival")
    runs = tuple(
        msgspec.structs.replace(one, reward=msgspec.structs.replace(one.reward, data="so_far"))
        for one in population.runs
    )
    population = msgspec.structs.replace(population, runs=runs)
    never = fly(Training(population, CPU, worlds_in), 5)
    training = fly(Training(population, CPU, worlds_in), 2)
    old = msgspec.to_builtins(population)
    for reward in (old["scenario"]["reward"], *(one["reward"] for one in old["runs"])):
        assert reward.pop("data") == "so_far"
    assert old["scenario"]["radio"].pop("model") == "free_space"
    checkpoint.save(path, training, {})
    edit(path, {"population": old}, {"world.mission_reward": None})
    again = Training(population, CPU, worlds_in)
    checkpoint.restore(path, again)
    fly(again, 3)
    for name, curve in never.curves.items():
        np.testing.assert_array_equal(again.curves[name], curve, err_msg=name)
    # Of this version's other reading it is no checkpoint.
    other = Training(made("on_arrival"), CPU, worlds_in)
    with pytest.raises(TrainingError, match=r"runs\[2\]\.reward\.data = 'so_far'; expected 'step'"):
        checkpoint.restore(path, other)


def test_on_arrival_a_mission_goes_on_in_the_midst(path):
    """The case above would be weaker if every mission had ended with its episode."""
    training = Training(made("on_arrival"), CPU)
    under_way = []
    for _ in range(4):
        state, _ = fly(training, 1).state()
        under_way.append(state["world.step"].max() > 0 and state["books.rate_bps"].max() > 0)
    assert any(under_way)


def test_it_takes_the_place_of_an_older_one(path):
    training = fly(Training(made(), CPU), 1)
    checkpoint.save(path, training, {"best": "a"})
    fly(training, 1)
    checkpoint.save(path, training, {"best": None, "score": 0.1 + 0.2})
    assert [file.name for file in path.parent.iterdir()] == [path.name]
    again = Training(made(), CPU)
    assert checkpoint.restore(path, again) == {"best": None, "score": 0.1 + 0.2}
    assert again.n_flown == 2


def refused(path, population=None):
    """The one line with which a state is refused."""
    with pytest.raises(TrainingError) as error:
        checkpoint.restore(path, Training(population or made(), CPU))
    assert "\n" not in str(error.value)
    assert str(path) in str(error.value)
    assert len(str(error.value)) < 400
    return str(error.value)


def test_a_file_cut_short_anywhere_is_refused(path):
    checkpoint.save(path, fly(Training(made(), CPU), 1), {})
    whole = path.read_bytes()
    header = 8 + int.from_bytes(whole[:8], "little")
    for n in [0, 1, 7, 8, 9, header // 2, header - 1, header, header + 1, len(whole) // 2, len(whole) - 1]:
        path.write_bytes(whole[:n])
        assert "cannot be read, or not the state of a training" in refused(path), n


def test_what_is_no_state_is_refused(path, tmp_path):
    assert "cannot be read" in refused(tmp_path / "nothing")
    tensors = {"a": torch.zeros(3)}
    for metadata in (None, {"training": "[]"}, {"training": "{"}, {"training": "3"}, {"training": "{}"}):
        path.write_bytes(safetensors.torch.save(tensors, metadata))
        assert "not the state of a training" in refused(path), metadata
    for content in (b"hello", b"\xff" * 100):
        path.write_bytes(content)
        assert "not the state of a training" in refused(path)


def edit(path, values=None, arrays=None):
    """Replaces entries of the metadata, and tensors; None takes one away."""
    content = path.read_bytes()
    header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
    metadata = json.loads(header["__metadata__"]["training"]) | (values or {})
    tensors = safetensors.torch.load(content) | (arrays or {})
    kept = {name: array for name, array in tensors.items() if array is not None}
    path.write_bytes(safetensors.torch.save(kept, {"training": json.dumps(metadata)}))


@pytest.mark.parametrize(
    ("values", "arrays", "complaint"),
    [
        ({"format": 2}, {}, "format is 2; expected 1"),
        ({"rngs": []}, {}, "not the state of a training"),
        ({"rngs": [{"bit_generator": "MT19937"}] * 3}, {}, "not the state of a training"),
        ({"rngs": 3}, {}, "not the state of a training"),
        ({}, {"learner.iterations": None}, "not the state of a training: 'iterations'"),
        ({}, {"world.cell": None}, "not the state of a training: .*'cell'"),
        ({}, {"curves": torch.zeros(9, 9, 9)}, "not the state of a training"),
    ],
    ids=str,
)
def test_a_state_that_lacks_something_is_refused(path, values, arrays, complaint):
    checkpoint.save(path, fly(Training(made(), CPU), 1), {})
    edit(path, values, arrays)
    assert re.search(complaint, refused(path))


def with_run(**values):
    """The population with another first run."""
    base = made()
    first = msgspec.structs.replace(base.runs[0], **values)
    return msgspec.structs.replace(base, runs=(first, *base.runs[1:]))


def test_the_value_in_which_a_state_differs_is_named(path):
    checkpoint.save(path, fly(Training(made(), CPU), 1), {})
    base = made()
    learning, paid = base.runs[0].hyperparameters, base.runs[0].reward
    others = {
        "runs[0].seed = 1; expected 8": with_run(seed=8),
        "runs[0].environment = None; expected 0": with_run(environment=0),
        "runs[0].algorithm = 'dqn'; expected 'dueling_dqn'": with_run(algorithm="dueling_dqn"),
        "runs[0].hyperparameters.gamma = 0.9; expected 0.5": with_run(
            hyperparameters=msgspec.structs.replace(learning, gamma=0.5)
        ),
        "runs[0].reward.beta = 1.0; expected 2.0": with_run(reward=msgspec.structs.replace(paid, beta=2.0)),
        "hidden[1] = 8; expected 9": made(hidden=(8, 9)),
        "the number of hidden = 2; expected 3": made(hidden=(8, 8, 8)),
        "observation = 'mission'; expected 'map'": made(observation="map"),
        "the number of runs = 3; expected 2": msgspec.structs.replace(base, runs=base.runs[:2]),
        "scenario.mission.episode_end = 'at_time_limit'; expected 'on_arrival'": made("on_arrival"),
    }
    for complaint, other in others.items():
        assert f"with {complaint}, as in this command" in refused(path, other)


def test_a_failure_leaves_the_older_one_and_nothing_else(path, monkeypatch):
    training = fly(Training(made(), CPU), 1)
    checkpoint.save(path, training, {"n": 1})
    before = path.read_bytes()

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(TrainingError, match=r"training\.safetensors cannot be written: .*No space left"):
        checkpoint.save(path, fly(training, 1), {"n": 2})
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]
    with pytest.raises(TrainingError, match="cannot be written"):
        checkpoint.save(path / "below", training, {})
