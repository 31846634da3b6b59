"""Missions side by side in the model of a planner, and the rules by which searches advance them."""

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np

from uav_dc_ros.core import mission, world
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.objective import objective
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.core.world import Act, State
from uav_dc_ros.planners.cells import Cells
from uav_dc_ros.planners.model import Model


@dataclass(frozen=True, kw_only=True)
class ModelMissions:
    """Missions at one step, `B` of them."""

    cell: Array  # index in `Cells.cells`, integers `[B]`
    data_bits: Array  # `[B, U]`
    collected: Array  # bool `[B, U]`
    since: Array  # step from which the UAV has been over the dock, 0 if it is not there, integers `[B]`
    energy_used_j: Array  # `[B]`

    def take(self, where: Array) -> "ModelMissions":
        """The missions with these indices, or of a mask."""
        return ModelMissions(**{name: getattr(self, name)[where] for name in self.__dataclass_fields__})

    def lasts_home(self, cells: Cells) -> Array:
        """Whether the battery lasts for the way home, bool `[B]`."""
        energy = cells.scenario.energy
        if energy is None or energy.ends == "steps":
            return np.ones(self.cell.shape, bool)
        way_j = cells.steps_home[self.cell] * cells.scenario.step_energies_j.level
        return self.energy_used_j + way_j <= energy.battery_j


def begin(cells: Cells, state: State) -> ModelMissions:
    """One mission from a state without batch dimensions."""
    step, cell = int(state.step), cells.index(np.asarray(state.cell))[None]
    return ModelMissions(
        cell=cell,
        data_bits=state.data_bits[None],
        collected=state.collected[None],
        since=np.where(cells.docked[cell] & (step > 0), step, 0),
        energy_used_j=np.reshape(state.energy_used_j, (1,)),
    )


def advance(
    model: Model, before: ModelMissions, cell: Array, step: int, n_flown: int, r_min_bits: float | Array
) -> tuple[ModelMissions, Array, Array]:
    """Missions after a step.

    Args:
        model: of the walks of all steps that are left.
        before: the missions.
        cell: that to which each has moved, index in `Cells.cells`, integers `[B]`.
        step: index of the step in the model.
        n_flown: steps flown after it.
        r_min_bits: data that each user must deliver, bit, a number or `[U]`.

    Returns:
        The missions after the step; whether they are over; whether they have landed, or will if the UAV stays
        over the dock. The latter are bool `[B]`.
    """
    scenario = model.scenario
    delivered_bits = model.delivered(step, cell, before.collected)
    data_bits, collected = mission.collect(before.data_bits, before.collected, delivered_bits, r_min_bits)
    arrived = np.where(before.since > 0, before.since, n_flown)
    at_m, to_m = model.cells[before.cell], model.cells[cell]
    after = ModelMissions(
        cell=cell,
        data_bits=data_bits,
        collected=collected,
        since=np.where(model.docked[cell], arrived, 0),
        energy_used_j=world.energy_after(scenario, before.energy_used_j, at_m, to_m),
    )
    terminated, truncated, landed = world.end_of_mission(
        scenario, np.full(cell.shape, n_flown), to_m, after.energy_used_j
    )
    over = terminated | truncated
    return after, over, landed | (model.docked[cell] & ~over)


def objective_of(
    scenario: Scenario, n_users: Array, arrival_step: Array, landed: Array, weight: float
) -> Array:
    """J of missions with the weight w, `[B]`; arguments as in `core.objective`, `[B]` each."""
    return objective(
        n_users,
        arrival_step,
        landed,
        n_users=scenario.n_users,
        max_steps=scenario.mission.max_steps,
        weight=weight,
    )


def one_by_one(decide: Callable[[State], int]) -> Act:
    """The actions of what decides for one mission at a time, whose state has no batch dimensions."""

    def act(state: State) -> Array:
        shape, n = state.step.shape, state.step.size
        each = {one.name: getattr(state, one.name) for one in fields(State)}
        rows = {name: values.reshape((n, *values.shape[len(shape) :])) for name, values in each.items()}
        states = (State(**{name: rows[name][i] for name in rows}) for i in range(n))
        return np.asarray([decide(one) for one in states]).reshape(shape)

    return act
