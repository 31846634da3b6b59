"""What a claim is weighed with: measures of the runs, intervals over the environments, verdicts."""

from collections.abc import Callable, Sequence
from itertools import product
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.stats import Interval, interval
from uav_dc_ros.errors import TrainingError
from uav_dc_ros.experiments.paper.results import GREEDY, METRICS, Results
from uav_dc_ros.experiments.paper.setting import Ratio, Setting

Verdict: TypeAlias = Literal["holds", "does not hold", "undecided", "not tested"]

# The performance of a run is the mean over this last share of its episodes.
FINAL = 0.2
# Points on which a curve's moving average rests. Fifty episodes, in the full sweep.
SMOOTHING = 5
# A run has converged when this share of its way is behind it.
SETTLED = 0.9
# What counts as "similar" and "stable", relative.
MARGIN = 0.05

RULES = f"""\
- **Performance** of a run is its mean over the last {FINAL:.0%} of its training episodes, exploration
  included, as in the paper's curves. *Reward* is r^t (eq. 7) at the end of a mission. Its scale grows with
  beta + zeta, so what compares or averages over ratios divides it by beta + zeta: the *reward share*.
- **Convergence** is the episode from which on the reward's moving average over {SMOOTHING} points stays above
  start + {SETTLED:.0%} of (final - start), where start is the first point and final the performance. A run
  that does not rise, or does not stay there, gets the number of all episodes.
- **Effects** are paired: both sides are taken in the same environment, with the same seed; repeats are
  averaged there, and so are the ratios of a claim over beta/zeta. The interval is a 95% percentile bootstrap
  over environments. "Best" compares with the best of all others, found anew in every resample.
- **A direction** (better, faster, higher) holds when the interval lies above 0, does not hold when no part of
  it does, and is undecided otherwise: no takes as much evidence as yes, and a tie is not better.
- **An equality** (similar, stable, little difference) holds when the interval lies within ±{MARGIN:.0%}, does
  not hold when it lies outside, and is undecided otherwise.
- **Everywhere** means each ratio by itself: it holds when every one holds, and does not when one does not.
  "Almost all" allows one exception. The effect shown is the worst of those ratios that decide.
- **A claim** holds when all its parts do, does not hold when one part does not, and is undecided otherwise.
- Measures under "beside" never decide: they show what the claim's own measure hides.

Five environments are few. A bootstrap of five values is too narrow (it covers nearer 85% than 95%), and among
some fifty parts a few come out by chance: read the effect, not only the verdict."""


class NotMeasured(Exception):
    """The results lack a setting: they were made for other figures. Caught where claims are checked."""


class Part(NamedTuple):
    """One thing that a claim says.

    Attributes:
        text: what is claimed.
        effect: how far it is so.
        unit: of the effect.
        rule: when it holds.
        verdict: whether it does.
        detail: where it does and where it does not.
    """

    text: str
    effect: Interval
    unit: str
    rule: str
    verdict: Verdict
    detail: str = ""


