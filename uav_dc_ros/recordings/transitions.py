"""Transitions (s, a, r, s', terminated) of recorded missions, for training.

They equal those of the Gymnasium environment bit for bit: observations come from recorded cells and data, as
in the policy node, and rewards are computed, since bags hold none.
"""

from collections import Counter
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from uav_dc_ros import payloads
from uav_dc_ros.core import observations, world
from uav_dc_ros.core import reward as core_reward
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.observations import Observation
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import MessageError
from uav_dc_ros.recordings.recorded_step import RecordedStep


class Transition(NamedTuple):
    """One step of a mission as an agent observes it; flight, mission and step are those of s."""

    flight: int
    mission: int
    step: int
    observation: Array  # s, float32 `[D]`
    action: int  # flown, value of a `core.grid.Action`
    reward: float
    next_observation: Array  # s', float32 `[D]`
    terminated: bool  # at s'
    truncated: bool  # at s'


class _State(NamedTuple):
    source: tuple[int, int, int]  # flight, mission, step
    cell: Array
    energy_used_j: Array
    observation: Array
    total_reward: float  # r^t (eq. 7)


class RecordedTransitions:
    """Iterates over the transitions of recorded steps, in order, with one step in memory."""

    def __init__(self, steps: Iterable[RecordedStep], scenario: Scenario, observation: Observation) -> None:
        self.skipped: Counter[str] = Counter()  # steps without a transition, by reason
        self.deduced = 0  # transitions whose action follows from the cells: no recorded move was flown
        self._steps, self._scenario, self._observation = steps, scenario, observation

    def __iter__(self) -> Iterator[Transition]:
        """Start at the first step; once."""
        before: _State | None = None
        move: Action | None = None
        for step in self._steps:
            after = self._state(step)
            if after and before and before.source == (step.flight, step.mission, step.step - 1):
                action = self._action(before.cell, after.cell, move)
                if action is not None:
                    yield self._transition(before, after, action)
            elif step.step > 0:
                self.skipped["a step whose start or end is not recorded"] += 1
            before, move = after, Action[step.move.action.upper()] if step.move else None

    def _state(self, step: RecordedStep) -> _State | None:
        try:
            observed = step.observed(self._scenario)
        except MessageError as error:
            self.skipped[f"a step of another world ({error.reason})"] += 1
            return None
        if observed is None:
            return None
        observation = observations.encode(self._observation, self._scenario, **observed)
        total = 0.0
        if step.step and step.status and step.rates:  # whatever R_plus its start cell has, r is 0 there
            total = payloads.total_reward(step.status, step.rates, self._scenario)
        source = step.flight, step.mission, step.step
        return _State(source, observed["cell"], observed["energy_used_j"], observation, total)

    def _action(self, cell: Array, after: Array, move: Action | None) -> Action | None:
        """The action between two cells: the recorded move if it leads there."""
        others = (Action.HOVER, *Action)
        for action in others if move is None else (move, *others):
            if np.array_equal(world.move(self._scenario, cell, np.asarray(int(action))), after):
                self.deduced += action is not move
                return action
        self.skipped["a step between cells that are not adjacent"] += 1
        return None

    def _transition(self, before: _State, after: _State, action: Action) -> Transition:
        step, form = np.asarray(after.source[2]), self._scenario.reward.form
        terminated, truncated, _ = world.end_of_mission(self._scenario, step, after.cell, after.energy_used_j)
        reward = float(core_reward.step_reward(after.total_reward, before.total_reward, form))
        end = bool(terminated), bool(truncated)
        return Transition(*before.source, before.observation, int(action), reward, after.observation, *end)
