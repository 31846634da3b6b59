"""Claims, and the rules that test their criteria."""

from collections.abc import Callable, Iterator, Sequence
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.stats import Interval, interval
from uav_dc_ros.experiments.paper.evidence import FINAL, SETTLED, SMOOTHING, Evidence
from uav_dc_ros.experiments.paper.plan import FIGURES
from uav_dc_ros.experiments.paper.setting import Ratio, Setting, name

Verdict: TypeAlias = Literal["holds", "does not hold", "undecided", "not tested"]

MARGIN = 0.05  # relative, of "similar" and "stable"

# Fixed before any result of the sweep was seen, but for the interval, which is that of `core.stats`.
RULES = f"""\
- **Performance** of a run is its mean over the last {FINAL:.0%} of its training episodes, exploration
  included, as in the paper's curves. *Reward* is that of a mission: r^t (eq. 7) at its end with the data so
  far, the mean of r^t over its steps with the data of the step. Its scale grows with beta + zeta, so what
  compares or averages over ratios divides it by beta + zeta: the *reward share*.
- **Convergence** is the episode from which on the reward's moving average over {SMOOTHING} points stays above
  start + {SETTLED:.0%} of (final - start), where start is the first point and final the performance. A run
  that does not rise, or does not stay there, gets the number of all episodes.
- **Effects** are paired: both sides are taken in the same environment, with the same seed; repeats are
  averaged there, and so are the ratios of a claim over beta/zeta. The interval is a 95% studentised bootstrap
  over environments. "Best" compares with the best of all others, found anew in every resample.
- **A direction** (better, faster, higher) holds when the interval lies above 0, does not hold when no part of
  it does, and is undecided otherwise: no takes as much evidence as yes, and a tie is not better.
- **An equality** (similar, stable, little difference) holds when the interval lies within ±{MARGIN:.0%}, does
  not hold when it lies outside, and is undecided otherwise.
- **Everywhere** means each ratio by itself: it holds when every one holds, and does not when one does not.
  "Almost all" allows one exception. The effect shown is the worst of those ratios that decide.
- **A claim** holds when all its parts do, does not hold when one part does not, and is undecided otherwise.
- Measures under "beside" never decide: they show what the claim's own measure hides.

Five or ten environments are few. In a simulation the interval covers the true value in 92% to 97% of normal,
uniform and exponential samples, in 86% of five log-normal values, and a lead over the best of several equal
options in 88% to 92%. The percentile bootstrap, with which the first sweep was reported before, covers 78% to
91%, and a lead in 34% to 73%: it finds most equal options worse. It was replaced for that, whatever the
verdicts. Among some fifty parts a few come out by chance: read the effect, not only the verdict."""


class Criterion(NamedTuple):
    """One part of a claim, tested."""

    text: str  # the part in words
    effect: Interval
    unit: str
    rule: str  # condition of `holds`
    verdict: Verdict
    detail: str = ""  # the ratios at which it holds and does not
    decides: bool = True  # the verdict on the claim


class ClaimTable(NamedTuple):
    """A table beside a claim; its cells are means over environments with their intervals."""

    setting: Setting  # common to all cells
    rows: tuple[str, ...]  # axes of the sweep; each combination of their values is a row
    measures: tuple[str, ...]  # see `Evidence`; a column each, or a table each with `columns`
    columns: str | None = None  # an axis


class Claim(NamedTuple):
    """A claim of the paper."""

    id: str
    setting: str  # in words
    text: str
    test: Callable[[Evidence], Iterator[Criterion]]
    tables: tuple[ClaimTable, ...]
    # Contradictions with arithmetic, the paper's text or another claim; independent of the results.
    notes: tuple[str, ...]

    @property
    def figures(self) -> tuple[str, ...]:
        """Names of the figures that show it."""
        return tuple(name for name, figure in FIGURES.items() if self.id in figure.claims)


def claim(
    id: str, setting: str, text: str, *notes: str, tables: Sequence[ClaimTable]
) -> Callable[[Callable[[Evidence], Iterator[Criterion]]], Claim]:
    """Makes a claim of the function that yields its criteria."""
    return lambda test: Claim(id, setting, text, test, tuple(tables), notes)