class Table(NamedTuple):
    """Numbers for the reader: a header and rows of text."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


class Weighed(NamedTuple):
    """What came of a claim: parts decide, those beside do not, tables show."""

    parts: tuple[Part, ...]
    beside: tuple[Part, ...] = ()
    tables: tuple[Table, ...] = ()


class Evidence:
    """Measures of runs, arranged by what a claim compares.

    A measure is a name in `results.METRICS` or `GREEDY`, or one of
        convergence                           episodes, see `RULES`
        middle                                reward after 40% to 60% of the episodes
        fluctuation                           of the reward from point to point, second half of the episodes
        reward_share, greedy_reward_share     reward / (beta + zeta)
        common_share                          reward_share if R_plus were binary for all
    """

    def __init__(self, results: Results) -> None:
        self.results = results
        self.scale = results.metadata.scale
        self._measured: dict[str, Array] = {}

    def of(self, measure: str, setting: Setting, **axes: Sequence[object]) -> Array:
        """A measure in every environment, `[E, ...]`, with an axis for each of `axes`; means over repeats.

        Raises:
            NotMeasured: a setting has no run in one of the environments.
        """
        values = self._values(measure)
        cells = [
            self._by_environment(values, setting.with_(**dict(zip(axes, point, strict=True))))
            for point in product(*axes.values())
        ]
        return np.stack(cells, axis=-1).reshape(-1, *(len(axis) for axis in axes.values()))

    def curves(self, metric: str, setting: Setting) -> Array:
        """A setting's curves in every environment, `[E, P]`; means over repeats."""
        return self._by_environment(np.asarray(self.results.curves[metric], np.float64), setting)

    def world(self, setting: Setting, name: Literal["n_users", "max_steps"]) -> int:
        """A value of the world of a setting."""
        return int(getattr(self.results.metadata.worlds[setting.scenario], name))

    def reach(self, setting: Setting, goal: Array) -> Array:
        """Episodes until a setting's reward is 90% of its way to a goal and stays there.

        Args:
            setting: whose curves.
            goal: reward in each environment, `[E]`.

        Returns:
            Episodes, `[E]`; all of them where it never does.
        """
        runs = self.results.of(setting)
        own = [self.scale.environments.index(self.results.planned[i].environment) for i in runs]
        values = np.zeros(len(self.results.planned))
        reward = np.asarray(self.results.curves["reward"], np.float64)[runs]
        values[runs] = settling(reward, goal[own], self.results.episode)
        return self._by_environment(values, setting)

    def _by_environment(self, values: Array, setting: Setting) -> Array:
        """Means over repeats of what each run has, `[n_runs, ...]` to `[E, ...]`."""
        runs = self.results.of(setting)
        found = {self.results.planned[i].environment for i in runs}
        if missing := set(self.scale.environments) - found:
            raise NotMeasured(f"{setting} in environment {min(missing)}")
        of_run = np.array([self.results.planned[i].environment for i in runs])
        return np.stack([values[runs[of_run == e]].mean(axis=0) for e in self.scale.environments])

    def _values(self, measure: str) -> Array:
        """A measure of every run, `[n_runs]`."""
        if measure not in self._measured:
            self._measured[measure] = np.asarray(self._measure(measure), np.float64)
        return self._measured[measure]

    def _measure(self, measure: str) -> Array:
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
            return self._values(measure.removesuffix("_share")) / (beta + zeta)
        if measure == "common_share":
            per_bps = [self.results.metadata.worlds[run.setting.scenario].data_per_bps for run in planned]
            data = self._values("throughput_bps") * np.array(per_bps)
            return (beta * data + zeta * self._values("landing_rate")) / (beta + zeta)
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
    """Episode from which on smoothed curves stay above 90% of the way from their first point to a goal.

    Args:
        curves: `[n, P]`.
        goal: `[n]`.
        episode: of each point, `[P]`.

    Returns:
        Episodes, `[n]`: the last one for a goal that is not above the start, or a curve that does not stay.
    """
    start = curves[:, 0]
    level = start + SETTLED * (goal - start)
    below = smooth(curves) < level[:, None]
    # Index after the last point below the level; the first point if there is none.
    after = np.where(below.any(axis=1), curves.shape[1] - np.argmax(below[:, ::-1], axis=1), 0)
    settled = np.where(goal > start, after, len(episode))
    return np.asarray(episode)[np.minimum(settled, len(episode) - 1)].astype(np.float64)


def greater(text: str, effect: Array | Interval, unit: str) -> Part:
    """A direction: the effect, `[E]` or weighed already, is above 0."""
    weighed = effect if isinstance(effect, Interval) else interval(effect)
    return Part(text, weighed, unit, "above 0", _direction(weighed))


def over_ratios(text: str, effects: Array, ratios: Sequence[Ratio], unit: str) -> Part:
    """A direction on the average over ratios; effects `[E, R]`."""
    part = greater(text, effects.mean(axis=1), unit)
    return part._replace(detail=_signs(effects, ratios))


