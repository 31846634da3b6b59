"""The replay buffer of a population: one ring of rows per run.

With n-step returns (Sutton, "Learning to predict by the methods of temporal differences", Machine Learning 3,
1988) a sampled transition leads over n stored ones, or to the end of its mission or of what is stored.
"""

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
    # Discount of the value at s', `[...]`, of a transition over several steps; None: gamma
    discount: Tensor | None = None


class ReplayBuffer:
    """The latest `capacity` transitions of each run."""

    def __init__(
        self,
        n_runs: int,
        capacity: int,
        n_inputs: int,
        device: torch.device,
        n_steps: int = 1,
        gamma: Tensor | None = None,
    ) -> None:
        """Empty; `gamma` `[N, 1]` is the discount of each run, needed for more than one step."""
        # A transition is one row, s, s', a, r, terminated: one memory access fetches it. With n-step returns
        # it also holds whether its mission was over.
        self._rows = torch.zeros((n_runs * capacity, 2 * n_inputs + 3 + (n_steps > 1)), device=device)
        self._n_steps, self._gamma = n_steps, gamma
        self._first = torch.arange(n_runs, device=device)[:, None] * capacity
        self._n_runs, self._capacity, self._n_inputs = n_runs, capacity, n_inputs
        self._added = 0

    def __len__(self) -> int:
        """Transitions held by each run."""
        return min(self._added, self._capacity)

    def add(self, transitions: TransitionBatch, over: Tensor) -> None:
        """Store one transition of each run, `[N, ...]`; when full, it replaces the oldest.

        `over`: the next transition is not of the same mission, bool `[N]`; for n-step returns only.
        """
        observation, action, reward, next_observation, terminated, _ = transitions
        columns = [action.float(), reward, terminated.float()]
        numbers = torch.stack(columns + [over.float()] * (self._n_steps > 1), dim=-1)
        rings = self._rows.view(self._n_runs, self._capacity, -1)
        rings[:, self._added % self._capacity] = torch.cat([observation, next_observation, numbers], dim=-1)
        self._added += 1

    def sample(self, draws: Tensor) -> TransitionBatch:
        """A mini-batch `[N, B, ...]`: uniform, with replacement, from uniform draws `[N, B]` in [0, 1)."""
        slots = (draws * len(self)).to(torch.int64).clamp_(max=len(self) - 1) + self._first
        batch = self._at(slots)
        return batch if self._n_steps == 1 else self._extended(slots, batch)

    def _at(self, slots: Tensor) -> TransitionBatch:
        rows = self._rows.index_select(0, slots.view(-1)).view(*slots.shape, -1)
        d = self._n_inputs
        return TransitionBatch(
            observation=rows[..., :d],
            action=rows[..., 2 * d].to(torch.int64),
            reward=rows[..., 2 * d + 1],
            next_observation=rows[..., d : 2 * d],
            terminated=rows[..., 2 * d + 2] > 0,
        )

    def _extended(self, slots: Tensor, batch: TransitionBatch) -> TransitionBatch:
        """Transitions `[N, B, ...]` over up to n steps."""
        assert self._gamma is not None, "needed for n-step returns"
        newest = (self._added - 1) % self._capacity + self._first
        observation, action, reward, next_observation, terminated, _ = batch
        discount = self._gamma.expand(slots.shape)
        for _ in range(self._n_steps - 1):
            goes_on = (self._rows[:, -1][slots] == 0.0) & (slots != newest)
            slots = torch.where(goes_on, (slots + 1 - self._first) % self._capacity + self._first, slots)
            step = self._at(slots)
            reward = torch.where(goes_on, reward + discount * step.reward, reward)
            next_observation = torch.where(goes_on[..., None], step.next_observation, next_observation)
            terminated = torch.where(goes_on, step.terminated, terminated)
            discount = torch.where(goes_on, discount * self._gamma, discount)
        return TransitionBatch(observation, action, reward, next_observation, terminated, discount)

    def state(self) -> dict[str, Tensor]:
        """The stored rows, `[N, len, ...]`, and the number of additions."""
        rows = self._rows.view(self._n_runs, self._capacity, -1)[:, : len(self)]
        return {"rows": rows, "added": torch.tensor(self._added)}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Restore the `state` of a buffer of the same shape."""
        self._added = int(state["added"])
        self._rows.view(self._n_runs, self._capacity, -1)[:, : len(self)] = state["rows"]
