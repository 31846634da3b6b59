"""The best mission that was found for a seed, and a bound on the objective of all missions."""

import time
from dataclasses import dataclass, replace

import numpy as np

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.objective import objective
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.core.world import State
from uav_dc_ros.experiments.evaluate.rollout import Missions, roll_out
from uav_dc_ros.experiments.optimum.diagram import Prover
from uav_dc_ros.experiments.optimum.problem import ClairvoyantProblem
from uav_dc_ros.planners.beam import search

BEAM_WIDTHS = (64, 512)  # a wider beam does not find a better mission every time
DIAGRAM_WIDTHS = (250, 2000, 16_000)  # tried one after the other
_EQUAL = 1e-12  # of two values of J


@dataclass(frozen=True, kw_only=True)
class Solution:
    """The best mission found for a seed, and the bound."""

    actions: Array  # of the mission, integers `[T]`
    objective: float  # J
    users_collected: int
    arrival_step: int
    data_bits: float
    bound: float  # no mission has a greater J
    stopped: bool  # whether the time limit ended the search

    @property
    def is_optimal(self) -> bool:
        """Whether the mission is proved to be the best."""
        return self.bound <= self.objective + _EQUAL


def fly(scenario: Scenario, actions: Array, seed: int) -> Missions:
    """The mission of a seed with these actions, in the world as it is; the UAV hovers behind the last."""

    def act(state: State) -> Array:
        step = int(state.step[0])
        return np.full(1, actions[step] if step < len(actions) else Action.HOVER)

    return roll_out(scenario, act, [seed], service=False)


def solve(
    problem: ClairvoyantProblem,
    weight: float,
    time_limit_s: float = np.inf,
    widths: tuple[int, ...] = DIAGRAM_WIDTHS,
) -> Solution:
    """The best mission of a problem by J with the weight w.

    Beam searches find a mission. Then decision diagrams of growing `widths` exclude what would be better:
    for each number of users the arrivals up to some step. What is not excluded gives the bound.
    """
    return _Solver(problem, weight, time.monotonic() + time_limit_s).run(widths)


def as_flown(
    problem: ClairvoyantProblem, actions: Array, weight: float, bound: float = 1.0, stopped: bool = False
) -> Solution:
    """The solution of a problem with these actions, flown in the world as it is."""
    missions = fly(problem.scenario, actions, problem.seed)
    value = float(missions.objective(problem.scenario, weight)[0])
    return Solution(
        actions=np.concatenate([actions, np.full(problem.n_steps - len(actions), Action.HOVER)]),
        objective=value,
        users_collected=int(missions.users_collected[0]),
        arrival_step=int(missions.arrival_step[0]) if missions.landed[0] else 0,
        data_bits=float(missions.data_bits[0]),
        bound=max(bound, value),
        stopped=stopped,
    )


class _Solver:
    def __init__(self, problem: ClairvoyantProblem, weight: float, until_s: float) -> None:
        self._problem, self._weight, self._until_s = problem, weight, until_s
        self._prover = Prover(problem)
        plans = [search(problem.model, problem.start, width=width, weight=weight) for width in BEAM_WIDTHS]
        self._best = self._flown(max(plans, key=lambda plan: plan.objective).actions)
        # For each number of users 0 to U: the last arrival that is excluded for as many, and more.
        soonest = int(problem.model.steps_home[problem.start_cell])
        self._excluded = np.full(problem.n_users + 1, max(soonest, 1) - 1)
        # J of each number of users and arrival step, `[U + 1, T + 1]`
        users, arrival = np.arange(problem.n_users + 1), np.arange(problem.n_steps + 1)
        self._values = self._objective(users[:, None], arrival, np.ones((len(users), len(arrival)), bool))
        self._stopped = False

    def run(self, widths: tuple[int, ...]) -> Solution:
        for width in widths:
            while not self._stopped and self._improve_bound(width):
                pass
        return replace(self._best, bound=max(self._bound()[0], self._best.objective), stopped=self._stopped)

    def _bound(self) -> tuple[float, int]:
        """The greatest J that is not excluded, and its number of users."""
        soonest = self._excluded + 1
        possible = soonest <= self._problem.n_steps
        values = self._values[np.arange(len(soonest)), np.minimum(soonest, self._problem.n_steps)]
        values = np.where(possible, values, 0.0)
        return float(values.max()), int(values.argmax())

    def _improve_bound(self, width: int) -> bool:
        """Exclude more arrivals of the number of users that makes the bound; False: it cannot be improved."""
        bound, n_users = self._bound()
        if bound <= self._best.objective + _EQUAL:
            return False
        low = int(self._excluded[n_users])
        better = np.flatnonzero(self._values[n_users] > self._best.objective + _EQUAL)
        high = attempt = int(better[-1])
        while low < high:
            verdict = self._prover.decide(n_users, attempt, width, self._until_s)
            if verdict.outcome == "stopped":
                self._stopped = True
                break
            if verdict.outcome == "excluded":
                low = attempt
            else:
                mission = self._flown(verdict.actions)
                if mission.objective > self._best.objective + _EQUAL:
                    self._best = mission
                    return True
                high = attempt - 1
            attempt = (low + high + 1) // 2
        progress = low > self._excluded[n_users]
        self._excluded[n_users:] = np.maximum(self._excluded[n_users:], low)
        return progress and not self._stopped

    def _flown(self, actions: Array) -> Solution:
        return as_flown(self._problem, actions, self._weight)

    def _objective(self, n_users: Array, arrival_step: Array, landed: Array) -> Array:
        n_users_total, max_steps = self._problem.n_users, self._problem.n_steps
        return objective(
            n_users, arrival_step, landed, n_users=n_users_total, max_steps=max_steps, weight=self._weight
        )
