"""Measures of the runs, arranged by what a claim compares."""

import numpy as np

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.errors import TrainingError
from uav_dc_ros.experiments.paper.results import GREEDY, METRICS, Results
from uav_dc_ros.experiments.paper.setting import Setting, domain

FINAL = 0.2  # last share of the episodes, whose mean is the performance of a run
SMOOTHING = 5  # points of a curve's moving average: fifty episodes in the full sweep
SETTLED = 0.9  # share of the way to its final level after which a run has converged


class NotMeasured(Exception):
    """The results lack a setting, since they were made for other figures."""


class Evidence:
    """Measures of runs.

    A measure is a name in `results.METRICS` or `GREEDY`, or one of
        convergence                           episodes, see `criteria.RULES`
        middle                                reward after 40% to 60% of the episodes
        fluctuation                           of the reward from point to point, second half of the episodes
        reward_share, greedy_reward_share     reward / (beta + zeta)
        common_share                          reward_share with the binary R_plus for all; as a mean over the
                                              steps it leaves out steps over the dock before the arrival
    """

    def __init__(self, results: Results) -> None:
        self.results = results
        self.scale = results.metadata.scale
        self._measures: dict[str, Array] = {}

    def of(self, measure: str, setting: Setting, *axes: str) -> Array:
        """A measure along `axes` of the sweep, `[E, ...]`, mean over repeats; may raise NotMeasured."""
        values = self._of_runs(measure)
        cells = [self._by_environment(values, one) for one in setting.along(axes, self.scale)]
        return np.stack(cells, axis=-1).reshape(-1, *(len(domain(axis, self.scale)) for axis in axes))

    def curves(self, metric: str, setting: Setting) -> Array:
        """A setting's curves in every environment, `[E, P]`; means over repeats."""
        return self._by_environment(np.asarray(self.results.curves[metric], np.float64), setting)

    def reach(self, setting: Setting, goal: Array) -> Array:
        """Episodes until the reward is 90% of its way to a goal, `[E]`, and stays there; all without that."""
        runs = self.results.of(setting)
        environment = [self.scale.environments.index(self.results.planned[i].environment) for i in runs]
        values = np.zeros(len(self.results.planned))
        reward = np.asarray(self.results.curves["reward"], np.float64)[runs]
        values[runs] = settling(reward, goal[environment], self.results.episode)
        return self._by_environment(values, setting)

    def _by_environment(self, values: Array, setting: Setting) -> Array:
        """Means over repeats, `[n_runs, ...]` to `[E, ...]`."""
        runs = self.results.of(setting)
        environment = np.array([self.results.planned[i].environment for i in runs])
        if missing := set(self.scale.environments) - set(environment):
            raise NotMeasured(f"{setting} in environment {min(missing)}")
        return np.stack([values[runs[environment == e]].mean(axis=0) for e in self.scale.environments])

    def _of_runs(self, measure: str) -> Array:
        """A measure of every run, `[n_runs]`."""
        if measure not in self._measures:
            self._measures[measure] = np.asarray(self._computed(measure), np.float64)
        return self._measures[measure]

    def _computed(self, measure: str) -> Array:
        curves, planned = self.results.curves, self.results.planned
        reward = np.asarray(curves["reward"], np.float64)
        n_points = reward.shape[1]
        if measure in METRICS:
            return final(np.asarray(curves[measure], np.float64))
        if measure in GREEDY:
            return self.results.greedy[measure]
        if measure == "convergence":
            return settling(reward, final(reward), self.results.episode)
        if measure == "middle":
            return reward[:, int(0.4 * n_points) : max(int(0.6 * n_points), 1)].mean(axis=1)
        if measure == "fluctuation":
            return np.diff(reward[:, n_points // 2 :], axis=1).std(axis=1) / np.sqrt(2)
        beta, zeta = np.array([run.setting.ratio for run in planned], np.float64).T
        if measure.endswith("reward_share"):
            return self._of_runs(measure.removesuffix("_share")) / (beta + zeta)
        if measure == "common_share":
            worlds = [self.results.metadata.worlds[run.setting.scenario] for run in planned]
            data = self._of_runs("throughput_bps") * np.array([one.data_per_bps for one in worlds])
            landed, max_steps = self._of_runs("landing_rate"), np.array([one.max_steps for one in worlds])
            docked = (max_steps - self._of_runs("arrival_step") + landed) / max_steps  # share of the steps
            r_plus = np.where([one.reward_data == "step" for one in worlds], docked, landed)
            return (beta * data + zeta * r_plus) / (beta + zeta)
        raise TrainingError(f"no measure {measure!r}")


def final(curves: Array) -> Array:
    """Performance: mean over the last points, `[n, P]` to `[n]`."""
    return curves[:, -max(round(FINAL * curves.shape[1]), 1) :].mean(axis=1)


def smooth(curves: Array) -> Array:
    """Centred moving average over `SMOOTHING` points, fewer at the ends, `[..., P]`."""
    n_points, half = curves.shape[-1], SMOOTHING // 2
    windows = [curves[..., max(i - half, 0) : i + half + 1].mean(axis=-1) for i in range(n_points)]
    return np.stack(windows, axis=-1)


def settling(curves: Array, goal: Array, episode: Array) -> Array:
    """Episode `[n]` from which on smoothed curves stay above 90% of the way from their start to a goal.

    It is the last one for a goal that is not above the start, or a curve that does not stay. Curves are
    `[n, P]`, goals `[n]`, and the episodes of the points `[P]`.
    """
    start = curves[:, 0]
    level = start + SETTLED * (goal - start)
    below = smooth(curves) < level[:, None]
    # Index after the last point below the level; the first point if there is none.
    after = np.where(below.any(axis=1), curves.shape[1] - np.argmax(below[:, ::-1], axis=1), 0)
    settled = np.where(goal > start, after, len(episode))
    return np.asarray(episode)[np.minimum(settled, len(episode) - 1)].astype(np.float64)
