"""Policy improvement with rollouts: the policy learns by how much an action is worth more than the plan's.

Ross and Bagnell, "Reinforcement and Imitation Learning via Interactive No-Regret Learning" (AggreVaTe), 2014;
Bertsekas and Tsitsiklis, "Neuro-Dynamic Programming", 1996. The policy flies. In some of the states that it
meets all actions are flown, and then the plan, see `rollouts`. The network of the advantages is fitted to the
differences in J from the plan's own action, and that of V to J of that action. Since the plan flies on after
each action, a policy that goes to and fro sees every step of that as a loss. Needs torch.
"""

import math
from collections import deque
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from uav_dc_ros.agents import set_network
from uav_dc_ros.agents.network import Parameters
from uav_dc_ros.agents.set_network import VALUE_SCALE, SetArchitecture
from uav_dc_ros.agents.set_policy import RolloutSettings
from uav_dc_ros.core import entities, mission
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.entities.encoding import PRICE, planned_action
from uav_dc_ros.core.grid import Action
from uav_dc_ros.experiments.train.generalist import symmetry
from uav_dc_ros.experiments.train.generalist.rollouts import Situations, action_values, joined
from uav_dc_ros.experiments.train.generalist.set_learner import FALL, SetLearner, active
from uav_dc_ros.experiments.train.generalist.training import GeneralistTraining, Iteration

VALUE, ADVANTAGE = "value", "advantage"
_LAYOUTS_OF_BATCH = 32  # of a mini-batch
_SYMMETRIES = tuple(symmetry.symmetry(number) for number in range(symmetry.N))


class Decisions(NamedTuple):
    """States in which all actions were flown, one row each."""

    observation: Array  # float32 `[R, D]`
    values: Array  # J from now on of each action, float32 `[R, 7]`; NaN of those that are not allowed


class RolloutLearner(SetLearner):
    """The networks of V and A, with an optimiser each."""

    def __init__(
        self, architecture: SetArchitecture, parameters: Parameters, settings: RolloutSettings
    ) -> None:
        super().__init__(architecture, parameters, (VALUE, ADVANTAGE))
        self._settings = settings

    def _advantages(self, observation: Tensor) -> Tensor:
        return set_network.advantages(self.architecture, self.theta, observation, active)

    def fit(self, decisions: Decisions, number: int) -> float:
        """A gradient step, with the decisions seen in a symmetry; the squared error of V before it."""
        turned, settings = _SYMMETRIES[number], self._settings
        planned = planned_action(decisions.observation)[:, None]
        own = np.take_along_axis(decisions.values, planned, axis=-1)
        observation = torch.from_numpy(turned.of_observation(decisions.observation))
        error = set_network.values(self.architecture, self.theta, observation, active)
        error = VALUE_SCALE * (error - torch.from_numpy(own[:, 0]))
        loss = (error * error).mean()
        self.descend(loss, VALUE)
        # In steps, against the plan's action. The mean counts: a loss that grows linearly would make little
        # of users that are rarely lost.
        steps = (decisions.values - own) / decisions.observation[:, PRICE, None] - settings.caution
        np.put_along_axis(steps, planned, 0.0, axis=-1)
        steps = torch.from_numpy(turned.of_actions(steps.clip(-settings.steps_max, settings.steps_max)))
        at = torch.from_numpy(np.argsort(turned.action)[planned])
        found = self._advantages(observation)
        found = (found - found.gather(1, at)).clamp(min=-settings.steps_max)
        mask = ~torch.isnan(steps)
        errors = torch.where(mask, found - steps, 0.0)
        self.descend((errors * errors).sum() / mask.sum() / settings.steps_max, ADVANTAGE)
        return float(loss.detach()) / VALUE_SCALE**2


