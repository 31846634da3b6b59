"""Deep Q-learning and its dueling variant (the paper's algorithms 1 and 2) for a population of runs.

N independent runs learn side by side, with parameters `[N, ...]`; N = 1 is a single run. They share
nothing but the arithmetic: the loss is summed over runs, and Adam works element by element.

Departures from the text of the paper, which has slips here: the dueling target uses the target
network's own streams (theta_A', theta_V') and has the terminal case of the first algorithm. Departures of
choice: theta' starts as a copy of theta, where the paper draws both at random, and learning begins with
the first transition, where the prose waits for a full buffer.
"""

import numpy as np
import torch
from torch import Tensor

from uav_dc_ros.agents import network
from uav_dc_ros.agents.policy import Hyperparameters
from uav_dc_ros.agents.replay import Transitions


def td_target(reward: Tensor, terminated: Tensor, next_q: Tensor, gamma: float) -> Tensor:
    """The target y (eq. 22): `r` when the episode terminated at s', else `r + gamma max_a' Q'(s', a')`.

    Args:
        reward: r, `[...]`.
        terminated: bool `[...]`; truncation is not termination, and does bootstrap.
        next_q: Q'(s', .) of the target network, `[..., A]`.
        gamma: discount.

    Returns:
        y, `[...]`.
    """
    return reward + gamma * torch.where(terminated, 0.0, next_q.amax(dim=-1))


class Learner:
    """N Q-networks, their target networks and their optimiser."""

    def __init__(
        self,
        architecture: network.Architecture,
        hyperparameters: Hyperparameters,
        rngs: list[np.random.Generator],
        device: torch.device,
    ) -> None:
        """Networks with random parameters, one per generator."""
        self.architecture = architecture
        self.hyperparameters = hyperparameters
        runs = [network.initial(architecture, rng) for rng in rngs]
        self._theta = {
            name: torch.from_numpy(np.stack([run[name] for run in runs])).to(device).requires_grad_()
            for name in network.shapes(architecture)
        }
        self._theta_target = {name: values.detach().clone() for name, values in self._theta.items()}
        self._optimiser = torch.optim.Adam(self._theta.values(), lr=hyperparameters.learning_rate, fused=True)
        self._iterations = 0

    @torch.no_grad()
    def act(self, observation: Tensor, explore: Tensor, choice: Tensor) -> Tensor:
        """Epsilon-greedy actions (eq. 18): greedy with probability epsilon, else any one.

        Args:
            observation: `[N, D]`.
            explore, choice: uniform draws in [0, 1), `[N]` each: whether to be greedy, and what else.

        Returns:
            Integers `[N]`.
        """
        q = network.q_values(self.architecture, self._theta, observation[:, None])[:, 0]
        anything = (choice * q.shape[-1]).to(torch.int64)
        return torch.where(explore < self.hyperparameters.epsilon, q.argmax(dim=-1), anything)

    def update(self, batch: Transitions) -> Tensor:
        """One gradient step on a mini-batch `[N, B, ...]`.

        Returns:
            The loss of each run before the step, `[N]`.
        """
        with torch.no_grad():
            next_q = network.q_values(self.architecture, self._theta_target, batch.next_observation)
            y = td_target(batch.reward, batch.terminated, next_q, self.hyperparameters.gamma)
        q = network.q_values(self.architecture, self._theta, batch.observation)
        loss = torch.mean((y - q.gather(-1, batch.action[..., None])[..., 0]) ** 2, dim=-1)
        self._optimiser.zero_grad()
        torch.sum(loss).backward()  # type: ignore[no-untyped-call]
        self._optimiser.step()
        self._iterations += 1
        if self._iterations % self.hyperparameters.target_every == 0:
            for name, values in self._theta.items():
                self._theta_target[name].copy_(values.detach())
        return loss.detach()

    def parameters(self) -> network.Parameters:
        """A copy of the parameters, numpy, `[N, ...]`."""
        return {name: values.detach().cpu().numpy().copy() for name, values in self._theta.items()}
