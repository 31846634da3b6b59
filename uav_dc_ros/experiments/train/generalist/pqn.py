"""Parallelised Q-learning: no replay buffer, no target network. Needs torch.

Gallici et al., "Simplifying Deep Temporal Difference Learning", ICLR 2025. Missions are flown to their end,
and the network is fitted to their lambda-returns. Deviation: a batch holds whole missions, so no return is
cut off.

Targets of actions that the network does not prefer are lowered by a share of what it holds against them
(advantage learning: Bellemare et al., "Increasing the Action Gap", AAAI 2016). The best actions stay the
same, and errors of the network decide less.

Demonstrated actions have a margin over the others (Hester et al., "Deep Q-learning from Demonstrations", AAAI
2018), so that the policy begins with what the planner does.
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from uav_dc_ros.agents import set_network
from uav_dc_ros.agents.network import Parameters
from uav_dc_ros.agents.set_network import SetArchitecture
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.entities.encoding import allowed

GRADIENT_MAX = 10.0  # norm
MARGIN = 0.1  # of a demonstrated action over others, in units of the returns


class Batch(NamedTuple):
    """Decisions of missions, one row each."""

    observation: Array  # float32 `[R, D]`
    action: Array  # integers `[R]`
    target: Array  # float32 `[R]`
    demonstrated: Array  # the action is a planner's, which is to be preferred, bool `[R]`


class PqnLearner:
    """One Q-network for sets and its optimiser."""

    def __init__(self, architecture: SetArchitecture, parameters: Parameters) -> None:
        self.architecture = architecture
        self._theta = {name: torch.from_numpy(v.copy()).requires_grad_() for name, v in parameters.items()}
        self._optimiser = torch.optim.Adam(self._theta.values(), lr=0.0, eps=1e-5, fused=True)

    def q_values(self, observation: Array) -> Array:
        """Q(s, a), `[B, D]` to `[B, A]`, float32."""
        with torch.inference_mode():
            return self._q(torch.from_numpy(observation)).numpy()

    def _q(self, observation: Tensor) -> Tensor:
        return set_network.q_values(self.architecture, self._theta, observation, _active)

    def fit(self, batch: Batch, order: Array, rows: int, learning_rate: float) -> float:
        """Gradient steps on mini-batches of `rows` rows in an order `[R]`; their mean squared error."""
        self._optimiser.param_groups[0]["lr"] = learning_rate
        losses = []
        for part in np.array_split(order, max(1, round(len(order) / rows))):
            observation, action, target, shown = (torch.from_numpy(values[part]) for values in batch)
            q_values = self._q(observation)
            taken = q_values.gather(1, action[:, None])
            error = taken[:, 0] - target
            squares = (error * error).mean()
            loss = squares
            if shown.any():
                others = (q_values + MARGIN).scatter(1, action[:, None], taken)
                best = others.masked_fill(~allowed(observation), -torch.inf).amax(dim=1)
                loss = loss + ((best - taken[:, 0]) * shown).mean()
            self._optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            torch.nn.utils.clip_grad_norm_(self._theta.values(), GRADIENT_MAX)
            self._optimiser.step()
            losses.append(float(squares.detach()))
        return sum(losses) / len(losses)

    def parameters(self) -> Parameters:
        """A copy of the parameters, numpy, as `set_network.shapes` names them."""
        return {name: values.detach().numpy().copy() for name, values in self._theta.items()}

    def state(self) -> dict[str, Tensor]:
        """Everything that later updates depend on."""
        state = {f"theta.{name}": values.detach() for name, values in self._theta.items()}
        for i, moments in self._optimiser.state_dict()["state"].items():
            state |= {f"adam.{i}.{key}": values for key, values in moments.items()}
        return state

    def restore(self, state: dict[str, Tensor]) -> None:
        """Restore the `state` of a learner of the same architecture."""
        moments: dict[int, dict[str, Tensor]] = {}
        with torch.no_grad():
            for name, values in state.items():
                kind, _, key = name.partition(".")
                if kind == "theta":
                    self._theta[key].copy_(values)
                else:
                    index, _, key = key.partition(".")
                    moments.setdefault(int(index), {})[key] = values
        self._optimiser.load_state_dict(self._optimiser.state_dict() | {"state": moments})


def lambda_returns(reward: Array, over: Array, best_q: Array, trace: float, discount: float) -> Array:
    """Targets of missions, `[T, B]`: G_t = r_t + discount ((1 - trace) max_a Q(s_{t+1}, a) + trace G_{t+1}).

    Behind the step with which a mission is `over`, bool `[T, B]`, nothing counts. `best_q` `[T, B]` is max_a
    Q(s_t, a) over the actions that are allowed.
    """
    targets, after = np.zeros_like(reward), np.zeros_like(reward[0])
    for t in reversed(range(len(reward))):
        if t + 1 < len(reward):
            after = (1.0 - trace) * best_q[t + 1] + trace * targets[t + 1]
        targets[t] = reward[t] + np.where(over[t], 0.0, discount * after)
    return targets


def _active(values: Tensor) -> Tensor:
    """As in `set_network`, fused."""
    return functional.relu(functional.layer_norm(values, values.shape[-1:]))
