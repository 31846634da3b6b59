"""Among obstacles, learners and policies take only moves that have an effect."""

import msgspec
import numpy as np
import torch

from tests.support.worlds import population, run, saved, tiny
from uav_dc_ros.agents import policy as policies
from uav_dc_ros.core import world
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.scenario import from_values
from uav_dc_ros.experiments.train.training import Training, action_mask

ISLAND = {"kind": "no_fly", "polygon_m": [[60.0, 60.0], [140.0, 60.0], [140.0, 140.0], [60.0, 140.0]]}


def field():
    """The tiny field; its middle cell lies in a no-fly zone."""
    return from_values(msgspec.to_builtins(tiny()) | {"obstacles": [ISLAND]}, "test")


def test_runs_explore_and_exploit_among_valid_actions_only():
    scenario = field()
    training = Training(
        population(scenario, *(run(scenario, seed) for seed in range(16))), torch.device("cpu")
    )
    observation = torch.from_numpy(training._worlds.observe("mission"))
    start = world.action_mask(scenario, np.asarray(scenario.start_cell))  # a corner of a single layer
    valid = np.flatnonzero(start)
    assert valid.tolist() == [Action.RIGHT, Action.FORWARD, Action.HOVER]
    draws = torch.from_numpy(np.random.default_rng(0).random((100, 16), np.float32))
    taken = torch.cat([training.learner.act(observation, torch.ones(16), choice) for choice in draws])
    counts = np.bincount(taken.numpy(), minlength=7)
    assert set(np.flatnonzero(counts)) == set(valid)
    np.testing.assert_allclose(counts[valid] / counts.sum(), 1 / 3, atol=0.04)  # 1600 draws
    assert set(training.learner.greedy(observation[:, None]).numpy().ravel()) <= set(valid)


def test_training_takes_and_expects_valid_actions_only():
    scenario = field()
    training = Training(population(scenario, run(scenario)), torch.device("cpu"))
    training.fly_episode()
    batch = training._buffer.sample(torch.linspace(0, 0.999, 8)[None])
    mask = action_mask(scenario, "mission")
    assert mask(batch.observation).gather(-1, batch.action[..., None]).all()
    learner, expected = training.learner, []
    next_q = learner._q(learner._forward(learner._theta_target, batch.next_observation)[-1]).mT[0]
    q = learner.q_values(batch.observation)[0].gather(-1, batch.action[0, :, None])[:, 0]
    for row, valid in zip(next_q, mask(batch.next_observation)[0], strict=True):
        expected.append(max(value for value, ok in zip(row.tolist(), valid.tolist(), strict=True) if ok))
    gamma = training.population.runs[0].hyperparameters.gamma
    y = batch.reward[0] + gamma * torch.tensor(expected) * ~batch.terminated[0]
    with torch.inference_mode():
        loss = learner.update(batch)
    torch.testing.assert_close(loss[0], ((q - y) ** 2).mean())


def test_a_policy_takes_the_best_valid_action(tmp_path):
    scenario = field()
    policy = policies.load(saved(tmp_path / "policy", scenario))
    cells = np.argwhere(scenario.moves.free)
    n = len(cells)
    zeros = np.zeros((n, scenario.n_users))
    observation = policy.observe(
        scenario, cell=cells, step=np.zeros(n, int), data_bits=zeros, collected=zeros > 0
    )
    mask = world.action_mask(scenario, cells)
    best = [
        max(np.flatnonzero(m), key=lambda a: q[a])
        for q, m in zip(policy.q_values(observation), mask, strict=True)
    ]
    np.testing.assert_array_equal(policy.act(observation, mask), best)
    assert (policy.act(observation) != best).any()
