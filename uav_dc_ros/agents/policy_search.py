"""Search on top of a policy: before each move, N missions are flown to their ends in a model.

The model is that of the planner `search`: users stay where they are at present, over the channel without
shadowing and fading. It knows neither where users will go nor what a random channel will draw.

One mission takes the policy's actions. From each of its states it may also fly home at once. So it is worth
the highest J of its states (see `core.objective`): users collected so far, and arrival by the shortest way.
The others are those of a beam search that is N - 1 missions wide (`planners.beam`). The move is the first
one of the best mission, of equal ones the policy's own: in the model, it is never worse than the policy's.
After it the UAV can still reach the dock, unless no move allows that.

To begin with each action, and then to follow the policy (Tesauro and Galperin, "On-line Policy Improvement
using Monte-Carlo Search", NIPS 1996), takes as many missions from the beam, and was worse with few of them.

N is a number of missions, not of seconds: a decision depends on the state only. With a time limit, a decision
that does not end in time is the policy's own action, and reports that.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from uav_dc_ros.agents.policy import Policy
from uav_dc_ros.core import world
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.entities.encoding import can_land
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
        return int(self._greedy(begin(self._model, state), int(state.step), state.delivered_bits[None])[0])

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
        landed = self._scenario.mission.episode_end == "on_arrival" and start.since[0] > 0
        if landed or not model.n_steps or self._n == 1:
            return own
        ranking = estimate(model, delivery, state, self._weight)
        plan = beam.search(
            model, state, width=self._n - 1, weight=self._weight, ranking=ranking, before_step=check_time
        )
        if not len(plan.actions) or self._reaches(plan.objective, state, start, own, check_time):
            return own
        return int(plan.actions[0])

    def _reaches(
        self, goal: float, state: State, mission: ModelMissions, own: int, check_time: Callable[[], None]
    ) -> bool:
        """Whether the mission of the policy's actions, of which `own` is the next, is worth a J of `goal`."""
        model, scenario, n_flown, action = self._model, self._scenario, int(state.step), np.asarray([own])
        delivered_bits = state.delivered_bits[None]
        r_min_bits = scenario.user_r_min_bits(state.data_bits)
        for step in range(model.n_steps):
            check_time()
            if step:
                action = self._greedy(mission, n_flown, delivered_bits)
            n_flown += 1
            cell = model.after[mission.cell, action]
            delivered_bits = model.delivered(step, cell, mission.collected)
            mission, over, lands = advance(model, mission, cell, step, n_flown, r_min_bits)
            soonest = np.where(mission.since > 0, mission.since, n_flown + model.steps_home[cell])
            goes_on = ~over & (soonest <= scenario.mission.max_steps) & mission.lasts_home(model)
            n_users = mission.collected.sum(axis=-1)
            if objective_of(scenario, n_users, soonest, lands | goes_on, self._weight)[0] >= goal:
                return True
            n_users[:] = scenario.n_users  # at the most
            if not goes_on[0] or objective_of(scenario, n_users, soonest, goes_on, self._weight)[0] < goal:
                return False
        return False

    def _greedy(self, missions: ModelMissions, n_flown: int, delivered_bits: Array) -> Array:
        """The policy's best actions after which the UAV can land, integers `[B]`."""
        policy, scenario, cell = self._policy, self._scenario, self._model.cells[missions.cell]
        step, used_j = np.full(len(cell), n_flown), missions.energy_used_j
        observation = policy.observe(
            scenario,
            cell=cell,
            step=step,
            data_bits=missions.data_bits,
            collected=missions.collected,
            delivered_bits=delivered_bits,
            energy_used_j=used_j,
            weight=self._weight,
        )
        if policy.config.observation == "entities":
            return policy.act(observation)  # it allows no other ones
        safe = can_land(scenario, cell=cell, step=step, energy_used_j=used_j)
        # A move off the grid is a hover.
        mask = np.where(self._model.has_effect[missions.cell], safe, safe[:, Action.HOVER, None])
        if (possible := world.action_mask(scenario, cell)) is not None:
            mask &= possible
        for i in np.flatnonzero(~mask.any(axis=-1)):
            mask[i, homewards(self._model, int(missions.cell[i]))] = True
        return policy.act(observation, mask)
