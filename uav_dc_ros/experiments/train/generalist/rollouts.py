"""What each action of a mission is worth, by flying all of them. Needs no torch.

After the action a mission is flown to its end by the policy. The missions of one state share the random
numbers of every step, so that they differ by the action alone: the differences have a fraction of the
variance of J.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np

from uav_dc_ros.core import mission, world
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.entities.encoding import allowed
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.objective import objective
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.core.world import State

# Actions for observations `[N, D]`, integers `[N]`.
Decide = Callable[[Array], Array]


@dataclass(frozen=True, kw_only=True)
class Situations:
    """Missions of one layout before a step, K of them."""

    state: State  # `[K, ...]`
    weight: Array  # w of the objective, `[K]`
    arrival: Array  # step from which the UAV has been over the dock, NaN if it is not there, `[K]`

    def take(self, rows: Array) -> "Situations":
        """Those of rows, integers or bool."""
        state = State(**{field.name: getattr(self.state, field.name)[rows] for field in fields(State)})
        return Situations(state=state, weight=self.weight[rows], arrival=self.arrival[rows])


def joined(parts: list[Situations]) -> Situations:
    """Situations one after another."""

    def of_states(name: str) -> Array:
        return np.concatenate([getattr(part.state, name) for part in parts])

    return Situations(
        state=State(**{field.name: of_states(field.name) for field in fields(State)}),
        weight=np.concatenate([part.weight for part in parts]),
        arrival=np.concatenate([part.arrival for part in parts]),
    )


def action_values(
    layout: Scenario, situations: Situations, observation: Array, decide: Decide, rng: np.random.Generator
) -> Array:
    """J from now on of each allowed action, float32 `[K, 7]`; NaN of those that are not allowed.

    J from now on is that of the whole mission, less what the users collected and the steps flown until now
    are worth. `observation` `[K, D]` is that of the situations.
    """
    mask = allowed(observation)
    row, action = np.nonzero(mask)
    values = np.full(mask.shape, np.nan, np.float32)
    values[row, action] = _fly(layout, situations, row, action, decide, rng)
    weight, limits = situations.weight, layout.mission
    users = situations.state.collected.sum(axis=-1) / layout.n_users
    until_now = weight * users + (1.0 - weight) * (1.0 - situations.state.step / limits.max_steps)
    return values - until_now[:, None].astype(np.float32)


def _fly(
    layout: Scenario,
    situations: Situations,
    row: Array,
    action: Array,
    decide: Decide,
    rng: np.random.Generator,
) -> Array:
    """J of missions that begin in the situations `row` with an `action`, integers `[B]` both."""
    flown = situations.take(row)
    state, weight, arrival = flown.state, flown.weight, flown.arrival
    over, landed = np.zeros(len(row), bool), np.zeros(len(row), bool)
    users = state.collected.sum(axis=-1)
    while True:
        draws = rng.random((len(situations.weight), *layout.draws_shape), np.float32)
        state, outcome = world.step(layout, state, action, draws[row])
        docked = mission.at_dock(state.cell, layout.dock_cell)
        since = np.where(docked, np.where(np.isnan(arrival), state.step, arrival), np.nan)
        arrival = np.where(over, arrival, since)
        users = np.where(over, users, state.collected.sum(axis=-1))
        landed |= outcome.landed & ~over
        over |= outcome.terminated | outcome.truncated
        if not over.all():
            action = decide(world.observe("entities", layout, state, weight))
            if not (over | docked & (action == Action.HOVER)).all():
                continue
            landed |= ~over  # those that wait over the dock for the end
        return objective(
            users,
            arrival,
            landed,
            n_users=layout.n_users,
            max_steps=layout.mission.max_steps,
            weight=weight,
        )
