"""Scalars for TensorBoard, read back by TensorBoard's own reader."""

import sys

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from tests.support.worlds import population, run, tiny
from uav_dc_ros.errors import TrainingError
from uav_dc_ros.experiments.train import checkpoint
from uav_dc_ros.experiments.train.episode_stats import CURVES
from uav_dc_ros.experiments.train.tensorboard import TensorBoardLog
from uav_dc_ros.experiments.train.training import Training

CPU = torch.device("cpu")


@pytest.fixture
def made():
    scenario = tiny()
    return population(scenario, run(scenario, 3), run(scenario, 8, form="immediate"))


def scalars(folder):
    """Step and value of every scalar."""
    read = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    read.Reload()
    return {tag: [(event.step, event.value) for event in read.Scalars(tag)] for tag in read.Tags()["scalars"]}


def curve(training, name, one):
    return list(enumerate(training.curves[name][:, one].tolist(), start=1))


def test_they_are_the_curves_of_each_run(tmp_path, made):
    training = Training(made, CPU)
    with TensorBoardLog(tmp_path, "name", training) as written:
        for _ in range(3):
            training.fly_episode()
            written.add_episode()
        written.add_scores(np.array([1.5, 2.25]))
    for one, (seed, score) in enumerate([(3, 1.5), (8, 2.25)]):
        found = scalars(tmp_path / "name" / f"seed_{seed}")
        assert found.pop("validation/users_brought_home") == [(3, score)]
        assert found == {f"training/{name}": curve(training, name, one) for name in CURVES}
    assert sorted(path.name for path in (tmp_path / "name").iterdir()) == ["seed_3", "seed_8"]


def test_what_was_written_after_the_checkpoint_is_taken_back(tmp_path, made):
    training = Training(made, CPU)
    lost = TensorBoardLog(tmp_path, "name", training)  # never closed, like that of a killed process
    for n in range(1, 4):
        training.fly_episode()
        lost.add_episode()
        if n == 2:
            lost.add_scores(np.array([0.5, 0.5]))
            checkpoint.save(tmp_path / "state", training, {})
    lost.add_scores(np.array([9.0, 9.0]))  # puts the third episode on the disk too
    resumed = Training(made, CPU)
    checkpoint.restore(tmp_path / "state", resumed)
    with TensorBoardLog(tmp_path, "name", resumed) as written:
        for _ in range(2):
            resumed.fly_episode()
            written.add_episode()
    found = scalars(tmp_path / "name" / "seed_8")
    assert found.pop("validation/users_brought_home") == [(2, 0.5)]
    assert found == {f"training/{name}": curve(resumed, name, 1) for name in CURVES}
    assert len(resumed.curves["loss"]) == 4


def test_a_validation_puts_everything_until_then_on_the_disk(tmp_path, made):
    """So that what a checkpoint follows cannot be lost."""
    training = Training(made, CPU)
    written = TensorBoardLog(tmp_path, "name", training)
    training.fly_episode()
    written.add_episode()
    written.add_scores(np.array([1.0, 1.0]))
    assert len(scalars(tmp_path / "name" / "seed_3")) == len(CURVES) + 1
    written.__exit__(None, None, None)


def test_without_a_folder_nothing_is_written(tmp_path, made, monkeypatch):
    monkeypatch.chdir(tmp_path)
    training = Training(made, CPU)
    with TensorBoardLog(None, "name", training) as written:
        training.fly_episode()
        written.add_episode()
        written.add_scores(np.array([1.0, 1.0]))
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_written_is_named(tmp_path, made):
    (tmp_path / "file").touch()
    with pytest.raises(TrainingError, match=r"--tensorboard .*file cannot be written: "):
        TensorBoardLog(tmp_path / "file", "name", Training(made, CPU))


def test_without_tensorboard_there_is_one_line_that_helps(tmp_path, made, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(TrainingError, match=r'expected it from: pip install "uav_dc_ros\[train\]"'):
        TensorBoardLog(tmp_path, "name", Training(made, CPU))
