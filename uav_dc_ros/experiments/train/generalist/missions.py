"""Missions of many layouts side by side, with rewards that add up to the objective J. Needs no torch."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from uav_dc_ros.core import mission, objective
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.entities.encoding import CLUSTER, GLOBAL
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.core.world import BatchWorld, State


class Observed(NamedTuple):
    """One step of L layouts with B missions each, `[L B]`."""

    observation: Array  # `entities`, float32 `[L B, D]`, padded with zeros to the most clusters
    flying: Array  # bool; the rest of a mission that is over is no data


class StepRewards(NamedTuple):
    """What a step gave, `[L B]` each."""

    reward: Array
    over: Array  # the mission ended with this step, or before


class LayoutMissions:
    """B missions in each of L layouts, which start together.

    The reward of a step is w / U for each user collected, less (1 - w) / T_cons for the step, until the UAV
    is over the dock; a UAV that leaves the dock again pays for the steps that it was there. So the rewards of
    a mission that lands add up to its J, less a constant of the mission. Without a landing J is 0, and what
    was paid is taken back at the end.
    """

    def __init__(self, layouts: Sequence[Scenario], weights: Array, rng: np.random.Generator) -> None:
        """Missions before their first step; `weights` `[L, B]` are w of the objective of each mission."""
        self.layouts, self._rng = layouts, rng
        self.weights = np.asarray(weights, np.float32)
        self._n = self.weights.shape[1]
        self._worlds = [BatchWorld(layout, self._draws(layout)) for layout in layouts]
        self._size = GLOBAL + CLUSTER * max(layout.n_clusters for layout in layouts)
        shape = self.weights.shape
        self._over = np.zeros(shape, bool)
        self._docked = np.zeros(shape, np.float32)  # steps over the dock up to now
        self._paid = np.zeros(shape, np.float32)  # sum of the rewards
        self.landed, self.arrival = np.zeros(shape, bool), np.full(shape, np.nan, np.float32)
        self.users = np.zeros(shape, np.float32)  # collected

    @property
    def states(self) -> list[State]:
        """The missions of each layout, `[B, ...]`."""
        return [world.state for world in self._worlds]

    def observe(self) -> Observed:
        """The missions before their next step."""
        observation = np.zeros((*self._over.shape, self._size), np.float32)
        for i, world in enumerate(self._worlds):
            if self._over[i].all():
                observation[i, :, GLOBAL] = 1.0  # a network divides by the number of clusters
            else:
                seen = world.observe("entities", self.weights[i])
                observation[i, :, : seen.shape[-1]] = seen
        return Observed(observation.reshape(-1, self._size), ~self._over.reshape(-1))

    def step(self, action: Array) -> StepRewards:
        """Fly a step of every mission with actions, integers `[L B]`."""
        actions, rewards = action.reshape(self._over.shape), np.zeros(self._over.shape, np.float32)
        for i, (world, layout) in enumerate(zip(self._worlds, self.layouts, strict=True)):
            if self._over[i].all():
                continue
            w, n_users, steps_max = self.weights[i], layout.n_users, float(layout.mission.max_steps)
            outcome = world.step(actions[i], self._draws(layout))
            state, flying = world.state, ~self._over[i]
            users = state.collected.sum(axis=-1, dtype=np.float32)
            docked = mission.at_dock(state.cell, layout.dock_cell)
            late = np.where(docked, 0.0, 1.0 + self._docked[i])  # steps
            reward = w / n_users * (users - self.users[i]) - (1.0 - w) / steps_max * late
            over = outcome.terminated | outcome.truncated
            landed = outcome.landed & flying
            lost = over & ~outcome.landed
            # J is 0 then, as if it landed with its last step and no user.
            reward = np.where(lost, -(1.0 - w) - self._paid[i], reward)
            rewards[i] = np.where(flying, reward, 0.0)
            self._paid[i] += rewards[i]
            arrival = np.where(np.isnan(self.arrival[i]), state.step, self.arrival[i])
            self.arrival[i] = np.where(flying, np.where(docked, arrival, np.nan), self.arrival[i])
            self._docked[i] = np.where(docked, self._docked[i] + 1.0, 0.0)
            self.users[i] = np.where(flying, users, self.users[i])
            self.landed[i] |= landed
            self._over[i] |= over
        return StepRewards(rewards.reshape(-1), self._over.reshape(-1).copy())

    @property
    def all_over(self) -> bool:
        """Whether every mission has ended."""
        return bool(self._over.all())

    def objective(self) -> Array:
        """J of every mission, `[L, B]`."""
        found = [
            objective.objective(
                self.users[i],
                self.arrival[i],
                self.landed[i],
                n_users=layout.n_users,
                max_steps=layout.mission.max_steps,
                weight=self.weights[i],
            )
            for i, layout in enumerate(self.layouts)
        ]
        return np.stack(found)

    def _draws(self, layout: Scenario) -> Array:
        return self._rng.random((self._n, *layout.draws_shape), np.float32)
