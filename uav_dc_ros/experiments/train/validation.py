"""Validation: greedy missions of a population in training."""

from typing import NamedTuple

import numpy as np
import torch

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.world import State, observe
from uav_dc_ros.experiments.evaluate.rollout import Missions, roll_out
from uav_dc_ros.experiments.train.population import layout
from uav_dc_ros.experiments.train.training import Training, rewards

# Missions that select among runs and checkpoints; seeds 0 to 99 evaluate the selected one.
VALIDATION_SEEDS = range(1_000_000, 1_000_100)
_BATTERY_WEIGHT = 0.1  # of the whole battery, relative to all users


def roll_out_greedily(training: Training, seeds: range) -> Missions:
    """Every run's greedy policy on the missions with these seeds, with the run's own reward, each `[N, S]`.

    A run with an environment starts from its layout; the seed decides how the users walk.
    """
    population, learner = training.population, training.learner
    shape = (population.scenario.n_users, 2)
    fixed = [None if run.environment is None else layout(run.environment, shape) for run in population.runs]

    def act(state: State) -> Array:
        observation = torch.from_numpy(observe(population.observation, population.scenario, state))
        return learner.greedy(observation.to(training.device)).cpu().numpy()

    own = rewards(population.runs, lambda values: values[:, None])
    return roll_out(population.scenario, act, seeds, layouts=fixed, rewards=own)


class Validation(NamedTuple):
    """Scores of each run's policy, `[N]` each."""

    brought_home: np.ndarray  # mean number of users collected; 0 for a mission that does not land
    # Selects the policy: the share of users brought home, less a tenth of the share of the battery spent on
    # arrival. A hundredth of the users weighs as much as a tenth of the battery.
    selection_score: np.ndarray


def validate(training: Training) -> Validation:
    """Flies the validation missions with every run's greedy policy."""
    scenario, missions = training.population.scenario, roll_out_greedily(training, VALIDATION_SEEDS)
    brought_home = np.where(missions.landed, missions.users_collected, 0).mean(axis=-1)
    max_steps = scenario.mission.max_steps
    spent = np.where(missions.landed, missions.arrival_step, max_steps).mean(axis=-1) / max_steps
    return Validation(brought_home, brought_home / scenario.n_users - _BATTERY_WEIGHT * spent)
