"""Many Gymnasium environments in one step, over the same core."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.error import InvalidAction, ResetNeeded
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.observations import Observation
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.core.users.service import ServiceRecord
from uav_dc_ros.core.world import BatchWorld
from uav_dc_ros.env.gym_env import ACTIONS_TEXT, info, prepare


class DataCollectionVectorEnv(VectorEnv[Array, Array, Array]):
    """`num_envs` environments like `DataCollectionEnv`, stepped as arrays.

    A mission that has ended restarts at the next step (`AutoresetMode.NEXT_STEP`), which ignores its action
    and gives reward 0. Environment i draws from its own generator exactly as a single one does:
    `reset(seed=s)` gives it seed s + i. Keys of `info` are those of the single environment, `[num_envs,
    ...]`, each with its mask `_key`; those of the end of a mission are there when a mission has ended.
    """

    # Gymnasium declares it as an instance variable.
    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 1,
        scenario: str | Path | Scenario = "five_clusters",
        observation: Observation = "mission",
        render_mode: str | None = None,
    ) -> None:
        if render_mode is not None:
            raise ValueError(f"render_mode is {render_mode!r}; expected None: only a single one renders")
        self.num_envs, self.observation, self.render_mode = num_envs, observation, render_mode
        self.scenario, self.single_observation_space, self.single_action_space = prepare(
            scenario, observation, render_mode
        )
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._rngs = [seeding.np_random()[0] for _ in range(num_envs)]
        self._over = np.zeros(num_envs, bool)
        self._batch: BatchWorld | None = None

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start every mission; of a list of seeds, None keeps that environment's generator."""
        seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int) else seed
        if seeds is not None:
            if len(seeds) != self.num_envs:
                raise ValueError(f"seed has {len(seeds)} entries; expected num_envs = {self.num_envs}")
            for i, one in enumerate(seeds):
                if one is not None:
                    self._rngs[i] = seeding.np_random(one)[0]
        self._over = np.zeros(self.num_envs, bool)
        self._batch = BatchWorld(self.scenario, self._draws())
        self._service = ServiceRecord(np.zeros((self.num_envs, self.scenario.n_users)))
        return self._batch.observe(self.observation), self._masked(info(self.scenario, self._batch.state))

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Fly one step of every mission, or restart it; see the class."""
        if self._batch is None:
            raise ResetNeeded("step() before the first episode; expected a call of reset() first")
        actions = np.asarray(actions)
        if not self.action_space.contains(actions):
            raise InvalidAction(
                f"actions are {actions!r}; expected {self.num_envs} integers, each one of {ACTIONS_TEXT}"
            )
        restarted, draws = self._over, self._draws()
        outcome = self._batch.step(np.where(restarted, Action.HOVER, actions), draws)
        infos = info(self.scenario, self._batch.state, outcome)
        state = self._batch.state
        self._service.add(state.step, outcome.link.served, state.collected)
        if restarted.any():
            self._batch.restart(restarted, draws)
            self._service.restart(restarted)
            initial = info(self.scenario, self._batch.state)
            for key, values in infos.items():
                values[restarted] = initial[key][restarted]
        terminated, truncated = outcome.terminated & ~restarted, outcome.truncated & ~restarted
        self._over = terminated | truncated
        infos = self._masked(infos)
        if self._over.any():
            for key, values in self._service.figures(self.scenario, state.data_bits).items():
                infos |= {key: values, f"_{key}": self._over}
        reward = np.where(restarted, 0.0, outcome.reward)
        return self._batch.observe(self.observation), reward, terminated, truncated, infos

    def _draws(self) -> Array:
        return np.stack([rng.random(self.scenario.draws_shape) for rng in self._rngs])

    def _masked(self, infos: dict[str, Any]) -> dict[str, Any]:
        return infos | {f"_{key}": np.ones(self.num_envs, bool) for key in infos}
