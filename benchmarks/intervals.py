"""How often 95% intervals of few values cover the true value, in percent.

    python benchmarks/intervals.py [--samples S]

Each line is one statistic of S samples of n values: the mean of one distribution, the mean of paired
differences, or the lead of one option over the best of several others that are as good ("best" in the
paper's claims). The three methods use the same 2,000 resamples; the studentised one is that of
`uav_dc_ros.core.stats`. With 1,000 samples the standard error of a figure near 95 is 0.7.
"""

import argparse
from collections.abc import Callable
from statistics import NormalDist

import numpy as np
from numpy.random import Generator

from uav_dc_ros.core.stats import studentised

RESAMPLES = 2_000
CHUNK = 50  # samples at a time
CDF, INVERSE = np.vectorize(NormalDist().cdf), np.vectorize(NormalDist().inv_cdf)
QUANTILE = NormalDist().inv_cdf(0.975)
Statistic = Callable[[np.ndarray], np.ndarray]  # of means `[R, S, K]`, to `[R, S]`


def mean(means: np.ndarray) -> np.ndarray:
    """Of the first of K values."""
    return means[..., 0]


def difference(means: np.ndarray) -> np.ndarray:
    """Of the first to the second: paired, since both are of the same resample."""
    return means[..., 0] - means[..., 1]


def lead(means: np.ndarray) -> np.ndarray:
    """Of the first over the best of the others."""
    return means[..., 0] - means[..., 1:].max(axis=-1)


def shared(rng: Generator, shape: tuple[int, ...], draw: Callable[..., np.ndarray]) -> np.ndarray:
    """Options that share half of their variance, as all runs in one environment do."""
    return draw(rng, (*shape[:-1], 1)) + draw(rng, shape)


def normal(rng: Generator, shape: tuple[int, ...]) -> np.ndarray:
    return rng.standard_normal(shape)


def exponential(rng: Generator, shape: tuple[int, ...]) -> np.ndarray:
    return rng.standard_exponential(shape)


def log_normal(rng: Generator, shape: tuple[int, ...]) -> np.ndarray:
    return np.exp(rng.standard_normal(shape))


def two_point(share: float) -> Callable[..., np.ndarray]:
    return lambda rng, shape: (rng.random(shape) < share).astype(float)


# Name: draws of `[n, S, K]`, K, the statistic, and its true value.
CASES: dict[str, tuple[Callable[..., np.ndarray], int, Statistic, float]] = {
    "mean, normal": (normal, 1, mean, 0.0),
    "mean, uniform": (lambda rng, shape: rng.random(shape), 1, mean, 0.5),
    "mean, exponential": (exponential, 1, mean, 1.0),
    "mean, log-normal": (log_normal, 1, mean, np.exp(0.5)),
    "mean, 0 or 1, evenly": (two_point(0.5), 1, mean, 0.5),
    "mean, 0 or 1, 80% are 1": (two_point(0.8), 1, mean, 0.8),
    "difference, normal": (lambda rng, s: shared(rng, s, normal), 2, difference, 0.0),
    "difference, exponential": (lambda rng, s: shared(rng, s, exponential) * [1.5, 1.0], 2, difference, 1.0),
    "difference, 0 or 1": (lambda rng, s: two_point(np.array([0.7, 0.4]))(rng, s), 2, difference, 0.3),
    "lead over the best of 4": (lambda rng, s: shared(rng, s, normal), 5, lead, 0.0),
    "lead over the best of 15": (lambda rng, s: shared(rng, s, normal), 16, lead, 0.0),
}


def resampled(values: np.ndarray, statistic: Statistic) -> np.ndarray:
    """The statistic of resamples, `[R, S]`; values `[n, S, K]`."""
    n = len(values)
    draws = np.random.default_rng(0).integers(0, n, (RESAMPLES, n))
    return statistic(sum(values[draw] for draw in draws.T) / n)


def percentile(values: np.ndarray, statistic: Statistic) -> tuple[np.ndarray, np.ndarray]:
    low, high = np.quantile(resampled(values, statistic), (0.025, 0.975), axis=0)
    return low, high


def bca(values: np.ndarray, statistic: Statistic) -> tuple[np.ndarray, np.ndarray]:
    """Bias-corrected and accelerated (Efron 1987)."""
    n, found = len(values), resampled(values, statistic)
    estimate = statistic(values.mean(axis=0)[None])[0]
    without = np.stack([statistic(np.delete(values, i, axis=0).mean(axis=0)[None])[0] for i in range(n)])
    skewed = without.mean(axis=0) - without
    spread = (skewed**2).sum(axis=0) ** 1.5
    acceleration = np.divide((skewed**3).sum(axis=0), 6 * spread, out=np.zeros_like(spread), where=spread > 0)
    below = (found < estimate).mean(axis=0) + (found == estimate).mean(axis=0) / 2
    bias = INVERSE(np.clip(below, 1 / RESAMPLES, 1 - 1 / RESAMPLES))
    ends = []
    for z in (bias - QUANTILE, bias + QUANTILE):
        levels = CDF(bias + z / (1 - acceleration * z))
        ends.append(np.array([np.quantile(one, level) for one, level in zip(found.T, levels, strict=True)]))
    return ends[0], ends[1]


def bootstrap_t(values: np.ndarray, statistic: Statistic) -> tuple[np.ndarray, np.ndarray]:
    return studentised(values, statistic, RESAMPLES)[1:]


METHODS = {"percentile": percentile, "BCa": bca, "studentised": bootstrap_t}


def main() -> None:
    """Prints a table in Markdown: coverage, and in brackets the mean width."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--samples", type=int, default=1_000, metavar="S")
    parser.add_argument("--sizes", type=int, nargs="+", default=[5, 10], metavar="N")
    options = parser.parse_args()
    print(f"| n | statistic | {' | '.join(METHODS)} |\n|---|---|{'---|' * len(METHODS)}")
    for n in options.sizes:
        for name, (draw, k, statistic, true) in CASES.items():
            rng, ends = np.random.default_rng(1), {method: [] for method in METHODS}
            for _ in range(-(-options.samples // CHUNK)):
                values = draw(rng, (n, CHUNK, k))
                for method, compute in METHODS.items():
                    ends[method].append(compute(values, statistic))
            cells = []
            for found in ends.values():
                low, high = np.concatenate(found, axis=1)
                covered = np.mean((low <= true + 1e-9) & (true - 1e-9 <= high))
                cells.append(f"{100 * covered:.1f} ({np.mean(high - low):.2f})")
            print(f"| {n} | {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
