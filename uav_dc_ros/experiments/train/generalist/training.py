"""The training loop of a generalist: an iteration flies new layouts, and fits the network to what it flew.

Every random number of an iteration comes from a generator of its own, seeded by run and iteration: what a
training continues with are the parameters, the optimiser and the number of iterations. Needs torch.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from uav_dc_ros import planners
from uav_dc_ros.agents import set_network
from uav_dc_ros.agents.set_policy import PqnSettings
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.entities.encoding import N_ACTIONS, allowed
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.experiments.train.generalist import layouts
from uav_dc_ros.experiments.train.generalist.layouts import SELECTION_LAYOUTS, SELECTION_MISSIONS
from uav_dc_ros.experiments.train.generalist.missions import LayoutMissions
from uav_dc_ros.experiments.train.generalist.pqn import Batch, PqnLearner, lambda_returns

DEMONSTRATOR = "fixed_tour"
BASELINES = ("nearest", DEMONSTRATOR)
PREFERRED_FROM = 0.5  # weight of the objective from which a tour of all clusters is to be preferred
_REWARD_SCALE = np.float32(10.0)  # J lies in [0, 1]; errors of a tenth of that are large
_STREAM = 2  # separates a run's generators from those of other trainings


class Iteration(NamedTuple):
    """Means of an iteration."""

    objective: float  # J of the missions, exploration included
    landed: float  # share of them
    loss: float  # squared error of the returns, in units of J
    decisions: int


class GeneralistTraining:
    """A run between two iterations."""

    def __init__(self, settings: PqnSettings, architecture: set_network.SetArchitecture, seed: int) -> None:
        self.settings, self.seed = settings, seed
        self.curve: list[Iteration] = []
        self.learner = PqnLearner(architecture, set_network.initial(architecture, self._generator()))
        self._selection: list[Scenario] = []

    @property
    def n_done(self) -> int:
        """Iterations up to now."""
        return len(self.curve)

    def iterate(self) -> Iteration:
        """Fly missions of new layouts to their ends, and fit the network to their returns."""
        settings, done, rng = (
            self.settings,
            self.n_done / self.settings.iterations,
            self._generator(self.n_done),
        )
        first = (
            layouts.TRAINING_SEEDS.start + (self.seed * settings.iterations + self.n_done) * settings.layouts
        )
        drawn = [layouts.draw(first + i) for i in range(settings.layouts)]
        # Most weights are near those that users want.
        weights = 1.0 - rng.random((settings.layouts, settings.missions)) ** 2
        flown = LayoutMissions(drawn, weights, rng)
        rest = max(0.0, 1.0 - done / settings.shown)  # of the iterations in which the share falls
        share = rest * settings.demonstrations + (1.0 - rest) * settings.demonstrations_end
        # Planning the tours of a layout takes as long as flying its missions.
        n_toured = round(share * settings.layouts)
        tours = [planners.PLANNERS[DEMONSTRATOR](layout) for layout in drawn[:n_toured]]
        n_shown = n_toured * settings.missions
        epsilon = settings.epsilon + done * (settings.epsilon_end - settings.epsilon)
        steps: list[tuple[Array, ...]] = []
        while not flown.all_over:
            observed = flown.observe()
            mask, q_values = self._choices(*observed)
            drawn_action = (rng.random(mask.shape, np.float32) * mask).argmax(axis=-1)
            explore = rng.random(len(mask), np.float32) >= epsilon
            action = np.where(explore, drawn_action, q_values.argmax(axis=-1))
            follows = np.zeros(len(mask), bool)
            if n_toured:
                states = flown.states[:n_toured]
                toured = np.concatenate([act(one) for act, one in zip(tours, states, strict=True)])
                lands = np.take_along_axis(mask[:n_shown], toured[:, None], axis=-1)[:, 0]
                follows[:n_shown] = ~explore[:n_shown] & lands
                action[:n_shown] = np.where(follows[:n_shown], toured, action[:n_shown])
            best = q_values.max(axis=-1)
            gap = best - np.take_along_axis(q_values, action[:, None], axis=-1)[:, 0]
            stepped = flown.step(action)
            follows &= weights.reshape(-1) >= PREFERRED_FROM
            steps.append((*observed, action, follows, best, gap, *stepped))
        observation, flying, action, shows, best, gap, reward, over = map(np.stack, zip(*steps, strict=True))
        returns = lambda_returns(_REWARD_SCALE * reward, over, best, settings.trace, settings.discount)
        target = returns - np.float32(settings.advantage) * gap
        batch = Batch(*(values[flying] for values in (observation, action, target, shows)))
        rate = settings.learning_rate * max(1.0 - done, 0.02)
        losses = [
            self.learner.fit(batch, rng.permutation(len(batch.action)), settings.batch_size, rate)
            for _ in range(settings.epochs)
        ]
        self.curve.append(
            Iteration(
                objective=float(flown.objective().mean()),
                landed=float(flown.landed.mean()),
                loss=sum(losses) / len(losses) / float(_REWARD_SCALE) ** 2,
                decisions=len(batch.action),
            )
        )
        return self.curve[-1]

    def validate(self) -> float:
        """Mean J of greedy missions in the layouts that select among iterations."""
        return self._fly(lambda flown: self._choices(*flown.observe())[1].argmax(axis=-1))

    def baseline(self, name: str) -> float:
        """Mean J of a planner in the same missions."""
        acts = [planners.PLANNERS[name](layout) for layout in self._layouts()]
        return self._fly(lambda flown: np.stack([act(s) for act, s in zip(acts, flown.states, strict=True)]))

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

    def _choices(self, observation: Array, flying: Array) -> tuple[Array, Array]:
        """The allowed actions, bool `[R, A]`, and their Q-values, minus infinity for others.

        For a mission that is over, all actions are allowed, and their Q-values are 0.
        """
        mask, q_values = allowed(observation), np.zeros((len(flying), N_ACTIONS), np.float32)
        mask[~flying] = True
        q_values[flying] = self.learner.q_values(observation[flying])
        return mask, np.where(mask, q_values, -np.inf)

    def _generator(self, *key: int) -> np.random.Generator:
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(_STREAM, *key)))

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Everything that later iterations depend on: arrays, and values that JSON can hold."""
        return self.learner.state(), {"curve": self.curve}

    def restore(self, arrays: dict[str, Tensor], values: dict[str, Any]) -> None:
        """Set what `state` returned for the same settings, architecture and seed."""
        self.learner.restore(arrays)
        self.curve = [Iteration(*one) for one in values["curve"]]
