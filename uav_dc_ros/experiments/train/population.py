"""Runs, and populations of runs that train in one batch. Needs no torch."""

from typing import Annotated

import msgspec
import numpy as np
from msgspec import UNSET, Meta

from uav_dc_ros.agents import network
from uav_dc_ros.agents.policy import Algorithm, Hyperparameters
from uav_dc_ros.core import observations
from uav_dc_ros.core.grid import ACTION_LABELS
from uav_dc_ros.core.observations import Observation
from uav_dc_ros.core.scenario import RewardSettings, Scenario
from uav_dc_ros.errors import TrainingError


class Run(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """All values in which runs of a population may differ."""

    seed: Annotated[int, Meta(ge=0)]  # of the run's own generator, the source of all its random numbers
    # Seed of the mission whose initial users start every mission; None for a fresh layout in every mission.
    environment: Annotated[int, Meta(ge=0)] | None = None
    algorithm: Algorithm
    aggregation: network.Aggregation = "mean"  # what a dueling network subtracts; unused by a plain one
    reward: RewardSettings
    hyperparameters: Hyperparameters


class Population(msgspec.Struct, frozen=True, kw_only=True):
    """Runs that train in one batch: they share what gives the arrays their shapes."""

    scenario: Scenario  # of every run; its `reward` is not used
    observation: Observation
    hidden: tuple[int, ...]  # units of each hidden layer
    runs: tuple[Run, ...]

    def __post_init__(self) -> None:
        """Raises TrainingError for no runs, runs that cannot share a batch, or no such observation."""
        if (problem := observations.problem(self.observation, self.scenario)) is not None:
            raise TrainingError(problem)
        if not self.runs:
            raise TrainingError("a population has 0 runs; expected at least 1")
        for name in ("episodes", "buffer_size", "target_every", "n_step"):
            found = {getattr(run.hyperparameters, name) for run in self.runs}
            values = sorted(1 if value is UNSET else value for value in found)
            if len(values) > 1:
                raise TrainingError(
                    f"{name} of the runs of a population is {values}; expected one value for all"
                )

    @property
    def n_episodes(self) -> int:
        """Episodes of each run."""
        return self.runs[0].hyperparameters.episodes


def layout(environment: int, shape: tuple[int, int]) -> np.ndarray:
    """Draws for the initial users, float32 `[U, D]`: those of the mission whose seed is `environment`."""
    return np.random.default_rng(environment).random(shape).astype(np.float32)


def architecture(population: Population, run: Run) -> network.Architecture:
    """Sizes of a run's network."""
    return network.Architecture(
        n_inputs=observations.size(population.observation, population.scenario),
        hidden=population.hidden,
        n_actions=len(ACTION_LABELS),
        dueling=run.aggregation if run.algorithm.startswith("dueling") else None,
    )
