"""The replay buffer of a population: one ring of rows per run."""

from typing import NamedTuple

import torch
from torch import Tensor


class TransitionBatch(NamedTuple):
    """Transitions (s, a, r, s') of N runs, `[N, ...]`, or a mini-batch, `[N, B, ...]`."""

    observation: Tensor  # s, float32 `[..., D]`
    action: Tensor  # integers `[...]`
    reward: Tensor  # float32 `[...]`
    next_observation: Tensor  # s', float32 `[..., D]`
    terminated: Tensor  # the episode ended at s' and was not truncated, bool `[...]`


class ReplayBuffer:
    """The latest `capacity` transitions of each run."""

    def __init__(self, n_runs: int, capacity: int, n_inputs: int, device: torch.device) -> None:
        # A transition is one row, s, s', a, r, terminated: one memory access fetches it.
        self._rows = torch.zeros((n_runs * capacity, 2 * n_inputs + 3), device=device)
        self._first = torch.arange(n_runs, device=device)[:, None] * capacity
        self._n_runs, self._capacity, self._n_inputs = n_runs, capacity, n_inputs
        self._added = 0

    def __len__(self) -> int:
        """Transitions held by each run."""
        return min(self._added, self._capacity)

    def add(self, transitions: TransitionBatch) -> None:
        """Store one transition of each run, `[N, ...]`; when full, it replaces the oldest."""
        observation, action, reward, next_observation, terminated = transitions
        numbers = torch.stack([action.float(), reward, terminated.float()], dim=-1)
        rings = self._rows.view(self._n_runs, self._capacity, -1)
        rings[:, self._added % self._capacity] = torch.cat([observation, next_observation, numbers], dim=-1)
        self._added += 1

    def sample(self, draws: Tensor) -> TransitionBatch:
        """A mini-batch `[N, B, ...]`: uniform, with replacement, from uniform draws `[N, B]` in [0, 1)."""
        slots = (draws * len(self)).to(torch.int64).clamp_(max=len(self) - 1) + self._first
        rows = self._rows.index_select(0, slots.view(-1)).view(*draws.shape, -1)
        d = self._n_inputs
        return TransitionBatch(
            observation=rows[..., :d],
            action=rows[..., 2 * d].to(torch.int64),
            reward=rows[..., 2 * d + 1],
            next_observation=rows[..., d : 2 * d],
            terminated=rows[..., 2 * d + 2] > 0,
        )

    def state(self) -> dict[str, Tensor]:
        """The stored rows, `[N, len, ...]`, and the number of additions."""
        rows = self._rows.view(self._n_runs, self._capacity, -1)[:, : len(self)]
        return {"rows": rows, "added": torch.tensor(self._added)}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Restore the `state` of a buffer of the same shape."""
        self._added = int(state["added"])
        self._rows.view(self._n_runs, self._capacity, -1)[:, : len(self)] = state["rows"]
