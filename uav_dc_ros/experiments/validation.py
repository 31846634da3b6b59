"""Greedy missions of a population that is still in training: what its policies are worth by now."""

import numpy as np
import torch

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.world import State
from uav_dc_ros.env.batch import observe
from uav_dc_ros.experiments.fly import Missions, fly
from uav_dc_ros.experiments.runs import layout
from uav_dc_ros.experiments.training import Training, rewards

# Missions that choose among runs and checkpoints; those that judge the chosen one are seeds 0 to 99.
VALIDATION_SEEDS = range(1_000_000, 1_000_100)


def fly_greedily(training: Training, seeds: range) -> Missions:
    """Every run's greedy policy on the missions with these seeds, each `[N, S]`.

    A run with an environment of its own starts from that layout; the seed decides how the users walk.
    Every run is paid as it is in training.
    """
    population, learner = training.population, training.learner
    shape = (population.scenario.n_users, 2)
    fixed = [None if run.environment is None else layout(run.environment, shape) for run in population.runs]

    def act(state: State) -> Array:
        seen = torch.from_numpy(observe(population.observation, population.scenario, state))
        return learner.greedy(seen.to(training.device)).cpu().numpy()

    return fly(
        population.scenario,
        act,
        seeds,
        runs=(len(population.runs),),
        layouts=fixed,
        rewards=rewards(population.runs, lambda values: values[:, None]),
    )


def validate(training: Training) -> np.ndarray:
    """Mean number of users that each run brings home in the validation missions, `[N]`.

    A mission that does not land brings nobody home.
    """
    missions = fly_greedily(training, VALIDATION_SEEDS)
    return np.where(missions.landed, missions.users_collected, 0).mean(axis=-1)
