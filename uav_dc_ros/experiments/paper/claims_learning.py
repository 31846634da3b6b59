"""The paper's claims on how to learn: C18 to C20. All with 5 clusters, DQL, exponential, episode, 1:1."""

from itertools import product

import numpy as np

from uav_dc_ros.experiments.paper.evidence import Evidence, Weighed, greater, lead, name
from uav_dc_ros.experiments.paper.setting import Setting
from uav_dc_ros.experiments.paper.tables import by_setting, numbers

_FIVE = Setting(scenario="five_clusters")


def c18(e: Evidence) -> Weighed:
    """gamma 0.9 and epsilon 0.9 are best."""
    axes = {"gamma": e.scale.gammas, "epsilon": e.scale.epsilons}
    n = len(e.scale.environments)
    reward, greedy = (e.of(measure, _FIVE, **axes).reshape(n, -1) for measure in ("reward", "greedy_reward"))
    paper = list(product(*axes.values())).index((0.9, 0.9))
    return Weighed(
        parts=(greater("0.9 and 0.9 above the best of the others", lead(reward, [paper]), "r^t"),),
        beside=(greater("the same of greedy missions", lead(greedy, [paper]), "r^t"),),
        tables=numbers(
            e,
            _FIVE,
            {"gamma": e.scale.gammas},
            ("epsilon", e.scale.epsilons),
            "reward",
            "greedy_reward",
            "landing_rate",
        ),
    )


def c19(e: Evidence) -> Weighed:
    """A batch of 32 converges fastest."""
    sizes = e.scale.batch_sizes
    settled, reward = (e.of(measure, _FIVE, batch_size=sizes) for measure in ("convergence", "reward"))
    paper = sizes.index(32)
    # Sooner is less, so the order is turned round.
    soonest = lead(-settled, [paper])
    return Weighed(
        parts=(greater("32 converges before the soonest of the others", soonest, "episodes"),),
        beside=(greater("32 has the best reward (said in the text)", lead(reward, [paper]), "r^t"),),
        tables=by_setting(e, _FIVE, {"batch_size": sizes}, "convergence", "reward", "greedy_reward"),
    )


def c20(e: Evidence) -> Weighed:
    """A learning rate of 0.01 fluctuates, 1e-4 and 1e-5 are slower or stuck, 1e-3 is best."""
    rates = e.scale.learning_rates
    reward = e.of("reward", _FIVE, learning_rate=rates)
    paper = rates.index(1e-3)
    fluctuation = e.of("fluctuation", _FIVE, learning_rate=(1e-2, 1e-3))
    # One goal for all: by its own final level, a run that is stuck would have converged early.
    reach = np.stack([e.reach(_FIVE.with_(learning_rate=rate), reward[:, paper]) for rate in rates], axis=1)
    slower = [
        greater(
            f"{name(rate)} gets to the level of 0.001 later, or never",
            reach[:, rates.index(rate)] - reach[:, paper],
            "episodes",
        )
        for rate in (1e-4, 1e-5)
    ]
    return Weighed(
        parts=(
            greater("0.01 fluctuates more than 0.001", fluctuation[:, 0] - fluctuation[:, 1], "r^t"),
            *slower,
            greater("0.001 above the best of the others", lead(reward, [paper]), "r^t"),
        ),
        tables=by_setting(
            e, _FIVE, {"learning_rate": rates}, "reward", "greedy_reward", "fluctuation", "convergence"
        ),
    )
