"""Proximal policy optimisation of the plan's decisions. Needs torch.

Schulman et al., "Proximal Policy Optimization Algorithms", 2017, with advantages by Schulman et al.,
"High-Dimensional Continuous Control Using Generalized Advantage Estimation", ICLR 2016.

The probability of an action is the softmax of the advantages in steps (`set_network.advantages`), which at
the start are those of the plan. So it explores among actions between which the plan hardly distinguishes,
and learns what the plan does not know. V is fitted to the lambda-returns by an optimiser of its own.

Deviations: a batch holds whole missions, so no return is cut off, and is passed over once.
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from uav_dc_ros.agents import set_network
from uav_dc_ros.agents.network import Parameters
from uav_dc_ros.agents.set_network import VALUE_SCALE, SetArchitecture
from uav_dc_ros.agents.set_policy import PpoSettings
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.entities.encoding import allowed
from uav_dc_ros.experiments.train.generalist.set_learner import FALL, SetLearner, active
from uav_dc_ros.experiments.train.generalist.training import GeneralistTraining, Iteration

VALUE, ADVANTAGE = "value", "advantage"
USER_SHARE = 0.1  # of a user's worth, which a unit of the advantages is beside a step's


class PpoBatch(NamedTuple):
    """Decisions of missions, one row each."""

    observation: Array  # float32 `[R, D]`
    action: Array  # integers `[R]`
    log_probability: Array  # of the action when it was chosen, float32 `[R]`
    target: Array  # for V, in units of J, float32 `[R]`
    advantage: Array  # of the action, in units that are alike for all weights, float32 `[R]`


class PpoLearner(SetLearner):
    """The networks of V and A, with an optimiser each."""

    def __init__(self, architecture: SetArchitecture, parameters: Parameters, settings: PpoSettings) -> None:
        super().__init__(architecture, parameters, (VALUE, ADVANTAGE))
        self._settings = settings

    def preferences(self, observation: Array) -> Array:
        """A(s, a) in steps, `[B, D]` to `[B, A]`, float32."""
        with torch.inference_mode():
            return self._advantages(torch.from_numpy(observation)).numpy()

    def values(self, observation: Array) -> Array:
        """V(s) in units of J, `[B, D]` to `[B]`, float32."""
        with torch.inference_mode():
            return self._values(torch.from_numpy(observation)).numpy()

    def _advantages(self, observation: Tensor) -> Tensor:
        return set_network.advantages(self.architecture, self.theta, observation, active)

    def _values(self, observation: Tensor) -> Tensor:
        return set_network.values(self.architecture, self.theta, observation, active)

    def fit(self, batch: PpoBatch, order: Array, learns_advantages: bool) -> float:
        """Gradient steps on mini-batches in an order `[R]`; the mean squared error of V before them."""
        losses = []
        scale = float(batch.advantage.std()) + 1e-8
        for part in np.array_split(order, max(1, round(len(order) / self._settings.batch_size))):
            observation, action, before, target, advantage = (torch.from_numpy(v[part]) for v in batch)
            error = VALUE_SCALE * (self._values(observation) - target)
            loss = (error * error).mean()
            self.descend(loss, VALUE)
            losses.append(float(loss.detach()) / VALUE_SCALE**2)
            if learns_advantages:
                self.descend(self._surrogate(observation, action, before, advantage / scale), ADVANTAGE)
        return sum(losses) / len(losses)

    def _surrogate(self, observation: Tensor, action: Tensor, before: Tensor, advantage: Tensor) -> Tensor:
        settings, mask = self._settings, allowed(observation)
        learnt = set_network.stream("advantage", self.architecture, self.theta, observation, active)
        steps = learnt - set_network.plan_loss(self.architecture, observation)
        logits = (settings.sharpness * steps).masked_fill(~mask, -torch.inf)
        chosen = functional.log_softmax(logits, dim=1).gather(1, action[:, None])[:, 0]
        by_chance = settings.random_moves / mask.sum(dim=1)
        now = torch.logaddexp(chosen + math.log(1.0 - settings.random_moves), by_chance.log())
        ratio = (now - before).exp()
        clipped = ratio.clamp(1.0 - settings.clip, 1.0 + settings.clip)
        surrogate = torch.minimum(ratio * advantage, clipped * advantage).mean()
        differs = learnt - learnt.mean(dim=1, keepdim=True)
        return settings.restraint * (differs * differs).mean() - surrogate


class PpoTraining(GeneralistTraining):
    """A run between two iterations."""

    def __init__(self, settings: PpoSettings, architecture: SetArchitecture, seed: int) -> None:
        super().__init__(settings, seed)
        self.settings = settings
        start = set_network.initial(architecture, self.generator())
        self.learner: PpoLearner = PpoLearner(architecture, start, settings)

    def iterate(self) -> Iteration:
        """See `GeneralistTraining`."""
        settings = self.settings
        drawn, weights, flown, rng, done = self.begin()
        n_users = np.asarray([layout.n_users for layout in drawn])[:, None]
        n_steps = np.asarray([layout.mission.max_steps for layout in drawn])[:, None]
        unit = ((1.0 - weights) / n_steps + USER_SHARE * weights / n_users).reshape(-1).astype(np.float32)
        flight: list[tuple[Array, ...]] = []
        while not flown.all_over:
            observed = flown.observe()
            mask, preferences = self.choices(*observed)
            value = np.zeros(len(mask), np.float32)
            value[observed.flying] = self.learner.values(observed.observation[observed.flying])
            probability = self._probabilities(mask, preferences)
            sums = probability.cumsum(axis=-1)  # the last may differ from 1 by rounding
            chance = rng.random((len(mask), 1), np.float32) * sums[:, -1:]
            action = (sums > chance).argmax(axis=-1)
            chosen = np.take_along_axis(probability, action[:, None], axis=-1)[:, 0]
            flight.append((*observed, action, np.log(chosen), value, *flown.step(action)))
        observation, flying, action, chosen, value, reward, over = map(np.stack, zip(*flight, strict=True))
        advantage = generalised_advantages(reward, over, value, settings.trace)
        every = observation, action, chosen, advantage + value, advantage / unit
        batch = PpoBatch(*(values[flying] for values in every))
        fall = max(1.0 - done, FALL)
        self.learner.set_rate(settings.value_rate * fall, VALUE)
        self.learner.set_rate(settings.advantage_rate * fall, ADVANTAGE)
        loss = self.learner.fit(batch, rng.permutation(len(batch.action)), done >= settings.value_only)
        return self.end(flown, loss, len(batch.action))

    def _probabilities(self, mask: Array, preferences: Array) -> Array:
        logits = np.float32(self.settings.sharpness) * preferences
        powers = np.exp(logits - logits.max(axis=-1, keepdims=True))
        share = np.float32(self.settings.random_moves)
        by_chance = mask / mask.sum(axis=-1, keepdims=True, dtype=np.float32)
        return (1 - share) * powers / powers.sum(axis=-1, keepdims=True) + share * by_chance


def generalised_advantages(reward: Array, over: Array, value: Array, trace: float) -> Array:
    """Advantages of missions, `[T, B]`: A_t = r_t + V(s_{t+1}) - V(s_t) + trace A_{t+1}.

    Behind the step with which a mission is `over`, bool `[T, B]`, nothing counts. `value` `[T, B]` is V(s_t).
    """
    advantages, after = np.zeros_like(value), np.zeros_like(value[0])
    for t in reversed(range(len(reward))):
        following = value[t + 1] if t + 1 < len(reward) else np.zeros_like(after)
        later = following + np.float32(trace) * after
        after = advantages[t] = reward[t] - value[t] + np.where(over[t], np.float32(0.0), later)
    return advantages
