"""Beam search over the moves of one mission, in a model in which the users' ways are known.

States of equal depth are compared by the J that they may still reach (`Guide`). Of states in one cell with
the same users collected the best is kept, and of all of them the best `width`.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np

from uav_dc_ros.core import mission
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.objective import objective
from uav_dc_ros.planners.cells import Cells

# Data in the step that ends at a step of the mission, bit, `[N, U]`: from the step, the numbers of the cells
# `[N]` and the users collected before, bool `[N, U]`; 0 for the latter.
Deliver: TypeAlias = Callable[[int, Array, Array], Array]


class Start(NamedTuple):
    """The mission from which a search begins."""

    step: int  # steps flown
    number: int  # of the UAV's cell
    data_bits: Array  # `[U]`
    collected: Array  # bool `[U]`
    energy_used_j: float = 0.0


class Plan(NamedTuple):
    """The best way home that was found."""

    actions: list[int]  # until the UAV stays over the dock
    users: int  # collected until then, or later from over the dock
    arrival_step: int
    objective: float  # J in the model


class Guess(NamedTuple):
    """What is estimated of states, `[N]` each."""

    users: Array  # that are still collected
    arrival_step: Array


Guide: TypeAlias = Callable[[int, Array, Array, Array, Array], Guess]


class _States(NamedTuple):
    """States of equal depth, `[N, ...]`."""

    number: Array  # of the UAV's cell
    data_bits: Array
    collected: Array
    energy_used_j: Array
    arrival_step: Array  # since when the UAV has been over the dock, if it is there

    def at(self, rows: Array) -> "_States":
        return _States(*(values[rows] for values in self))


def search(
    cells: Cells, deliver: Deliver, guide: Guide, start: Start, weight: float, width: int
) -> Plan | None:
    """The best plan found from `start`; None: the dock cannot be reached in time.

    `guide` gets the step, the cells' numbers `[N]`, data `[N, U]`, who is collected `[N, U]`, and since which
    step the UAV has been over the dock, `[N]`. It estimates what a state leads to.
    """
    scenario = cells.scenario
    n_users, max_steps = scenario.n_users, scenario.mission.max_steps
    ends_at_dock = scenario.mission.episode_end == "on_arrival"
    r_min_bits = scenario.user_r_min_bits(start.data_bits)
    battery_j = scenario.energy.battery_j if cells.has_battery and scenario.energy else np.inf
    energies_j, move_j = cells.energies_j, _dearest_move_j(cells)
    rng = np.random.default_rng(0)
    marks = rng.integers(2**62, size=n_users)  # a set of users by the sum of its marks

    def value(users: Array, arrival_step: Array) -> Array:
        landed = np.ones(users.shape, dtype=bool)
        return objective(users, arrival_step, landed, n_users=n_users, max_steps=max_steps, weight=weight)

    states = _States(
        np.asarray([start.number]),
        start.data_bits[None],
        start.collected[None],
        np.asarray([start.energy_used_j]),
        np.asarray([start.step]),
    )
    reached = -1.0  # the J of `best`
    best: tuple[int, int, int, int] | None = None  # depth, row, users, arrival
    links: list[tuple[Array, Array]] = []  # by depth: the row of the state before, and the action
    for step in range(start.step, max_steps + 1):
        is_docked = cells.at_dock[states.number]
        if (docked := np.flatnonzero(is_docked)).size:
            there = states.at(docked)
            users = there.collected.sum(axis=1)
            values = value(users, there.arrival_step)
            if values.max() > reached:
                i = int(values.argmax())
                reached = float(values[i])
                best = len(links), int(docked[i]), int(users[i]), int(there.arrival_step[i])
        earliest = np.where(is_docked, states.arrival_step, step + cells.to_dock[states.number])
        go_on = value(np.full(earliest.shape, n_users), earliest) > reached  # others cannot become better
        if ends_at_dock and links:
            go_on &= ~is_docked
        if step == max_steps:
            break
        rows, actions = np.nonzero(cells.valid[states.number] & go_on[:, None])
        after = cells.after[states.number[rows], actions]
        used_j = states.energy_used_j[rows] + energies_j[actions]
        home = cells.to_dock[after]
        possible = (home <= max_steps - step - 1) & (battery_j - used_j >= home * move_j)
        rows, actions, after, used_j = rows[possible], actions[possible], after[possible], used_j[possible]
        if not rows.size:
            break
        before = states.collected[rows]
        data_bits, collected = mission.collect(
            states.data_bits[rows], before, deliver(step + 1, after, before), r_min_bits
        )
        stayed = cells.at_dock[after] & cells.at_dock[states.number[rows]]
        arrival = np.where(stayed, states.arrival_step[rows], step + 1)
        guess = guide(step + 1, after, data_bits, collected, arrival)
        values = value(collected.sum(axis=1) + guess.users, guess.arrival_step)
        ranks = np.argsort(-values, kind="stable")
        keys = (collected * marks).sum(axis=1) + after * 1_000_003
        _, first = np.unique(keys[ranks], return_index=True)
        kept = ranks[np.sort(first)[:width]]
        links.append((rows[kept], actions[kept]))
        states = _States(after[kept], data_bits[kept], collected[kept], used_j[kept], arrival[kept])
    if best is None:
        return None
    depth, row, n_collected, arrival_step = best
    path = []
    for rows, actions in reversed(links[:depth]):
        path.append(int(actions[row]))
        row = int(rows[row])
    path.reverse()
    while path and path[-1] == Action.HOVER and start.step + len(path) > arrival_step:
        path.pop()
    return Plan(path, n_collected, arrival_step, reached)


def _dearest_move_j(cells: Cells) -> float:
    """Energy of a move on the way home, joules: among obstacles it may climb."""
    if cells.scenario.energy is None:
        return 0.0
    one = cells.scenario.step_energies_j
    return one.level if cells.scenario.moves is None else max(one)