class RolloutTraining(GeneralistTraining):
    """A run between two iterations."""

    def __init__(self, settings: RolloutSettings, architecture: SetArchitecture, seed: int) -> None:
        super().__init__(settings, seed)
        self.settings = settings
        start = set_network.initial(architecture, self.generator())
        self.learner: RolloutLearner = RolloutLearner(architecture, start, settings)
        # Of one layout in one iteration each.
        self._kept: deque[Decisions] = deque(maxlen=settings.kept * settings.layouts)

    def iterate(self) -> Iteration:
        """See `GeneralistTraining`."""
        settings = self.settings
        drawn, _, flown, rng, done = self.begin()
        tested: list[list[tuple[Situations, Array]]] = [[] for _ in drawn]
        while not flown.all_over:
            observed = flown.observe()
            mask, preferences = self.choices(*observed)
            action = preferences.argmax(axis=-1)
            shape = flown.weights.shape
            waits, flying = (action == Action.HOVER).reshape(shape), observed.flying.reshape(shape)
            for i, (layout, state) in enumerate(zip(drawn, flown.states, strict=True)):
                waits[i] &= mission.at_dock(state.cell, layout.dock_cell)
                rows = np.flatnonzero(flying[i] & ~waits[i] & (rng.random(shape[1]) < settings.tested))
                if len(rows):
                    seen = observed.observation.reshape((*shape, -1))[i, rows, : entities.size(layout)]
                    every = Situations(state=state, weight=flown.weights[i], arrival=flown.arrival[i])
                    tested[i].append((every.take(rows), seen))
            by_chance = (rng.random(mask.shape, np.float32) * mask).argmax(axis=-1)
            flown.step(np.where(rng.random(len(mask)) < settings.random_moves, by_chance, action))
        n_tested = 0
        for layout, parts in zip(drawn, tested, strict=True):
            if parts:
                situations = joined([one for one, _ in parts])
                seen = np.concatenate([observation for _, observation in parts])
                values = action_values(layout, situations, seen, planned_action, settings.horizon, rng)
                self._kept.append(Decisions(seen, values))
                n_tested += len(seen)
        fall = max(1.0 - done, FALL)
        self.learner.set_rate(settings.value_rate * fall, VALUE)
        self.learner.set_rate(settings.advantage_rate * fall, ADVANTAGE)
        n_kept = sum(len(one.values) for one in self._kept)
        n_batches = min(settings.batches, math.ceil(n_kept / settings.batch_size))
        losses = [self.learner.fit(self._batch(rng), int(rng.integers(symmetry.N))) for _ in range(n_batches)]
        return self.end(flown, sum(losses) / max(n_batches, 1), n_tested)

    def _batch(self, rng: np.random.Generator) -> Decisions:
        """Random decisions of random layouts."""
        parts, n_rows = [], math.ceil(self.settings.batch_size / _LAYOUTS_OF_BATCH)
        for place in rng.integers(len(self._kept), size=_LAYOUTS_OF_BATCH):
            one = self._kept[place]
            rows = rng.integers(len(one.values), size=n_rows)
            parts.append(Decisions(*(array[rows] for array in one)))
        width = max(part.observation.shape[1] for part in parts)
        # Padded with zeros to the most clusters.
        padded = [
            np.pad(part.observation, ((0, 0), (0, width - part.observation.shape[1]))) for part in parts
        ]
        return Decisions(np.concatenate(padded), np.concatenate([part.values for part in parts]))

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """See `GeneralistTraining`."""
        arrays, values = super().state()
        for i, decisions in enumerate(self._kept):
            named = decisions._asdict().items()
            arrays |= {f"decisions.{i}.{name}": torch.from_numpy(array) for name, array in named}
        return arrays, values

    def restore(self, arrays: dict[str, Tensor], values: dict[str, Any]) -> None:
        """See `GeneralistTraining`."""
        kept = {name: array for name, array in arrays.items() if name.startswith("decisions.")}
        super().restore({name: array for name, array in arrays.items() if name not in kept}, values)
        for i in range(len(kept) // len(Decisions._fields)):
            named = {name: kept[f"decisions.{i}.{name}"].numpy() for name in Decisions._fields}
            self._kept.append(Decisions(**named))
