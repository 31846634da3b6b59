"""The replay buffer of a population: `[N, capacity, ...]`, one ring per run."""

from typing import NamedTuple

import torch
from torch import Tensor


class Transitions(NamedTuple):
    """Transitions (s, a, r, s') of N runs, `[N, ...]` or, in a mini-batch, `[N, B, ...]`.

    Attributes:
        observation: s, float32 `[..., D]`.
        action: integers `[...]`.
        reward: float32 `[...]`.
        next_observation: s', float32 `[..., D]`.
        terminated: the episode ended at s', bool `[...]`. A truncated one has not ended.
    """

    observation: Tensor
    action: Tensor
    reward: Tensor
    next_observation: Tensor
    terminated: Tensor


class ReplayBuffer:
    """The latest `capacity` transitions of each run."""

    def __init__(self, n_runs: int, capacity: int, n_inputs: int, device: torch.device) -> None:
        def room(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.zeros((n_runs, capacity, *shape), dtype=dtype, device=device)

        self._rings = Transitions(
            observation=room(n_inputs),
            action=room(dtype=torch.int64),
            reward=room(),
            next_observation=room(n_inputs),
            terminated=room(dtype=torch.bool),
        )
        self._runs = torch.arange(n_runs, device=device)[:, None]
        self._capacity = capacity
        self._added = 0

    def __len__(self) -> int:
        """Transitions held by each run."""
        return min(self._added, self._capacity)

    def add(self, transitions: Transitions) -> None:
        """Stores one transition of each run, `[N, ...]`, in place of its oldest when full."""
        slot = self._added % self._capacity
        for ring, values in zip(self._rings, transitions, strict=True):
            ring[:, slot] = values
        self._added += 1

    def sample(self, draws: Tensor) -> Transitions:
        """A mini-batch `[N, B, ...]`: uniform, with replacement, from uniform draws `[N, B]` in [0, 1)."""
        slots = (draws * len(self)).to(torch.int64).clamp_(max=len(self) - 1)
        return Transitions(*(ring[self._runs, slots] for ring in self._rings))
