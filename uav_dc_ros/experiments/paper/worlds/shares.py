"""For each claim: the share of worlds in which it holds, and the choices that decide it.

The measure of a choice is the information that it gives on the verdict, adjusted for chance: with the mutual
information I of the verdict and the choice (a number in three classes of equal size), the entropy H of the
verdict and E[I] of verdicts in random order,

    (I - E[I]) / (H - E[I])

It is 0 for a choice that decides nothing and 1 for one that decides all (Vinh, Epps and Bailey, Information
theoretic measures for clusterings comparison, JMLR 11, 2010, with H as the upper bound). Without the
adjustment, choices with more classes would look better. A choice counts only above the null: the 95%
quantile, over random orders of the verdicts, of the greatest measure of any choice. So where no choice
matters, one is named by mistake for one claim in twenty.

The measure takes each choice by itself; what only a combination of choices decides is not found.
"""

from typing import NamedTuple

import numpy as np

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.experiments.paper.worlds.verdicts import IDS, VERDICTS, Multiverse

_SHUFFLES = 1000
_QUANTILE = 0.95
_CLASSES = 3  # of a number
_NAMED = 2  # choices for each claim
_Z = 1.959964  # of a 95% interval


class Share(NamedTuple):
    """A share of the worlds, with its 95% interval."""

    n: int
    share: float
    low: float
    high: float


class Decider(NamedTuple):
    """A choice that decides a claim."""

    name: str  # of `World.features`
    measure: float  # see above
    shares: tuple[tuple[str, float], ...]  # of the worlds in which the claim holds, by class


class ClaimShares(NamedTuple):
    """A claim over all worlds."""

    claim: str
    shares: tuple[Share, ...]  # in the order of `VERDICTS`
    deciders: tuple[Decider, ...]  # the first is the strongest; none above the null: empty
    null: float  # of the measure


def share(n: int, total: int) -> Share:
    """Wilson's interval of a share of independent worlds; those of a Sobol sequence spread it less."""
    p, z2 = n / total, _Z**2
    middle = (p + z2 / (2 * total)) / (1 + z2 / total)
    half = _Z * np.sqrt(p * (1 - p) / total + z2 / (4 * total**2)) / (1 + z2 / total)
    return Share(n, p, max(float(middle - half), 0.0), min(float(middle + half), 1.0))


def holding(multiverse: Multiverse) -> dict[str, Share | None]:
    """The share of the drawn worlds in which each claim holds; None: it is not weighed."""
    holds = (multiverse.drawn.verdicts == "holds").T
    return {
        claim: share(int(column.sum()), len(column)) if tested else None
        for claim, column, tested in zip(IDS, holds, multiverse.tested, strict=True)
    }


def summaries(multiverse: Multiverse) -> list[ClaimShares]:
    """Every claim over all worlds, in the order of `IDS`."""
    features = [world.features() for world in multiverse.worlds]
    classes = {name: _classes([one[name] for one in features]) for name in features[0]}
    return [
        _summary(claim, column, classes) for claim, column in zip(IDS, multiverse.verdicts.T, strict=True)
    ]


def _summary(claim: str, verdicts: Array, classes: dict[str, tuple[Array, list[str]]]) -> ClaimShares:
    n = len(verdicts)
    shares = tuple(share(int((verdicts == verdict).sum()), n) for verdict in VERDICTS)
    measures, null = information(verdicts, [of for of, _ in classes.values()])
    ranked = sorted(zip(measures, classes, strict=True), key=lambda one: (-one[0], one[1]))
    deciders = tuple(
        Decider(
            name=name,
            measure=measure,
            shares=tuple(
                (label, float((verdicts[of == i] == "holds").mean())) for i, label in enumerate(labels)
            ),
        )
        for measure, name in ranked[:_NAMED]
        if measure > null
        for of, labels in [classes[name]]
    )
    return ClaimShares(claim, shares, deciders, null)


def information(verdicts: Array, columns: list[Array]) -> tuple[list[float], float]:
    """The measure of each column of classes `[W]`, and the null; all zero if every verdict is the same."""
    kinds, verdict = np.unique(verdicts, return_inverse=True)
    if len(kinds) == 1:
        return [0.0] * len(columns), 0.0
    n, rng = len(verdicts), np.random.default_rng(0)
    orders = np.stack([np.arange(n), *(rng.permutation(n) for _ in range(_SHUFFLES))])
    one_hot = np.eye(len(kinds))[verdict][orders]  # [1 + shuffles, W, kinds]; the first is not shuffled
    entropy = _entropy(one_hot[0].mean(axis=0))
    measures = []
    for column in columns:
        joint = np.einsum("swk,wc->skc", one_hot, np.eye(column.max() + 1)[column]) / n
        mutual = entropy + _entropy(joint[0].sum(axis=0)) - _entropy(joint.reshape(len(orders), -1))
        expected = mutual[1:].mean()
        measures.append((mutual - expected) / max(entropy - expected, 1e-9))
    of_all = np.stack(measures)  # [columns, 1 + shuffles]
    return of_all[:, 0].tolist(), float(np.quantile(of_all[:, 1:].max(axis=0), _QUANTILE))


def _entropy(p: Array) -> Array:
    """Entropy of distributions `[..., n]`, nats, `[...]`."""
    return -(p * np.log(np.where(p > 0, p, 1.0))).sum(axis=-1)


def _classes(values: list[object]) -> tuple[Array, list[str]]:
    """The class of each value, integers `[W]`, and the classes in words: the values, or ranges of many."""
    found = sorted(set(values))  # type: ignore[type-var]
    if len(found) <= _CLASSES + 1:
        return np.array([found.index(value) for value in values]), [_words(value) for value in found]
    rank = np.argsort(np.argsort(np.array(values, np.float64), kind="stable"), kind="stable")
    of = rank * _CLASSES // len(values)
    ranges = [sorted(value for value, i in zip(values, of, strict=True) if i == c) for c in range(_CLASSES)]  # type: ignore[type-var]
    return of, [f"{_words(one[0])} to {_words(one[-1])}" for one in ranges]


def _words(value: object) -> str:
    return value if isinstance(value, str) else f"{value:.3g}"
