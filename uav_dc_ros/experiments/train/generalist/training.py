"""The training loop of a generalist: an iteration flies new layouts, and fits the networks to what it flew.

Every random number of an iteration comes from a generator of its own, seeded by run and iteration: what a
training continues with are the parameters, the optimisers and the number of iterations. Needs torch.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from torch import Tensor

from uav_dc_ros import planners
from uav_dc_ros.agents.network import Parameters
from uav_dc_ros.agents.set_policy import FlyingSettings
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.entities.encoding import N_ACTIONS, allowed, planned_action
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.experiments.train.generalist import layouts
from uav_dc_ros.experiments.train.generalist.layouts import SELECTION_LAYOUTS, SELECTION_MISSIONS
from uav_dc_ros.experiments.train.generalist.missions import LayoutMissions

BASELINES = ("nearest", "fixed_tour")
_STREAM = 2  # separates a run's generators from those of other trainings


class Iteration(NamedTuple):
    """Means of an iteration."""

    objective: float  # J of the missions, exploration included
    landed: float  # share of them
    loss: float  # squared error of the returns, in units of J
    decisions: int


class PreferenceLearner(Protocol):
    """Networks and their optimisers."""

    def preferences(self, observation: Array) -> Array:
        """A number for each action, `[B, D]` to `[B, A]`, float32: the policy prefers the highest."""

    def parameters(self) -> Parameters:
        """A copy of the parameters, numpy, as `set_network.shapes` names them."""

    def state(self) -> dict[str, Tensor]:
        """Everything that later updates depend on."""

    def restore(self, state: dict[str, Tensor]) -> None:
        """Restore the `state` of a learner of the same architecture."""


class Flight(NamedTuple):
    """Missions of an iteration before their first step."""

    layouts: Sequence[Scenario]  # L
    weights: Array  # w of the objective of each of B missions, `[L, B]`
    missions: LayoutMissions
    rng: np.random.Generator
    done: float  # share of the iterations before this one


class GeneralistTraining(ABC):
    """A run between two iterations."""

    learner: PreferenceLearner

    def __init__(self, settings: FlyingSettings, seed: int) -> None:
        self._flying, self.seed = settings, seed
        self.curve: list[Iteration] = []
        self._selection: list[Scenario] = []

    @abstractmethod
    def iterate(self) -> Iteration:
        """Fly missions of new layouts to their ends, and fit the networks to them."""

    @property
    def n_done(self) -> int:
        """Iterations up to now."""
        return len(self.curve)

    def begin(self) -> Flight:
        """The missions of the next iteration."""
        settings, rng = self._flying, self.generator(self.n_done)
        first = (self.seed * settings.iterations + self.n_done) * settings.layouts
        drawn = [layouts.draw(layouts.TRAINING_SEEDS.start + first + i) for i in range(settings.layouts)]
        # Most weights are near those that users want.
        weights = 1.0 - rng.random((settings.layouts, settings.missions)) ** 2
        missions = LayoutMissions(drawn, weights, rng)
        return Flight(drawn, weights, missions, rng, self.n_done / settings.iterations)

    def end(self, flown: LayoutMissions, loss: float, decisions: int) -> Iteration:
        """Count an iteration, with its mean `loss` in units of J and its number of decisions."""
        objective, landed = float(flown.objective().mean()), float(flown.landed.mean())
        self.curve.append(Iteration(objective, landed, loss, decisions))
        return self.curve[-1]

    def validate(self) -> float:
        """Mean J of greedy missions in the layouts that select among iterations."""
        return self._fly(lambda flown: self.choices(*flown.observe())[1].argmax(axis=-1))

    def baseline(self, name: str) -> float:
        """Mean J of a planner in the same missions."""
        acts = [planners.PLANNERS[name](layout) for layout in self._layouts()]
        return self._fly(lambda flown: np.stack([act(s) for act, s in zip(acts, flown.states, strict=True)]))

    def plan(self) -> float:
        """Mean J of the plan of the observation in the same missions."""
        return self._fly(lambda flown: planned_action(flown.observe().observation))

    def _fly(self, act: Callable[[LayoutMissions], Array]) -> float:
        places = (np.arange(SELECTION_MISSIONS) + 0.5) / SELECTION_MISSIONS
        weights = np.tile(1.0 - places**2, (SELECTION_LAYOUTS, 1))
        flown = LayoutMissions(self._layouts(), weights, np.random.default_rng(layouts.SELECTION_SEEDS.start))
        while not flown.all_over:
            flown.step(act(flown))
        return float(flown.objective().mean())

    def _layouts(self) -> Sequence[Scenario]:
        if not self._selection:
            self._selection = [layouts.draw(seed) for seed in layouts.SELECTION_SEEDS[:SELECTION_LAYOUTS]]
        return self._selection

    def choices(
        self, observation: Array, flying: Array, of: Callable[[Array], Array] | None = None
    ) -> tuple[Array, Array]:
        """The allowed actions, bool `[R, A]`, and the preferences, minus infinity for others.

        For a mission that is over, all actions are allowed, and their preferences are 0. `of` gives other
        numbers than `preferences`.
        """
        of = of or self.learner.preferences
        mask, preferences = allowed(observation), np.zeros((len(flying), N_ACTIONS), np.float32)
        mask[~flying] = True
        preferences[flying] = of(observation[flying])
        return mask, np.where(mask, preferences, -np.inf)

    def generator(self, *key: int) -> np.random.Generator:
        """The generator of an iteration, or of the run's start."""
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(_STREAM, *key)))

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Everything that later iterations depend on: arrays, and values that JSON can hold."""
        return self.learner.state(), {"curve": self.curve}

    def restore(self, arrays: dict[str, Tensor], values: dict[str, Any]) -> None:
        """Set what `state` returned for the same settings, architecture and seed."""
        self.learner.restore(arrays)
        self.curve = [Iteration(*one) for one in values["curve"]]
