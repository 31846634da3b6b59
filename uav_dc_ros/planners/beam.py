"""Beam search with the true model of the world: the best mission that a beam of a given width finds.

With the walks of a seed (`model.known_walks`) the search is clairvoyant: its mission is that of a planner
that knows the future. With expected walks, from any state, it is the inner search of a planner that does not.

All missions of the beam are at the same step. Each is extended by every move. Of the missions in one cell
with the same users collected only the most promising one is kept, and of all the `width` most promising.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.objective import DEFAULT_WEIGHT
from uav_dc_ros.core.world import State
from uav_dc_ros.planners.missions import ModelMissions, advance, begin, objective_of
from uav_dc_ros.planners.model import MissionModel, Model
from uav_dc_ros.planners.promise import Promise

WIDTH = 512

# From the index of the step, the steps flown, the cells `[B]`, the data and who is collected, `[B, U]`: the J
# that missions may end with, and the further users that they may collect, `[B]` each; see `Promise`.
Ranking: TypeAlias = Callable[[int, int, Array, Array, Array], tuple[Array, Array]]


@dataclass(frozen=True, kw_only=True)
class Plan:
    """The best mission found from a state."""

    actions: Array  # of the next steps, integers `[n]`; n <= H
    objective: float  # J; 0 if the mission does not land within H steps
    users_collected: int
    arrival_step: int  # 0 if the mission does not land within H steps


def search(
    model: Model,
    state: State,
    *,
    width: int = WIDTH,
    weight: float = DEFAULT_WEIGHT,
    ranking: Ranking | None = None,
    before_step: Callable[[], None] = lambda: None,
) -> Plan:
    """The best mission from a state, by the objective J with the weight w.

    Args:
        model: of the walks of all steps that are left.
        state: that of one mission, without batch dimensions.
        width: missions that are kept in each step.
        weight: w of J.
        ranking: what missions are compared by; default: `Promise`, for a `MissionModel`.
        before_step: called before each step; an exception in it ends the search.

    Returns:
        The actions up to the arrival; the UAV hovers from then on. They are none where no mission lands.
    """
    if ranking is None:
        assert isinstance(model, MissionModel), "needed by `Promise`"
        ranking = Promise(model, model.scenario.user_r_min_bits(state.data_bits), weight)
    return _Search(model, state, width, weight, ranking).run(before_step)


class _Search:
    """A search, step by step."""

    def __init__(self, model: Model, state: State, width: int, weight: float, ranking: Ranking) -> None:
        scenario = model.scenario
        self._model, self._scenario, self._width, self._weight = model, scenario, width, weight
        self._first_step = int(state.step)
        self._r_min_bits = scenario.user_r_min_bits(state.data_bits)
        self._promise = ranking
        # Sums of random numbers: equal ones are those of equal sets of users, but for one in 2^64.
        self._numbers = np.random.default_rng(0).integers(0, 2**64, scenario.n_users, np.uint64)
        self._beam = begin(model, state)  # the most promising first
        self._history: list[tuple[Array, Array]] = []  # of each step: mission before, and action, `[B]`
        self._best = Plan(actions=np.zeros(0, np.int64), objective=0.0, users_collected=0, arrival_step=0)

    def run(self, before_step: Callable[[], None]) -> Plan:
        """The best plan; the search ends when no mission of the beam can become better."""
        for step in range(self._model.n_steps):
            before_step()
            self._advance(step)
            if not len(self._beam.cell):
                break
        return self._best

    def _advance(self, step: int) -> None:
        """Extend every mission by every move, note the best one that has arrived, keep the most promising."""
        model, scenario, before = self._model, self._scenario, self._beam
        n_flown = self._first_step + step + 1
        parent, action = np.nonzero(model.has_effect[before.cell])
        cell = model.after[before.cell[parent], action]
        in_time = model.steps_home[cell] <= scenario.mission.max_steps - n_flown
        parent, action, cell = parent[in_time], action[in_time], cell[in_time]
        beam, over, lands = advance(model, before.take(parent), cell, step, n_flown, self._r_min_bits)
        data_bits, collected = beam.data_bits, beam.collected
        n_users = collected.sum(axis=-1)
        # A UAV over the dock that stays there lands.
        value = self._objective(n_users, beam.since, lands)
        if len(value) and value.max() > self._best.objective:
            best = int(value.argmax())
            # Over the dock moves and a hover may be worth the same J: a hover costs the least energy.
            same = (value == value[best]) & (parent == parent[best]) & (action == Action.HOVER)
            best = int(same.argmax()) if same.any() else best
            self._best = Plan(
                actions=self._actions(parent[best], action[best]),
                objective=float(value[best]),
                users_collected=int(n_users[best]),
                arrival_step=int(beam.since[best]),
            )
        soonest = np.where(beam.since > 0, beam.since, n_flown + model.steps_home[cell])
        promise, possible = self._promise(step, n_flown, cell, data_bits, collected)
        hope = self._objective(n_users + possible, soonest, ~over)
        kept = self._most_promising(beam, promise, (hope > self._best.objective) & beam.lasts_home(model))
        self._history.append((parent[kept], action[kept]))
        self._beam = beam.take(kept)

    def _most_promising(self, beam: ModelMissions, promise: Array, eligible: Array) -> Array:
        """Indices of at most `width` missions: for each cell and set of collected users the first one."""
        order = np.flatnonzero(eligible)
        order = order[np.lexsort((beam.energy_used_j[order], -promise[order]))]
        sets = (beam.collected[order] * self._numbers).sum(axis=-1, dtype=np.uint64)
        keys = sets * np.uint64(len(self._model.cells)) + beam.cell[order].astype(np.uint64)
        _, first = np.unique(keys, return_index=True)
        return order[np.sort(first)[: self._width]]

    def _objective(self, n_users: Array, arrival_step: Array, landed: Array) -> Array:
        return objective_of(self._scenario, n_users, arrival_step, landed, self._weight)

    def _actions(self, entry: int, last: int) -> Array:
        """The actions of a mission whose last one is `last`, from mission `entry` of the beam before."""
        actions = [last]
        for parent, action in reversed(self._history):
            actions.append(action[entry])
            entry = parent[entry]
        return np.asarray(actions[::-1], np.int64)
