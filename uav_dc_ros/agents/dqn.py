"""Deep Q-learning and its dueling variant (the paper's algorithms 1 and 2) for a population of runs.

N independent runs learn side by side, with parameters `[N, ...]`; N = 1 is a single run. Every operation
works run by run. The gradient is written out for speed; a test compares it with torch's own.

Corrections of the paper's text: the dueling target uses the target network's own streams (theta_A',
theta_V') and has the terminal case of the first algorithm. Deviations: theta' starts as a copy of theta,
where the paper draws both at random, and learning begins with the first transition, where the prose waits
for a full buffer.
"""

from collections.abc import Callable, Sequence
from itertools import groupby
from typing import NamedTuple, TypeAlias

import numpy as np
import torch
from torch import Tensor

from uav_dc_ros.agents import network
from uav_dc_ros.agents.policy import Hyperparameters
from uav_dc_ros.agents.replay import TransitionBatch

# The actions that have an effect in observations `[..., D]`, bool `[..., A]`.
Mask: TypeAlias = Callable[[Tensor], Tensor]


def td_target(reward: Tensor, terminated: Tensor, next_q: Tensor, gamma: float | Tensor) -> Tensor:
    """The target y (eq. 22): `r` when the episode terminated at s', else `r + gamma max_a' Q'(s', a')`.

    `next_q` is Q'(s', .) of the target network, `[..., A]`, minus infinity for an action that has no effect
    there; everything else is `[...]`. A truncated episode has not terminated.
    """
    return reward + gamma * next_q.amax(dim=-1).masked_fill_(terminated, 0.0)


class Member(NamedTuple):
    """A run of the learner. All runs have equal sizes; everything else may differ."""

    architecture: network.Architecture
    hyperparameters: Hyperparameters
    rng: np.random.Generator
    # Whether the network itself chooses the action at s' of which the target network gives the value: van
    # Hasselt et al., "Deep Reinforcement Learning with Double Q-learning", AAAI 2016
    double: bool = False


