"""Policy iteration with rollouts: the policy learns which action is worth most if it flies on itself.

Bertsekas and Tsitsiklis, "Neuro-Dynamic Programming", 1996; Lagoudakis and Parr, "Reinforcement Learning as
Classification", ICML 2003. In states that the policy meets all actions are flown for some steps, see
`rollouts`. The network of the advantages is fitted to the differences in J between them, and that of V to J
of the policy's own action. The next iteration flies with the new policy: a detour that only a wiser policy
would make good is seen as the loss that it is. Needs torch.
"""

from collections import deque
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from uav_dc_ros.agents import set_network
from uav_dc_ros.agents.network import Parameters
from uav_dc_ros.agents.set_network import VALUE_SCALE, SetArchitecture
from uav_dc_ros.agents.set_policy import RolloutSettings
from uav_dc_ros.core import entities, mission
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.entities.encoding import PRICE, allowed
from uav_dc_ros.core.grid import Action
from uav_dc_ros.experiments.train.generalist import symmetry
from uav_dc_ros.experiments.train.generalist.rollouts import Situations, action_values, joined
from uav_dc_ros.experiments.train.generalist.set_learner import FALL, SetLearner, active
from uav_dc_ros.experiments.train.generalist.training import GeneralistTraining, Iteration

VALUE, ADVANTAGE = "value", "advantage"
LINEAR_FROM = 3.0  # steps of error from which the loss of the advantages grows linearly (Huber)
_SYMMETRIES = tuple(symmetry.symmetry(number) for number in range(symmetry.N))


class Decisions(NamedTuple):
    """States in which all actions were flown, one row each."""

    observation: Array  # float32 `[R, D]`
    values: Array  # J from now on of each action, float32 `[R, 7]`; NaN of those that are not allowed
    chosen: Array  # the policy's action, integers `[R]`


class RolloutLearner(SetLearner):
    """The networks of V and A, with an optimiser each."""

    def __init__(
        self, architecture: SetArchitecture, parameters: Parameters, settings: RolloutSettings
    ) -> None:
        super().__init__(architecture, parameters, (VALUE, ADVANTAGE))
        self._settings = settings

    def preferences(self, observation: Array) -> Array:
        """A(s, a) in steps, `[B, D]` to `[B, A]`, float32."""
        with torch.inference_mode():
            return self._advantages(torch.from_numpy(observation)).numpy()

    def _advantages(self, observation: Tensor) -> Tensor:
        return set_network.advantages(self.architecture, self.theta, observation, active)

    def fit(self, decisions: Decisions, rows: Array, number: int) -> float:
        """A gradient step with some rows, integers, seen in a symmetry; the squared error of V before it."""
        turned = _SYMMETRIES[number]
        observation = torch.from_numpy(turned.of_observation(decisions.observation[rows]))
        values, chosen = decisions.values[rows], decisions.chosen[rows]
        target = np.take_along_axis(values, chosen[:, None], axis=-1)[:, 0]
        error = set_network.values(self.architecture, self.theta, observation, active)
        error = VALUE_SCALE * (error - torch.from_numpy(target))
        loss = (error * error).mean()
        self.descend(loss, VALUE)
        # In steps, against the policy's own action. Of a user that is lost only a part counts: such
        # differences are rare and random. By how much an action is worse than the limit is left to the plan.
        limit = self._settings.steps_max
        steps = (values - target[:, None]) / decisions.observation[rows, PRICE, None]
        steps = torch.from_numpy(turned.of_actions(steps.clip(-limit, limit)))
        own = torch.from_numpy(np.argsort(turned.action)[chosen])[:, None]
        found = self._advantages(observation)
        found = (found - found.gather(1, own)).clamp(min=-limit)
        mask = ~torch.isnan(steps)
        errors = functional.smooth_l1_loss(found, steps.nan_to_num(), reduction="none", beta=LINEAR_FROM)
        self.descend((errors * mask).sum() / mask.sum(), ADVANTAGE)
        return float(loss.detach()) / VALUE_SCALE**2


class RolloutTraining(GeneralistTraining):
    """A run between two iterations."""

    def __init__(self, settings: RolloutSettings, architecture: SetArchitecture, seed: int) -> None:
        super().__init__(settings, seed)
        self.settings = settings
        start = set_network.initial(architecture, self.generator())
        self.learner: RolloutLearner = RolloutLearner(architecture, start, settings)
        self._recent: deque[Decisions] = deque(maxlen=settings.kept)

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
        decisions = []
        for layout, parts in zip(drawn, tested, strict=True):
            if parts:
                situations = joined([one for one, _ in parts])
                seen = np.concatenate([observation for _, observation in parts])
                values = action_values(layout, situations, seen, self._decide, settings.horizon, rng)
                decisions.append(Decisions(seen, values, self._decide(seen)))
        if decisions:
            self._recent.append(_together(decisions))
        fall = max(1.0 - done, FALL)
        self.learner.set_rate(settings.value_rate * fall, VALUE)
        self.learner.set_rate(settings.advantage_rate * fall, ADVANTAGE)
        losses = []
        if self._recent:
            recent = _together(self._recent)
            n_batches = max(1, min(settings.batches, len(recent.chosen) // settings.batch_size))
            for _ in range(n_batches):
                rows = rng.integers(len(recent.chosen), size=settings.batch_size)
                losses.append(self.learner.fit(recent, rows, int(rng.integers(symmetry.N))))
        n_tested = sum(len(one.chosen) for one in decisions)
        return self.end(flown, sum(losses) / max(len(losses), 1), n_tested)

    def _decide(self, observation: Array) -> Array:
        """The greedy actions for observations `[B, D]`, integers `[B]`."""
        preferences = self.learner.preferences(observation)
        return np.where(allowed(observation), preferences, -np.inf).argmax(axis=-1)

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """See `GeneralistTraining`."""
        arrays, values = super().state()
        for i, decisions in enumerate(self._recent):
            named = decisions._asdict().items()
            arrays |= {f"decisions.{i}.{name}": torch.from_numpy(array) for name, array in named}
        return arrays, values

    def restore(self, arrays: dict[str, Tensor], values: dict[str, Any]) -> None:
        """See `GeneralistTraining`."""
        kept = {name: array for name, array in arrays.items() if name.startswith("decisions.")}
        super().restore({name: array for name, array in arrays.items() if name not in kept}, values)
        for i in range(len(kept) // len(Decisions._fields)):
            named = {name: kept[f"decisions.{i}.{name}"].numpy() for name in Decisions._fields}
            self._recent.append(Decisions(**named))


def _together(parts: "list[Decisions] | deque[Decisions]") -> Decisions:
    """Decisions one after another; observations are padded with zeros to the most clusters."""
    width = max(part.observation.shape[1] for part in parts)
    padded = [np.pad(part.observation, ((0, 0), (0, width - part.observation.shape[1]))) for part in parts]
    others = (np.concatenate([getattr(part, name) for part in parts]) for name in Decisions._fields[1:])
    return Decisions(np.concatenate(padded), *others)
