"""Training: N runs side by side, read from top to bottom.

Needs torch. Every random number of a run comes from the run's own numpy generator, so a run learns the
same alone and among others, and starts the same on every device.
"""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from uav_dc_ros.agents import network
from uav_dc_ros.agents.dqn import Learner
from uav_dc_ros.agents.policy import PolicyConfig
from uav_dc_ros.agents.replay import ReplayBuffer, Transitions
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.env.batch import BatchWorld, observe
from uav_dc_ros.experiments.fly import fly

# Missions that choose among runs and checkpoints; those that judge the chosen one are seeds 0 to 99.
VALIDATION_SEEDS = range(1_000_000, 1_000_100)
# Makes a run's stream another one than that of the mission with the same seed.
_TRAINING_STREAM = 1
# Episodes of each run that the figures of a `Report` look back on.
_LATEST = 20


@dataclass(frozen=True, kw_only=True)
class Report:
    """How training stands after an episode; means are over all runs and their latest episodes.

    Attributes:
        episode: episodes flown by each run.
        mean_return: what the agents were paid in an episode.
        users_collected: users collected.
        landing_rate: share of episodes that landed.
        score: best validation score until now: mean number of users collected, where a mission that
            did not land counts as none; NaN before the first validation.
        best: parameters with that score, of one network; only in the report that follows the
            validation which found them.
        run: index of the run they are from.
    """

    episode: int
    mean_return: float
    users_collected: float
    landing_rate: float
    score: float
    best: network.Parameters | None
    run: int


class Draws:
    """Uniform draws in [0, 1) of every run for one iteration, each run from its own generator."""

    def __init__(self, rngs: list[np.random.Generator], n_users: int, batch_size: int, device: torch.device):
        self._rngs = rngs
        self._shape = (len(rngs), n_users, 2)
        self._sizes = [2 * n_users, 2 * n_users, 1, 1, batch_size]
        self._device = device

    def next(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Draws for users' steps and for fresh starts `[N, U, 2]`, explore, choice `[N]`, replay `[N, B]`."""
        rows = np.stack([rng.random(sum(self._sizes), dtype=np.float32) for rng in self._rngs])
        walk, restart, explore, choice, replay = torch.split(
            torch.from_numpy(rows).to(self._device), self._sizes, 1
        )
        return walk.reshape(self._shape), restart.reshape(self._shape), explore[:, 0], choice[:, 0], replay


def train(
    config: PolicyConfig, scenario: Scenario, n_runs: int, validate_every: int, device: torch.device
) -> Iterator[Report]:
    """Trains a population, with seeds `config.seed`, `config.seed + 1`, ...

    Args:
        config: algorithm, observation, hyperparameters and the first seed.
        scenario: the world, as in `config.scenario`.
        n_runs: N.
        validate_every: episodes between two validations.
        device: where to compute.

    Yields:
        A report after every episode.
    """
    values = config.hyperparameters
    architecture = config.architecture(scenario)
    rngs = [
        np.random.default_rng(np.random.SeedSequence(config.seed + run, spawn_key=(_TRAINING_STREAM,)))
        for run in range(n_runs)
    ]
    learner = Learner(architecture, values, rngs, device)
    buffer = ReplayBuffer(n_runs, values.buffer_size, architecture.n_inputs, device)
    draws = Draws(rngs, scenario.n_users, values.batch_size, device)
    worlds = BatchWorld(scenario, draws.next()[1])
    observation = worlds.observe(config.observation)
    paid = torch.zeros(n_runs, device=device)
    latest: deque[Tensor] = deque(maxlen=_LATEST)
    score = float("nan")

    for episode in range(1, values.episodes + 1):
        # An episode is max_steps iterations; under `on_arrival` a run may fit several missions into it.
        for _ in range(scenario.mission.max_steps):
            walk, restart, explore, choice, replay = draws.next()
            action = learner.act(observation, explore, choice)
            outcome = worlds.step(action, walk)
            next_observation = worlds.observe(config.observation)
            buffer.add(Transitions(observation, action, outcome.reward, next_observation, outcome.terminated))
            learner.update(buffer.sample(replay))
            paid = paid + outcome.reward
            over = outcome.terminated | outcome.truncated
            if over.any():
                users_collected = worlds.state.collected.sum(-1)
                latest.append(torch.stack([paid, users_collected, outcome.landed], dim=-1)[over].mean(0))
                paid = torch.where(over, 0.0, paid)
                worlds.restart(over, restart)
                next_observation = worlds.observe(config.observation)
            observation = next_observation

        best, run = None, 0
        if episode % validate_every == 0 or episode == values.episodes:
            candidates = learner.parameters()
            scores = validate(config, scenario, candidates, n_runs)
            if not scores.max() <= score:
                run, score = int(scores.argmax()), float(scores.max())
                best = {name: arrays[run] for name, arrays in candidates.items()}
        means = torch.stack(list(latest)).mean(0).tolist() if latest else [float("nan")] * 3
        yield Report(
            episode=episode,
            mean_return=means[0],
            users_collected=means[1],
            landing_rate=means[2],
            score=score,
            best=best,
            run=run,
        )


def validate(
    config: PolicyConfig, scenario: Scenario, parameters: network.Parameters, n_runs: int
) -> np.ndarray:
    """Mean number of users brought home by each run's greedy policy on the validation seeds, `[N]`."""
    architecture = config.architecture(scenario)
    missions = fly(
        scenario,
        lambda state: network.q_values(
            architecture, parameters, observe(config.observation, scenario, state)
        ).argmax(-1),
        VALIDATION_SEEDS,
        runs=(n_runs,),
    )
    return np.where(missions.landed, missions.users_collected, 0).mean(axis=-1)
