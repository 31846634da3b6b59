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

from uav_dc_ros import planners
from uav_dc_ros.agents import set_network
from uav_dc_ros.agents.set_network import SetArchitecture
from uav_dc_ros.agents.set_policy import PqnSettings
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.entities.encoding import allowed
from uav_dc_ros.experiments.train.generalist.set_learner import FALL, SetLearner, active
from uav_dc_ros.experiments.train.generalist.training import GeneralistTraining, Iteration

DEMONSTRATOR = "fixed_tour"
PREFERRED_FROM = 0.5  # weight of the objective from which a tour of all clusters is to be preferred
REWARD_SCALE = 10.0  # J lies in [0, 1]; errors of a tenth of that are large
MARGIN = 0.1  # of a demonstrated action over others, in units of the returns


class Batch(NamedTuple):
    """Decisions of missions, one row each."""

    observation: Array  # float32 `[R, D]`
    action: Array  # integers `[R]`
    target: Array  # float32 `[R]`
    demonstrated: Array  # the action is a planner's, which is to be preferred, bool `[R]`


class PqnLearner(SetLearner):
    """One Q-network for sets and its optimiser."""

    def q_values(self, observation: Array) -> Array:
        """Q(s, a) in tenths of J, `[B, D]` to `[B, A]`, float32."""
        with torch.inference_mode():
            return self._q(torch.from_numpy(observation)).numpy()

    def _q(self, observation: Tensor) -> Tensor:
        return REWARD_SCALE * set_network.q_values(self.architecture, self.theta, observation, active)

    def fit(self, batch: Batch, order: Array, rows: int, learning_rate: float) -> float:
        """Gradient steps on mini-batches of `rows` rows in an order `[R]`; their mean squared error."""
        self.set_rate(learning_rate)
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
            self.descend(loss)
            losses.append(float(squares.detach()))
        return sum(losses) / len(losses)


class PqnTraining(GeneralistTraining):
    """A run between two iterations."""

    def __init__(self, settings: PqnSettings, architecture: SetArchitecture, seed: int) -> None:
        super().__init__(settings, seed)
        self.settings = settings
        self.learner: PqnLearner = PqnLearner(
            architecture, set_network.initial(architecture, self.generator())
        )

    def iterate(self) -> Iteration:
        """See `GeneralistTraining`."""
        settings = self.settings
        drawn, weights, flown, rng, done = self.begin()
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
            mask, q_values = self.choices(*observed, of=self.learner.q_values)
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
        returns = lambda_returns(
            np.float32(REWARD_SCALE) * reward, over, best, settings.trace, settings.discount
        )
        target = returns - np.float32(settings.advantage) * gap
        batch = Batch(*(values[flying] for values in (observation, action, target, shows)))
        rate = settings.learning_rate * max(1.0 - done, FALL)
        losses = [
            self.learner.fit(batch, rng.permutation(len(batch.action)), settings.batch_size, rate)
            for _ in range(settings.epochs)
        ]
        loss = sum(losses) / len(losses) / REWARD_SCALE**2
        return self.end(flown, loss, len(batch.action))


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
