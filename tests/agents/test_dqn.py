"""The learner: its targets, its actions, its gradients, and that runs do not touch each other."""

from itertools import pairwise

import numpy as np
import pytest
import torch

from uav_dc_ros.agents import network
from uav_dc_ros.agents.dqn import Learner, td_target
from uav_dc_ros.agents.network import Architecture
from uav_dc_ros.agents.policy import Hyperparameters
from uav_dc_ros.agents.replay import Transitions

CPU = torch.device("cpu")
ARCHITECTURE = Architecture(n_inputs=3, hidden=(16,), n_actions=4, dueling="mean")


def learner(seeds, dueling="mean", **values):
    architecture = Architecture(n_inputs=3, hidden=(16,), n_actions=4, dueling=dueling)
    return Learner(
        architecture, Hyperparameters(**values), [np.random.default_rng(seed) for seed in seeds], CPU
    )


def batches(n, seeds, size=8):
    """Random mini-batches; a run's depend on its seed only."""
    rngs = [np.random.default_rng([seed, 1]) for seed in seeds]

    def stack(draw):
        return torch.from_numpy(np.stack([draw(rng) for rng in rngs]))

    for _ in range(n):
        yield Transitions(
            observation=stack(lambda rng: rng.random((size, 3), np.float32)),
            action=stack(lambda rng: rng.integers(0, 4, size)),
            reward=stack(lambda rng: rng.random(size, np.float32)),
            next_observation=stack(lambda rng: rng.random((size, 3), np.float32)),
            terminated=stack(lambda rng: rng.random(size) < 0.3),
        )


def test_td_target_by_hand():
    """A step in flight, the last one of a mission, and one that was cut off: only the end ends the sum."""
    reward = torch.tensor([1.0, 1.0, 1.0])
    terminated = torch.tensor([False, True, False])  # the third was truncated, which is not termination
    next_q = torch.tensor([[0.0, 2.0, -1.0], [5.0, 7.0, 6.0], [-3.0, -2.0, -4.0]])
    expected = torch.tensor([1.0 + 0.9 * 2.0, 1.0, 1.0 - 0.9 * 2.0])
    torch.testing.assert_close(td_target(reward, terminated, next_q, 0.9), expected)


def test_td_target_of_a_population():
    next_q = torch.rand((2, 5, 4), generator=torch.Generator().manual_seed(0))
    y = td_target(torch.ones(2, 5), torch.zeros(2, 5, dtype=torch.bool), next_q, 0.5)
    torch.testing.assert_close(y, 1.0 + 0.5 * next_q.max(-1).values)


def test_a_value_that_is_not_finite_does_not_leak_through_the_end():
    y = td_target(torch.ones(1), torch.tensor([True]), torch.tensor([[torch.inf, torch.nan]]), 0.9)
    assert y.item() == 1.0


def test_epsilon_is_the_probability_of_the_greedy_action():
    made = learner([0], epsilon=0.9)
    n = 2_000
    observation = torch.full((1, 3), 0.3)
    greedy = network.q_values(ARCHITECTURE, made.parameters(), observation[:, None].numpy()).argmax(-1).item()
    generator = torch.Generator().manual_seed(0)
    explore, choice = torch.rand((2, n, 1), generator=generator)
    actions = torch.cat([made.act(observation, explore[i], choice[i]) for i in range(n)])
    share = torch.bincount(actions, minlength=4) / n
    # A random action is the greedy one in a quarter of the cases.
    expected = torch.full((4,), 0.1 / 4)
    expected[greedy] += 0.9
    torch.testing.assert_close(share, expected, atol=0.03, rtol=0.0)


@pytest.mark.parametrize("dueling", ["mean", "max", None])
def test_the_loss_is_the_mean_squared_error_of_the_paper(dueling):
    made = learner([3], dueling)
    before = made.parameters()
    (batch,) = batches(1, [3])
    loss = made.update(batch)
    q = network.q_values(made.architecture, before, batch.observation.numpy())[0]
    taken = q[np.arange(8), batch.action[0].numpy()]
    # Before the first copy the target network has the same parameters.
    next_q = network.q_values(made.architecture, before, batch.next_observation.numpy())[0]
    y = batch.reward[0].numpy() + 0.9 * np.where(batch.terminated[0], 0.0, next_q.max(-1))
    assert loss.item() == pytest.approx(np.mean((y - taken) ** 2), rel=1e-5)


def test_a_population_learns_what_its_runs_learn_alone():
    seeds = [5, 6, 7]
    together = learner(seeds, target_every=7)
    for batch in batches(30, seeds):
        together.update(batch)
    for run, seed in enumerate(seeds):
        alone = learner([seed], target_every=7)
        for batch in batches(30, [seed]):
            alone.update(batch)
        for name, values in alone.parameters().items():
            np.testing.assert_allclose(values[0], together.parameters()[name][run], rtol=1e-4, atol=1e-6)


def test_the_same_seeds_give_the_same_parameters():
    made = [learner([1, 2]), learner([1, 2])]
    for one in made:
        for batch in batches(20, [1, 2]):
            one.update(batch)
    first, second = (one.parameters() for one in made)
    assert all(np.array_equal(first[name], second[name]) for name in first)


def test_the_target_network_stands_still_between_copies():
    made = learner([0], target_every=5)
    (batch,) = batches(1, [0])
    targets = []
    for _ in range(12):
        targets.append(made._theta_target["value.bias"].item())
        made.update(batch)
    moved = [i for i, (a, b) in enumerate(pairwise(targets), start=1) if a != b]
    assert moved == [5, 10]
