"""Greedy missions of a population that is still in training: what its policies are worth by now."""

from typing import NamedTuple

import numpy as np
import torch

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.batch import observe
from uav_dc_ros.core.world import State
from uav_dc_ros.experiments.evaluate.rollout import Missions, roll_out
from uav_dc_ros.experiments.train.population import layout
from uav_dc_ros.experiments.train.training import Training, rewards

# Missions that choose among runs and checkpoints; those that judge the chosen one are seeds 0 to 99.
VALIDATION_SEEDS = range(1_000_000, 1_000_100)
# What all of the battery is worth, in shares of the users.
_BATTERY = 0.1


def roll_out_greedily(training: Training, seeds: range) -> Missions:
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

    return roll_out(
        population.scenario,
        act,
        seeds,
        layouts=fixed,
        rewards=rewards(population.runs, lambda values: values[:, None]),
    )


class Validation(NamedTuple):
    """What each run's policy is worth, `[N]` each.

    Attributes:
        brought_home: mean number of users; a mission that does not land brings nobody home.
        merit: what policies are chosen by: the share of the users that they bring home, less a tenth of the
            share of the battery that is spent when they are at the dock for good. So a hundredth of the
            users is worth a tenth of the battery.
    """

    brought_home: np.ndarray
    merit: np.ndarray


def validate(training: Training) -> Validation:
    """Flies the validation missions with every run's greedy policy."""
    scenario, missions = training.population.scenario, roll_out_greedily(training, VALIDATION_SEEDS)
    brought_home = np.where(missions.landed, missions.users_collected, 0).mean(axis=-1)
    max_steps = scenario.mission.max_steps
    spent = np.where(missions.landed, missions.arrival_step, max_steps).mean(axis=-1) / max_steps
    return Validation(brought_home, brought_home / scenario.n_users - _BATTERY * spent)
