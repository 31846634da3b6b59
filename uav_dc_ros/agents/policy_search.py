"""Search on top of a policy: before each move, missions are flown to their ends in a model.

The model is that of the planner `search`: users stay where they are at present, over the channel without
shadowing and fading. It knows neither where users will go nor what a random channel will draw. Of a budget of
N missions

- the first takes the policy's actions;
- up to six begin with another action, the ones with the highest Q-values first, and then take the policy's.
  From each of its states a mission may also fly home at once. So it is worth the highest J (see
  `core.objective`) of its states: the users collected so far, and the arrival by the shortest way;
- the rest is the width of a beam search (`planners.beam`) for a mission that is better than all of these.

The move is the first one of the best mission, of equal ones the policy's own. So it is never worse than the
policy's where the model is right: see Tesauro and Galperin, "On-line Policy Improvement using Monte-Carlo
Search", NIPS 1996. After it the UAV can still reach the dock, unless no move allows that.

N is a number of missions, not of seconds: a decision depends on the state only. With a time limit, a decision
that does not end in time is the policy's own action, and says so.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from uav_dc_ros.agents.policy import Policy
from uav_dc_ros.core import world
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.entities.encoding import allowed, can_land
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.core.world import State
from uav_dc_ros.planners import beam
from uav_dc_ros.planners.lookahead import StandingUsers, estimate, homewards
from uav_dc_ros.planners.missions import ModelMissions, advance, begin, objective_of, one_by_one


class _OutOfTimeError(Exception):
    """The time limit of a decision is over."""


@dataclass(frozen=True)
class SearchedMove:
    """A decision for one mission."""

    action: int  # value of `core.grid.Action`
    timed_out: bool = False  # whether the time ran out: then the action is the policy's own


class PolicySearch:
    """Searches on top of a policy in one scenario, see the module. Calling it gives actions, as an `Act`."""

    def __init__(self, policy: Policy, scenario: Scenario, weight: float, n: int) -> None:
        """`weight` is w of the objective, `n` the number of missions of a decision, at least 1.

        Raises:
            PolicyError: the policy does not fit the scenario.
            ParameterError: the scenario is too large for the model.
        """
        policy.check(scenario)
        self._policy, self._scenario, self._weight, self._n = policy, scenario, weight, n
        self._model = StandingUsers(scenario)
        self._act = one_by_one(lambda state: self.decide(state).action)

    def __call__(self, state: State) -> Array:
        """The actions of missions, integers `[...]`, without a time limit."""
        return self._act(state)

    def own(self, state: State) -> int:
        """The policy's own action for one mission: its best one after which the UAV can still land."""
        return int(self._greedy(begin(self._model, state), int(state.step))[0])

    def decide(self, state: State, time_limit_s: float | None = None) -> SearchedMove:
        """The action for one mission, whose state has no batch dimensions; `time_limit_s`: seconds."""
        deadline_s = math.inf if time_limit_s is None else time.monotonic() + time_limit_s

        def check_time() -> None:
            if time.monotonic() > deadline_s:
                raise _OutOfTimeError

        own = self.own(state)
        try:
            return SearchedMove(self._best(state, own, check_time))
        except _OutOfTimeError:
            return SearchedMove(own, timed_out=True)

    def _best(self, state: State, own: int, check_time: Callable[[], None]) -> int:
        """The first action of the best mission."""
        model, start = self._model, begin(self._model, state)
        delivery = model.look(state)
        if not model.n_steps or (self._scenario.mission.episode_end == "on_arrival" and start.since[0]):
            return own  # the mission is over
        firsts = self._firsts(start, int(state.step), own)
        worth = self._fly(state, start, firsts, check_time)
        best = int(worth.argmax())
        if (width := self._n - len(firsts)) > 0:
            plan = beam.search(
                model,
                state,
                width=width,
                weight=self._weight,
                ranking=estimate(model, delivery, state, self._weight),
                above=float(worth[best]),
                before_step=check_time,
            )
            if len(plan.actions):
                return int(plan.actions[0])
        return int(firsts[best])

    def _fly(
        self, state: State, start: ModelMissions, firsts: Array, check_time: Callable[[], None]
    ) -> Array:
        """The worth of missions that take these actions first, integers `[B]`, then the policy's; `[B]`."""
        model, scenario, n_flown = self._model, self._scenario, int(state.step)
        r_min_bits = scenario.user_r_min_bits(state.data_bits)
        number, action, worth = np.arange(len(firsts)), firsts, np.zeros(len(firsts))
        missions = start.take(0 * number)
        for step in range(model.n_steps):
            check_time()
            if step:
                action = self._greedy(missions, n_flown)
            n_flown += 1
            cell = model.after[missions.cell, action]
            missions, over, lands = advance(model, missions, cell, step, n_flown, r_min_bits)
            soonest = np.where(missions.since > 0, missions.since, n_flown + model.steps_home[cell])
            goes_on = ~over & (soonest <= scenario.mission.max_steps) & missions.lasts_home(model)
            n_users = missions.collected.sum(axis=-1)
            here = objective_of(scenario, n_users, soonest, lands | goes_on, self._weight)
            worth[number] = np.maximum(worth[number], here)
            best = int(worth.argmax())
            # A mission goes on while it may become the best, or an equal one that is preferred.
            hope = objective_of(scenario, 0 * n_users + scenario.n_users, soonest, goes_on, self._weight)
            kept = goes_on & ((hope > worth[best]) | ((hope == worth[best]) & (number < best)))
            if not kept.any():
                break
            missions, number = missions.take(kept), number[kept]
        return worth

    def _firsts(self, start: ModelMissions, n_flown: int, own: int) -> Array:
        """The actions to begin with, integers: the policy's own and others after which the UAV can land."""
        q_values, _ = self._q_values(start, n_flown)
        others = np.argsort(-q_values[0], kind="stable")
        others = others[self._can_land(start, n_flown)[0, others] & (others != own)]
        return np.asarray([own, *others][: self._n])

    def _greedy(self, missions: ModelMissions, n_flown: int) -> Array:
        """The policy's best actions after which the UAV can land, integers `[B]`."""
        q_values, mask = self._q_values(missions, n_flown)
        return np.where(mask, q_values, -np.inf).argmax(axis=-1)

    def _q_values(self, missions: ModelMissions, n_flown: int) -> tuple[Array, Array]:
        """Q(s, a), and the actions that the policy chooses from, `[B, 7]` each."""
        policy, scenario, cell = self._policy, self._scenario, self._model.cells[missions.cell]
        observation = policy.observe(
            scenario,
            cell=cell,
            step=np.full(len(cell), n_flown),
            data_bits=missions.data_bits,
            collected=missions.collected,
            energy_used_j=missions.energy_used_j,
            weight=self._weight,
        )
        q_values = policy.q_values(observation)
        if policy.config.observation == "entities":
            return q_values, allowed(observation)
        safe = self._can_land(missions, n_flown)
        # A move off the grid is a hover. Another network than one for `entities` may choose it.
        mask = np.where(self._model.has_effect[missions.cell], safe, safe[:, Action.HOVER, None])
        if (possible := world.action_mask(scenario, cell)) is not None:
            mask &= possible
        for i in np.flatnonzero(~mask.any(axis=-1)):
            mask[i, homewards(self._model, int(missions.cell[i]))] = True
        return q_values, mask

    def _can_land(self, missions: ModelMissions, n_flown: int) -> Array:
        cell = self._model.cells[missions.cell]
        step = np.full(len(cell), n_flown)
        return can_land(self._scenario, cell=cell, step=step, energy_used_j=missions.energy_used_j)
