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
    """One step of a mission as an agent observes it.

    Attributes:
        flight, mission, step: source; `step` is that of s.
        observation: s, float32 `[D]`.
        action: the action flown, value of a `core.grid.Action`.
        reward: r.
        next_observation: s', float32 `[D]`.
        terminated, truncated: whether the episode ended, or was cut off, at s'.
    """

    flight: int
    mission: int
    step: int
    observation: Array
    action: int
    reward: float
    next_observation: Array
    terminated: bool
    truncated: bool


class _State(NamedTuple):
    flight: int
    mission: int
    step: int
    cell: tuple[int, int, int]
    observation: Array
    total_reward: float  # r^t (eq. 7)


class RecordedTransitions:
    """Iterates over the transitions of recorded steps, in order, with one step in memory.

    Args:
        steps: as `Steps` releases them.
        scenario: the world and the reward.
        observation: what the agent observes.

    Attributes:
        skipped: steps without a transition, by reason.
        deduced: transitions whose action is deduced from the cells, since no move was recorded, or one that
            was not flown.
    """

    def __init__(self, steps: Iterable[RecordedStep], scenario: Scenario, observation: Observation) -> None:
        self.skipped: Counter[str] = Counter()
        self.deduced = 0
        self._steps, self._scenario, self._observation = steps, scenario, observation

    def __iter__(self) -> Iterator[Transition]:
        """Start at the first step; once."""
        before: _State | None = None
        move: Action | None = None
        for step in self._steps:
            after = self._state(step)
            if after and before and (step.flight, step.mission, step.step - 1) == before[:3]:
                action = self._action(before.cell, after.cell, move)
                if action is not None:
                    yield self._transition(before, after, action)
            elif step.step > 0:
                self.skipped["a step whose start or end is not recorded"] += 1
            before, move = after, Action[step.move.action.upper()] if step.move else None

    def _state(self, step: RecordedStep) -> _State | None:
        if step.status is None or step.rates is None:
            return None
        scenario = self._scenario
        try:
            payloads.check(step.status, scenario)
            data_bits, collected = payloads.collection(step.rates, scenario)
        except MessageError as error:
            self.skipped[f"a step of another world ({error.reason})"] += 1
            return None
        cell = np.asarray(step.status.cell)
        observation = observations.encode(
            self._observation,
            scenario,
            cell=cell,
            step=np.asarray(scenario.mission.max_steps - step.status.remaining_steps),
            data_bits=data_bits,
            collected=collected,
        )
        # A mission starts from r = 0, whatever R_plus its start cell has.
        total = float(world.total_reward(scenario, cell, data_bits)) if step.step else 0.0
        return _State(step.flight, step.mission, step.step, step.status.cell, observation, total)

    def _action(
        self, cell: tuple[int, int, int], after: tuple[int, int, int], move: Action | None
    ) -> Action | None:
        """The action between two cells: the recorded move if it leads there."""
        others = (Action.HOVER, *Action)
        for action in others if move is None else (move, *others):
            reached = self._scenario.grid.move(np.asarray(cell), np.asarray(int(action)))
            if reached.tolist() == list(after):
                self.deduced += action is not move
                return action
        self.skipped["a step between cells that are not adjacent"] += 1
        return None

    def _transition(self, before: _State, after: _State, action: Action) -> Transition:
        scenario = self._scenario
        terminated, truncated, _ = world.end_of_mission(
            scenario, np.asarray(after.step), np.asarray(after.cell)
        )
        return Transition(
            flight=before.flight,
            mission=before.mission,
            step=before.step,
            observation=before.observation,
            action=int(action),
            reward=float(
                core_reward.step_reward(after.total_reward, before.total_reward, scenario.reward.form)
            ),
            next_observation=after.observation,
            terminated=bool(terminated),
            truncated=bool(truncated),
        )
