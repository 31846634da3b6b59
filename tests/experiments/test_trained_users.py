"""Training with listed users, in clusters of unequal size, whose mobility has a memory."""

import msgspec
import pytest
import torch

from tests.support.worlds import population, run, tiny
from uav_dc_ros.core.scenario import from_values
from uav_dc_ros.experiments.train import checkpoint
from uav_dc_ros.experiments.train.training import Training

CPU = torch.device("cpu")
LEARNING = {"episodes": 5, "buffer_size": 20, "target_every": 11}

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.parametrize(
    ("worlds_in", "mobility"),
    [
        ("numpy", {"model": "random_waypoint", "v_min_mps": 0.5, "v_max_mps": 9.0, "pause_s": 20.0}),
        ("torch", {"model": "gauss_markov", "alpha": 0.9, "mean_speed_mps": 2.0}),
    ],
)
def test_listed_users_that_remember_go_on_as_they_were(tmp_path, worlds_in, mobility):
    """A checkpoint within a mission holds what their mobility remembers; clusters are of unequal size."""
    users = [{"x_m": 50.0 * i, "y_m": 100.0, "cluster": "a"} for i in range(3)]
    users.append({"x_m": 150.0, "y_m": 20.0, "priority": 3.0, "data_bits": 2e6, "radius_m": 20.0})
    values = msgspec.to_builtins(tiny(mission={"episode_end": "on_arrival"}))
    scenario = from_values(values | {"users": {"user": users, "mobility": mobility}}, "test")

    path = tmp_path / "training.safetensors"

    def training():
        return Training(population(scenario, run(scenario, 1, **LEARNING)), CPU, worlds_in)

    def fly(training, n):
        for _ in range(n):
            training.fly_episode()
        return training

    expected, _ = fly(training(), 4).state()
    checkpoint.save(path, fly(training(), 2), {})
    resumed = training()
    checkpoint.restore(path, resumed)
    found, _ = fly(resumed, 2).state()
    assert found.keys() == expected.keys() >= {"world.motion"}
    for name, array in expected.items():
        assert torch.equal(found[name], array), name
    assert expected["world.motion"].shape[-1] == (4 if worlds_in == "numpy" else 2)