def everywhere(text: str, effects: Array, ratios: Sequence[Ratio], unit: str, exceptions: int = 0) -> Part:
    """A direction in each ratio by itself, but for some exceptions; effects `[E, R]`."""
    each = [interval(column) for column in effects.T]
    verdicts = [_direction(one) for one in each]
    verdict: Verdict = "undecided"
    if verdicts.count("holds") >= len(each) - exceptions:
        verdict = "holds"
    elif verdicts.count("does not hold") > exceptions:
        verdict = "does not hold"
    decisive = min(
        (one for one, own in zip(each, verdicts, strict=True) if own == verdict), key=lambda one: one.mean
    )
    rule = f"above 0 in {'every' if not exceptions else f'all but {exceptions}'} ratio"
    return Part(text, decisive, unit, rule, verdict, _signs(effects, ratios))


def within(text: str, samples: Array, relative: Callable[[Array], Array], margin: float = MARGIN) -> Part:
    """An equality: a relative difference, of means over environments of `[E, ...]`, is near 0."""
    effect = interval(samples, lambda means: 100 * relative(means))
    return Part(text, effect, "%", f"within ±{margin:.0%}", _equality(effect, 100 * margin))


def all_within(text: str, samples: Array, ratios: Sequence[Ratio]) -> Part:
    """An equality of ratios: each, of `[E, R]`, is near the mean of all."""
    parts = [
        within(text, samples, lambda means, i=i: means[:, i] / means.mean(axis=1) - 1)  # type: ignore[misc]
        for i in range(samples.shape[1])
    ]
    verdict = joint([part.verdict for part in parts])
    worst = max((part for part in parts if part.verdict == verdict), key=lambda part: abs(part.effect.mean))
    detail = "; ".join(
        f"{name(ratio)}: {part.effect.mean:+.1f}%" for ratio, part in zip(ratios, parts, strict=True)
    )
    return worst._replace(detail=detail)


def joint(verdicts: Sequence[Verdict]) -> Verdict:
    """Of several parts: all must hold, and one that does not decides."""
    if "does not hold" in verdicts:
        return "does not hold"
    return "holds" if all(verdict == "holds" for verdict in verdicts) else "undecided"


def lead(options: Array, favourite: Sequence[int]) -> Interval:
    """By how much the worst of the favoured options is above the best of the others; options `[E, K]`."""
    others = [i for i in range(options.shape[1]) if i not in favourite]
    return interval(options, lambda means: means[:, favourite].min(axis=1) - means[:, others].max(axis=1))


def fall(values: Array) -> Array:
    """How much a measure falls per step from ratio to ratio (least squares), `[E, R]` to `[E]`."""
    rank = np.arange(values.shape[1]) - (values.shape[1] - 1) / 2
    return -(values * rank).sum(axis=1) / (rank**2).sum()


def name(value: object) -> str:
    """What a value of a setting is called."""
    if isinstance(value, tuple):
        return f"{value[0]:g}:{value[1]:g}"
    words = {
        "dqn": "DQL",
        "dueling_dqn": "dueling DQL",
        "three_clusters": "3 clusters",
        "five_clusters": "5 clusters",
    }
    return words.get(value, value) if isinstance(value, str) else f"{value:g}"


def _direction(effect: Interval) -> Verdict:
    if effect.low > 0:
        return "holds"
    return "does not hold" if effect.high <= 0 else "undecided"


def _equality(effect: Interval, margin: float) -> Verdict:
    if -margin <= effect.low and effect.high <= margin:
        return "holds"
    return "does not hold" if effect.low > margin or effect.high < -margin else "undecided"


def _signs(effects: Array, ratios: Sequence[Ratio]) -> str:
    means = effects.mean(axis=0)
    against = [name(ratio) for ratio, mean in zip(ratios, means, strict=True) if not mean > 0]
    text = f"as claimed at {len(means) - len(against)} of {len(means)} ratios"
    return f"{text}, not at {', '.join(against)}" if against else text
