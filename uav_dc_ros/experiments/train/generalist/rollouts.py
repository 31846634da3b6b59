"""What each action of a mission is worth, by flying all of them. Needs no torch.

After the action some more steps are flown, and the plan estimates what the mission is worth from there. The
missions of one state share the random numbers of every step, so that they differ by the action alone: the
differences have a fraction of the variance of J.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np

from uav_dc_ros.core import mission, world
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.entities.encoding import WORTH, allowed
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
    layout: Scenario,
    situations: Situations,
    observation: Array,
    decide: Decide,
    n_steps: int,
    rng: np.random.Generator,
) -> Array:
    """J from now on of each allowed action, float32 `[K, 7]`; NaN of those that are not allowed.

    J from now on is that of the whole mission, less what the users collected and the steps flown until now
    are worth. `observation` `[K, D]` is that of the situations; `n_steps` are flown at most, including the
    action, before the plan estimates what is left.
    """
    mask = allowed(observation)
    row, action = np.nonzero(mask)
    values = np.full(mask.shape, np.nan, np.float32)
    values[row, action] = _fly(layout, situations, row, action, decide, n_steps, rng)
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
    n_steps: int,
    rng: np.random.Generator,
) -> Array:
    """J of missions that begin in the situations `row` with an `action`, integers `[B]` both."""
    limits = layout.mission
    flown = situations.take(row)
    state, weight, arrival = flown.state, flown.weight, flown.arrival
    over, landed = np.zeros(len(row), bool), np.zeros(len(row), bool)
    users = state.collected.sum(axis=-1)
    for _ in range(n_steps):
        draws = rng.random((len(situations.weight), *layout.draws_shape), np.float32)
        state, outcome = world.step(layout, state, action, draws[row])
        docked = mission.at_dock(state.cell, layout.dock_cell)
        since = np.where(docked, np.where(np.isnan(arrival), state.step, arrival), np.nan)
        arrival = np.where(over, arrival, since)
        users = np.where(over, users, state.collected.sum(axis=-1))
        landed |= outcome.landed & ~over
        over |= outcome.terminated | outcome.truncated
        observation = world.observe("entities", layout, state, weight)
        action = decide(observation)
        waits = docked & (action == Action.HOVER)
        if (over | waits).all():
            break
    # Those that wait over the dock land. Of others the plan estimates what is left.
    ended = objective(
        users, arrival, landed | waits, n_users=layout.n_users, max_steps=limits.max_steps, weight=weight
    )
    steps = np.asarray(np.where(docked, arrival, state.step), np.float32)
    until_then = weight * users / layout.n_users + (1.0 - weight) * (1.0 - steps / limits.max_steps)
    return np.where(over | waits, ended, until_then + observation[:, WORTH])