class Learner:
    """N Q-networks, their target networks and their optimiser.

    Every network has both streams of the dueling one in a single last layer, `head`: its first output is V,
    the others are A(a). The Q-values of a plain network are A(a): its V has no gradient and stays constant.

    Among obstacles a `mask` names the actions that have an effect: the runs take no other action, and the
    target is the maximum over them (Huang and Ontanon, "A closer look at invalid action masking in policy
    gradient algorithms", FLAIRS 2022, for Q-learning).
    """

    def __init__(self, members: Sequence[Member], device: torch.device, mask: Mask | None = None) -> None:
        """Networks with random parameters from the generator of each run."""
        self._mask = mask
        self._architectures = [member.architecture for member in members]
        settings = [member.hyperparameters for member in members]
        self._n_hidden = len(self._architectures[0].hidden)
        self._target_every = settings[0].target_every
        self._iterations = 0

        def column(values: Sequence[float]) -> Tensor:
            return torch.tensor(values, dtype=torch.float32, device=device)[:, None]

        self._gamma = column([values.gamma for values in settings])
        self._epsilon = column([values.epsilon for values in settings])[:, 0]
        kinds = [one.dueling for one in self._architectures]
        self._dueling = column([float(kind is not None) for kind in kinds])
        self._subtracts_max = column([float(kind == "max") for kind in kinds]) > 0
        self._any_dueling, self._any_max = any(kinds), "max" in kinds
        self._double = column([float(member.double) for member in members])[..., None] > 0
        self._any_double = any(member.double for member in members)
        sizes = [values.batch_size for values in settings]
        # Twice the weight of each row in its run's mean (the gradient of a square); 0 beyond the batch size.
        rows = torch.arange(max(sizes), device=device)
        self._weight = 2.0 * (rows < column(sizes)) / column(sizes)

        made = [_stacked(network.initial(member.architecture, member.rng)) for member in members]
        stacks = {name: torch.from_numpy(np.stack([one[name] for one in made])) for name in made[0]}
        # Contiguous memory, for one pass of the optimiser; the layers are views of it.
        self._flat = torch.cat([values.reshape(-1) for values in stacks.values()]).to(device)
        self._flat_target, self._flat_gradient = self._flat.clone(), torch.zeros_like(self._flat)
        shapes = {name: values.shape for name, values in stacks.items()}
        self._theta, self._theta_target, self._gradient = (
            _layers(flat, shapes) for flat in (self._flat, self._flat_target, self._flat_gradient)
        )
        self._optimiser = self._adam([values.learning_rate for values in settings])

    def _adam(self, rates: list[float]) -> torch.optim.Adam:
        """Adam with a parameter group for each stretch of neighbouring runs that share a learning rate."""
        if len(set(rates)) == 1:
            self._flat.grad = self._flat_gradient
            return torch.optim.Adam([self._flat], lr=rates[0], fused=True)
        groups = []
        for rate, stretch in groupby(range(len(rates)), lambda run: rates[run]):
            runs = list(stretch)
            own = {name: values[runs[0] : runs[-1] + 1] for name, values in self._theta.items()}
            for name, values in own.items():
                values.grad = self._gradient[name][runs[0] : runs[-1] + 1]
            groups.append({"params": list(own.values()), "lr": rate})
        return torch.optim.Adam(groups, fused=True)

    def q_values(self, observation: Tensor) -> Tensor:
        """Q(s, a) of each run's network: `[N, B, D]` to `[N, B, A]`."""
        return self._q(self._forward(self._theta, observation)[-1]).mT

    def greedy(self, observation: Tensor) -> Tensor:
        """The greedy action of each run's network: `[N, B, D]` to integers `[N, B]`."""
        return self._masked(self.q_values(observation), observation).argmax(dim=-1)

    def act(self, observation: Tensor, explore: Tensor, choice: Tensor) -> Tensor:
        """Epsilon-greedy actions (eq. 18), integers `[N]`: greedy with probability epsilon, else random.

        `explore` and `choice` are uniform draws `[N]`: greedy or not, and the random action.
        """
        if self._mask is None:
            random = (choice * self._architectures[0].n_actions).to(torch.int64)
        else:
            number = self._mask(observation).to(torch.int64).cumsum(dim=-1)  # of each action among the valid
            n_valid = number[:, -1]
            drawn = torch.minimum((choice * n_valid).to(torch.int64), n_valid - 1)
            random = (number > drawn[:, None]).to(torch.int8).argmax(dim=-1)
        return torch.where(explore < self._epsilon, self.greedy(observation[:, None])[:, 0], random)

    def update(self, batch: TransitionBatch) -> Tensor:
        """One gradient step on a mini-batch `[N, B, ...]`; returns each run's loss before the step, `[N]`."""
        next_q = self._q(self._forward(self._theta_target, batch.next_observation)[-1]).mT
        next_q = self._masked(next_q, batch.next_observation)
        if self._any_double:
            chosen = self.greedy(batch.next_observation)[..., None]
            next_q = torch.where(self._double, next_q.gather(-1, chosen), next_q)
        gamma = self._gamma if batch.discount is None else batch.discount
        y = td_target(batch.reward, batch.terminated, next_q, gamma)
        *features, head = self._forward(self._theta, batch.observation)
        action = batch.action[:, None]  # [N, 1, B], as the head is [N, 1 + A, B]
        error = self._q(head).gather(1, action)[:, 0] - y
        d_q = self._weight * error
        self._backward(features, head, action, d_q)
        self._optimiser.step()
        self._iterations += 1
        if self._iterations % self._target_every == 0:
            self._flat_target.copy_(self._flat)
        return 0.5 * torch.sum(d_q * error, dim=-1)

    def _masked(self, q_values: Tensor, observation: Tensor) -> Tensor:
        if self._mask is None:
            return q_values
        return q_values.masked_fill(~self._mask(observation), -torch.inf)

    def _forward(self, theta: dict[str, Tensor], observation: Tensor) -> list[Tensor]:
        """Input of every layer, `[N, B, *]`, then the output of the head, `[N, 1 + A, B]`."""
        outputs = [observation]
        for i in range(self._n_hidden):
            before = torch.bmm(outputs[-1], theta[f"hidden_{i}.weight"]).add_(theta[f"hidden_{i}.bias"])
            outputs.append(before.clamp_min_(0.0))
        # Transposed: with few outputs the other order is slow.
        outputs.append(torch.bmm(theta["head.weight"], outputs[-1].mT).add_(theta["head.bias"]))
        return outputs

    def _q(self, head: Tensor) -> Tensor:
        """Q-values from the output of the head, `[N, 1 + A, B]` to `[N, A, B]` (eqs. 28 to 30)."""
        value, advantage = head[:, :1], head[:, 1:]
        if not self._any_dueling:
            return advantage
        subtracted = advantage.mean(1, keepdim=True)
        if self._any_max:
            maximum = advantage.amax(1, keepdim=True)
            subtracted = torch.where(self._subtracts_max[..., None], maximum, subtracted)
        return torch.addcmul(advantage, self._dueling[..., None], value - subtracted)

    def _backward(self, features: list[Tensor], head: Tensor, action: Tensor, d_q: Tensor) -> None:
        """Write the gradient of the parameters, from that of the taken actions' Q-values, `[N, B]`."""
        gradient, n_actions = self._gradient, head.shape[1] - 1
        d_head = torch.zeros_like(head)
        d_advantage = d_head[:, 1:]
        if self._any_dueling:
            d_value = d_head[:, :1]
            torch.mul(self._dueling, d_q, out=d_head[:, 0])
            to_max = self._subtracts_max[..., None]
            d_mean = d_value.masked_fill(to_max, 0.0) if self._any_max else d_value
            d_advantage.copy_(d_mean / -n_actions)
            if self._any_max:
                argmax = head[:, 1:].argmax(1, keepdim=True)
                d_advantage.scatter_add_(1, argmax, d_value.masked_fill(~to_max, 0.0).neg_())
        d_advantage.scatter_add_(1, action, d_q[:, None])

        torch.bmm(d_head, features[-1], out=gradient["head.weight"])
        torch.sum(d_head, 2, keepdim=True, out=gradient["head.bias"])
        d_features = torch.bmm(d_head.mT, self._theta["head.weight"])
        for i in reversed(range(self._n_hidden)):
            d_before = d_features.mul_(features[i + 1].sign_())  # gradient of ReLU
            torch.bmm(features[i].mT, d_before, out=gradient[f"hidden_{i}.weight"])
            torch.sum(d_before, 1, keepdim=True, out=gradient[f"hidden_{i}.bias"])
            if i > 0:
                d_features = torch.bmm(d_before, self._theta[f"hidden_{i}.weight"].mT)

    def parameters(self, run: int) -> network.Parameters:
        """A copy of a run's parameters, numpy, as `network.shapes` names them."""
        own = {name: values[run].cpu().numpy().copy() for name, values in self._theta.items()}
        return _unstacked(own, self._architectures[run])

    def state(self) -> dict[str, Tensor]:
        """Everything that later updates depend on."""
        state = {"theta": self._flat, "theta_target": self._flat_target}
        for i, moments in self._optimiser.state_dict()["state"].items():
            state |= {f"adam.{i}.{key}": values for key, values in moments.items()}
        return state | {"iterations": torch.tensor(self._iterations)}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Restore the `state` of a learner with the same members."""
        self._flat.copy_(state["theta"])
        self._flat_target.copy_(state["theta_target"])
        adam = self._optimiser.state_dict()
        moments: dict[int, dict[str, Tensor]] = {}
        for name, values in state.items():
            if name.startswith("adam."):
                _, i, key = name.split(".")
                moments.setdefault(int(i), {})[key] = values
        self._optimiser.load_state_dict(adam | {"state": moments})
        self._iterations = int(state["iterations"])


def _layers(flat: Tensor, shapes: dict[str, torch.Size]) -> dict[str, Tensor]:
    """Views of contiguous memory as layers."""
    pieces = torch.split(flat, [shape.numel() for shape in shapes.values()])
    return {name: piece.view(shape) for piece, (name, shape) in zip(pieces, shapes.items(), strict=True)}


def _stacked(parameters: network.Parameters) -> network.Parameters:
    """One network's parameters in the learner's layout: biases as rows, both streams in `head`."""
    own = {name: v[None] if v.ndim == 1 else v for name, v in parameters.items() if "hidden" in name}
    names = ("value", "advantage") if "value.bias" in parameters else ("q",)
    for part in ("weight", "bias"):
        streams = [np.atleast_2d(parameters[f"{name}.{part}"]) for name in names]
        if "q" in names:  # no V: a column of zeros
            streams.insert(0, np.zeros_like(streams[0][:, :1]))
        own[f"head.{part}"] = np.ascontiguousarray(np.concatenate(streams, axis=-1).T)
    return own


def _unstacked(own: network.Parameters, architecture: network.Architecture) -> network.Parameters:
    """The inverse of `_stacked`."""
    rows = {"q": slice(1, None)} if architecture.dueling is None else {}
    rows = rows or {"value": slice(0, 1), "advantage": slice(1, None)}
    parameters = {name: v[0] if name.endswith("bias") else v for name, v in own.items() if "hidden" in name}
    for name, row in rows.items():
        parameters[f"{name}.weight"] = np.ascontiguousarray(own["head.weight"][row].T)
        parameters[f"{name}.bias"] = own["head.bias"][row, 0].copy()
    return parameters
