"""Transitions (s, a, r, s', terminated) of recorded missions: what a policy learns from.

They are those that the Gymnasium environment gives for the same missions, bit for bit: observations are made
from recorded cells and books as the policy node makes them, and the reward is computed anew, since no node
tells it.
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
    """One step of a mission as an agent sees it.

    Attributes:
        flight, mission, step: which; `step` is that of s.
        observation: s, float32 `[D]`.
        action: what was flown, value of a `core.grid.Action`.
        reward: r.
        next_observation: s', float32 `[D]`.
        terminated: the episode ended at s'.
        truncated: it was cut off there.
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
    """What an agent knows of a step: its observation, and r^t (eq. 7)."""

    flight: int
    mission: int
    step: int
    cell: tuple[int, int, int]
    observation: Array
    total: float


class Transitions:
    """Iterates over the transitions of recorded steps, in order; one step is in memory at a time.

    Args:
        steps: as `Steps` hands them out.
        scenario: the world, and how its agents are paid.
        observation: what the agent sees.

    Attributes:
        skipped: steps that are no transition, by reason.
        deduced: transitions whose action is deduced from the cells: none was recorded, or another one, which
            came too late and was not flown.
    """

    def __init__(self, steps: Iterable[RecordedStep], scenario: Scenario, observation: Observation) -> None:
        self.skipped: Counter[str] = Counter()
        self.deduced = 0
        self._steps, self._scenario, self._observation = steps, scenario, observation

    def __iter__(self) -> Iterator[Transition]:
        """Start at the first step; once."""
        before: _State | None = None
        said: Action | None = None
        for step in self._steps:
            after = self._state(step)
            if after and before and (step.flight, step.mission, step.step - 1) == before[:3]:
                action = self._flown(before.cell, after.cell, said)
                if action is not None:
                    yield self._transition(before, after, action)
            elif step.step > 0:
                self.skipped["a step whose beginning or end is not recorded"] += 1
            before, said = after, Action[step.move.action.upper()] if step.move else None

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
        # A mission starts from r = 0, whatever R_plus is where it starts.
        total = float(world.total_reward(scenario, cell, data_bits)) if step.step else 0.0
        return _State(step.flight, step.mission, step.step, step.status.cell, observation, total)

    def _flown(
        self, cell: tuple[int, int, int], after: tuple[int, int, int], said: Action | None
    ) -> Action | None:
        """The action between two cells: the one that was said, if it leads there."""
        others = (Action.HOVER, *Action)
        for action in others if said is None else (said, *others):
            reached = self._scenario.grid.move(np.asarray(cell), np.asarray(int(action)))
            if reached.tolist() == list(after):
                self.deduced += action is not said
                return action
        self.skipped["a step between cells that are no neighbours"] += 1
        return None

    def _transition(self, before: _State, after: _State, action: Action) -> Transition:
        scenario = self._scenario
        terminated, truncated, _ = world.ends(scenario, np.asarray(after.step), np.asarray(after.cell))
        return Transition(
            flight=before.flight,
            mission=before.mission,
            step=before.step,
            observation=before.observation,
            action=int(action),
            reward=float(core_reward.earned(after.total, before.total, scenario.reward.form)),
            next_observation=after.observation,
            terminated=bool(terminated),
            truncated=bool(truncated),
        )
