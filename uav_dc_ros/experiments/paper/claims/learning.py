"""The paper's claims on hyperparameters, C18 to C20: 5 clusters, DQL, exponential, episode, 1:1."""

from collections.abc import Iterator

import numpy as np

from uav_dc_ros.experiments.paper.claims.criteria import ClaimTable, Criterion, beside, claim, greater, lead
from uav_dc_ros.experiments.paper.evidence import Evidence
from uav_dc_ros.experiments.paper.setting import Setting, name

_FIVE = Setting(scenario="five_clusters")
_GREEDY = ("reward", "greedy_reward")


@claim(
    "C18",
    "5 clusters, DQL",
    "best gamma 0.9 and epsilon 0.9",
    "The curves are of missions with exploration, so a greater epsilon looks better whether or not more was "
    "learnt; the greedy missions beside separate the two.",
    "What the winners were compared with is not in the paper; the grid is this project's.",
    tables=[ClaimTable(_FIVE, ("gamma",), (*_GREEDY, "landing_rate"), "epsilon")],
)
def _c18(e: Evidence) -> Iterator[Criterion]:
    reward, greedy = (e.of(measure, _FIVE, "gamma", "epsilon") for measure in _GREEDY)
    paper = e.scale.gammas.index(0.9) * len(e.scale.epsilons) + e.scale.epsilons.index(0.9)
    best, best_greedy = (lead(values.reshape(len(values), -1), [paper]) for values in (reward, greedy))
    yield greater("0.9 and 0.9 above the best of the others", best, "r^t")
    yield beside(greater("the same of greedy missions", best_greedy, "r^t"))


@claim(
    "C19",
    "5 clusters, DQL",
    "batch 32 converges fastest",
    "The paper calls the difference slight.",
    "Runs with different batch sizes draw different numbers, so these pairs share the users' start only.",
    tables=[ClaimTable(_FIVE, ("batch_size",), ("convergence", *_GREEDY))],
)
def _c19(e: Evidence) -> Iterator[Criterion]:
    settled, reward = (e.of(measure, _FIVE, "batch_size") for measure in ("convergence", "reward"))
    paper = e.scale.batch_sizes.index(32)
    yield greater("32 converges before the soonest of the others", lead(-settled, [paper]), "episodes")
    yield beside(greater("32 has the best reward (stated in the text)", lead(reward, [paper]), "r^t"))


@claim(
    "C20",
    "5 clusters, DQL",
    "lr 0.01 fluctuates; 1e-4 and 1e-5 slower or stuck; 1e-3 best",
    '"Slower or stuck" is measured against the level that 1e-3 reaches in the same environment.',
    tables=[ClaimTable(_FIVE, ("learning_rate",), (*_GREEDY, "fluctuation", "convergence"))],
)
def _c20(e: Evidence) -> Iterator[Criterion]:
    rates = e.scale.learning_rates
    reward, fluctuation = (e.of(measure, _FIVE, "learning_rate") for measure in ("reward", "fluctuation"))
    paper, high = rates.index(1e-3), rates.index(1e-2)
    yield greater("0.01 fluctuates more than 0.001", fluctuation[:, high] - fluctuation[:, paper], "r^t")
    # One goal for all: by its own final level, a run that is stuck would have converged early.
    reach = np.stack([e.reach(_FIVE.with_(learning_rate=rate), reward[:, paper]) for rate in rates], axis=1)
    for rate in (1e-4, 1e-5):
        later = reach[:, rates.index(rate)] - reach[:, paper]
        yield greater(f"{name(rate)} gets to the level of 0.001 later, or never", later, "episodes")
    yield greater("0.001 above the best of the others", lead(reward, [paper]), "r^t")


CLAIMS = (_c18, _c19, _c20)
