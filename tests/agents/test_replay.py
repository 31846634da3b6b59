"""The replay buffer."""

import pytest
import torch

from uav_dc_ros.agents.replay import ReplayBuffer, TransitionBatch


def transitions(value, n_runs=2):
    """One transition of each run, all its numbers made from `value` and the run."""
    number = value + 1000.0 * torch.arange(n_runs)
    return TransitionBatch(
        observation=number[:, None].expand(-1, 3),
        action=number.to(torch.int64),
        reward=number,
        next_observation=number[:, None].expand(-1, 3) + 0.5,
        terminated=torch.full((n_runs,), value % 2 == 1),
    )


def filled(n, capacity=10):
    buffer = ReplayBuffer(2, capacity, 3, torch.device("cpu"))
    for value in range(n):
        buffer.add(transitions(value), torch.zeros(2, dtype=torch.bool))
    return buffer


def every_slot(buffer):
    """Draws that meet the middle of each slot once, for both runs."""
    return ((torch.arange(len(buffer)) + 0.5) / len(buffer)).expand(2, -1)


def test_the_parts_of_a_transition_stay_together():
    batch = filled(7).sample(torch.rand((2, 50), generator=torch.Generator().manual_seed(0)))
    assert batch.observation.shape == (2, 50, 3)
    torch.testing.assert_close(batch.observation[..., 0], batch.reward)
    torch.testing.assert_close(batch.next_observation[..., 2], batch.reward + 0.5)
    assert torch.equal(batch.action, batch.reward.to(torch.int64))
    assert torch.equal(batch.terminated, batch.action % 2 == 1)
    assert torch.equal(batch.reward[1] >= 1000.0, torch.ones(50, dtype=torch.bool)), "runs do not mix"


@pytest.mark.parametrize(("n", "held"), [(1, [0]), (4, [0, 1, 2, 3]), (10, range(10)), (23, range(13, 23))])
def test_it_holds_the_latest(n, held):
    buffer = filled(n)
    assert len(buffer) == len(held)
    rewards = buffer.sample(every_slot(buffer)).reward
    assert sorted(rewards[0].tolist()) == list(held)
    assert sorted(rewards[1].tolist()) == [1000 + value for value in held]


def test_sampling_is_uniform_and_stays_inside():
    buffer = filled(8)
    draws = torch.rand((2, 80_000), generator=torch.Generator().manual_seed(1))
    draws[:, 0], draws[:, 1] = 0.0, 1.0 - 2.0**-24  # the minimum and maximum draw
    counts = torch.bincount(buffer.sample(draws).reward[0].to(torch.int64), minlength=8)
    # 10 000 expected in each of 8 slots; chi-squared with 7 degrees of freedom is below 24.3 in 999 of 1000.
    assert ((counts - 10_000.0) ** 2 / 10_000.0).sum() < 24.3


@pytest.mark.parametrize("n", [0, 4, 10, 23])
def test_a_restored_buffer_holds_the_same_in_the_same_places(n):
    """Empty, not full, just full, and wrapped round: what is added next replaces what it would have."""
    buffer, restored = filled(n), ReplayBuffer(2, 10, 3, torch.device("cpu"))
    restored.restore({name: values.clone() for name, values in buffer.state().items()})
    draws = torch.rand((2, 40), generator=torch.Generator().manual_seed(0))
    for value in range(n, n + 12):
        for one in (buffer, restored):
            one.add(transitions(value), torch.zeros(2, dtype=torch.bool))
        assert len(buffer) == len(restored)
        for expected, found in zip(buffer.sample(draws)[:5], restored.sample(draws)[:5], strict=True):
            assert torch.equal(expected, found)


def test_what_it_hands_out_is_only_what_it_holds():
    assert filled(4).state()["rows"].shape == (2, 4, 9)
    assert filled(23).state()["rows"].shape == (2, 10, 9)


@pytest.mark.parametrize("n_added", [7, 16, 23])
@pytest.mark.parametrize("n_steps", [2, 4])
def test_n_step_returns_are_sums_up_to_the_end_of_a_mission_or_of_what_is_stored(n_added, n_steps):
    gamma, over_at = torch.tensor([[0.5], [0.9]]), {2, 9, 14, 20}
    buffer = ReplayBuffer(2, 10, 3, torch.device("cpu"), n_steps, gamma)
    for value in range(n_added):
        buffer.add(transitions(value), torch.tensor([value in over_at, value + 1 in over_at]))
    batch = buffer.sample(every_slot(buffer))
    for run in range(2):
        for i, first in enumerate((batch.observation[run, :, 0] - 1000.0 * run).int().tolist()):
            steps = [first]
            while len(steps) < n_steps and steps[-1] + run not in over_at and steps[-1] + 1 < n_added:
                steps.append(steps[-1] + 1)
            discounts = gamma[run].item() ** torch.arange(len(steps))
            rewards = torch.tensor(steps) + 1000.0 * run
            assert batch.reward[run, i].item() == pytest.approx((discounts * rewards).sum().item())
            assert batch.discount[run, i].item() == pytest.approx(gamma[run].item() ** len(steps))
            assert batch.next_observation[run, i, 0].item() == steps[-1] + 1000.0 * run + 0.5
            assert batch.terminated[run, i].item() == (steps[-1] % 2 == 1)
            assert batch.action[run, i].item() == first + 1000 * run