def beside(criterion: Criterion) -> Criterion:
    """The criterion as one that does not decide the verdict on its claim."""
    return criterion._replace(decides=False)


def greater(text: str, effect: Array | Interval, unit: str) -> Criterion:
    """A direction: the effect, `[E]` or its interval, is above 0."""
    effect = effect if isinstance(effect, Interval) else interval(effect)
    verdict: Verdict = "undecided"
    if effect.low > 0:
        verdict = "holds"
    elif effect.high <= 0:
        verdict = "does not hold"
    return Criterion(text, effect, unit, "above 0", verdict)


def over_ratios(text: str, effects: Array, ratios: Sequence[Ratio], unit: str) -> Criterion:
    """A direction on the average over ratios; effects `[E, R]`."""
    return greater(text, effects.mean(axis=1), unit)._replace(detail=_signs(effects, ratios))


def everywhere(
    text: str, effects: Array, ratios: Sequence[Ratio], unit: str, exceptions: int = 0
) -> Criterion:
    """A direction in each ratio by itself, with some exceptions; effects `[E, R]`."""
    each = [greater(text, column, unit) for column in effects.T]
    verdicts = [one.verdict for one in each]
    verdict: Verdict = "undecided"
    if verdicts.count("holds") >= len(each) - exceptions:
        verdict = "holds"
    elif verdicts.count("does not hold") > exceptions:
        verdict = "does not hold"
    worst = min((one for one in each if one.verdict == verdict), key=lambda one: one.effect.mean)
    rule = f"above 0 in {f'all but {exceptions}' if exceptions else 'every'} ratio"
    return worst._replace(rule=rule, detail=_signs(effects, ratios))


def within(
    text: str, samples: Array, relative: Callable[[Array], Array], margin: float = MARGIN
) -> Criterion:
    """An equality: a relative difference, of means over environments of `[E, ...]`, is near 0."""
    effect, limit = interval(samples, lambda means: 100 * relative(means)), 100 * margin
    verdict: Verdict = "undecided"
    if -limit <= effect.low and effect.high <= limit:
        verdict = "holds"
    elif effect.low > limit or effect.high < -limit:
        verdict = "does not hold"
    return Criterion(text, effect, "%", f"within ±{margin:.0%}", verdict)


def all_within(text: str, samples: Array, ratios: Sequence[Ratio]) -> Criterion:
    """An equality of ratios: each, of `[E, R]`, is near the mean of all."""
    each = [
        within(text, samples, lambda means, i=i: means[:, i] / means.mean(axis=1) - 1)  # type: ignore[misc]
        for i in range(samples.shape[1])
    ]
    verdict = joint(each)
    worst = max((one for one in each if one.verdict == verdict), key=lambda one: abs(one.effect.mean))
    detail = "; ".join(
        f"{name(ratio)}: {one.effect.mean:+.1f}%" for ratio, one in zip(ratios, each, strict=True)
    )
    return worst._replace(detail=detail)


def joint(criteria: Sequence[Criterion]) -> Verdict:
    """The verdict on a claim: all criteria that decide must hold, and one that does not decides."""
    verdicts = {criterion.verdict for criterion in criteria if criterion.decides}
    if "does not hold" in verdicts:
        return "does not hold"
    return "holds" if verdicts == {"holds"} else "undecided"


def lead(options: Array, favourite: Sequence[int]) -> Interval:
    """Margin of the worst of the favoured options over the best of the others; options `[E, K]`."""
    others = [i for i in range(options.shape[1]) if i not in favourite]
    return interval(options, lambda means: means[:, favourite].min(axis=1) - means[:, others].max(axis=1))


def fall(values: Array) -> Array:
    """Decrease of a measure per step from ratio to ratio (least squares), `[E, R]` to `[E]`."""
    rank = np.arange(values.shape[1]) - (values.shape[1] - 1) / 2
    return -(values * rank).sum(axis=1) / (rank**2).sum()


def _signs(effects: Array, ratios: Sequence[Ratio]) -> str:
    means = effects.mean(axis=0)
    against = [name(ratio) for ratio, mean in zip(ratios, means, strict=True) if not mean > 0]
    text = f"as claimed at {len(means) - len(against)} of {len(means)} ratios"
    return f"{text}, not at {', '.join(against)}" if against else text
