"""The paper's claims on the trajectory and on the reward: C1 to C9."""

import numpy as np

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.stats import interval
from uav_dc_ros.experiments.paper.evidence import (
    Evidence,
    Weighed,
    everywhere,
    greater,
    name,
    over_ratios,
    within,
)
from uav_dc_ros.experiments.paper.setting import ALGORITHMS, FORMS, R_PLUS, Ratio, Setting
from uav_dc_ros.experiments.paper.tables import by_setting, numbers

_THREE, _FIVE = Setting(scenario="three_clusters"), Setting(scenario="five_clusters")
_REWARDS = ("reward_share", "common_share", "greedy_reward_share")
_AT_ONE = ("reward", "greedy_reward", "convergence", "users_collected", "landing_rate")


def c1(e: Evidence) -> Weighed:
    """Visits about 40 of 50 users and lands: greedy missions of DQL, exponential, episode, 1:1."""
    users = e.of("greedy_users_collected", _FIVE) / e.world(_FIVE, "n_users")
    landed = e.of("greedy_landing_rate", _FIVE)
    return Weighed(
        parts=(
            # "About": within a tenth of 40 of 50.
            within("visits about 40 of 50 users", users, lambda means: means / 0.8 - 1, margin=0.1),
            greater("lands, in more missions than not", landed - 0.5, "of missions"),
        ),
        tables=by_setting(
            e,
            _FIVE,
            {"algorithm": ALGORITHMS, "r_plus": R_PLUS, "form": FORMS},
            "greedy_users_collected",
            "greedy_landing_rate",
            "greedy_arrival_step",
            "users_collected",
            "landing_rate",
        ),
    )


def c2(e: Evidence) -> Weighed:
    """Exponential best and fastest, at 2:1 with 3 clusters, for each algorithm, in the episode form."""
    setting = _THREE.with_(ratio=(2, 1))
    axes = {"algorithm": ALGORITHMS, "r_plus": R_PLUS}
    reward, settled = e.of("reward", setting, **axes), e.of("convergence", setting, **axes)
    common = e.of("common_share", setting, **axes)
    parts, beside = [], []
    for i, algorithm in enumerate(ALGORITHMS):
        who = name(algorithm)
        parts.append(greater(f"{who}: exponential above binary", reward[:, i, 1] - reward[:, i, 0], "r^t"))
        faster = settled[:, i, 0] - settled[:, i, 1]
        parts.append(greater(f"{who}: exponential converges sooner", faster, "episodes"))
        same = common[:, i, 1] - common[:, i, 0]
        beside.append(greater(f"{who}: exponential above binary, both judged with binary", same, "share"))
    rows = {"algorithm": ALGORITHMS, "r_plus": R_PLUS, "form": FORMS}
    return Weighed(tuple(parts), tuple(beside), by_setting(e, setting, rows, *_AT_ONE))


def c3(e: Evidence) -> Weighed:
    """Dueling above DQL, exponential above binary, over the ratios with 3 clusters, in the episode form."""
    axes = {"algorithm": ALGORITHMS, "r_plus": R_PLUS, "ratio": e.scale.ratios}
    share, common = e.of("reward_share", _THREE, **axes), e.of("common_share", _THREE, **axes)
    ratios = e.scale.ratios
    return Weighed(
        parts=(
            over_ratios("dueling DQL above DQL", _second_less_first(share, 1), ratios, "share"),
            over_ratios("exponential above binary", _second_less_first(share, 2), ratios, "share"),
        ),
        beside=(
            over_ratios(
                "exponential above binary, both judged with binary",
                _second_less_first(common, 2),
                ratios,
                "share",
            ),
        ),
        tables=numbers(
            e,
            _THREE,
            {"algorithm": ALGORITHMS, "r_plus": R_PLUS, "form": FORMS},
            ("ratio", ratios),
            *_REWARDS,
        ),
    )


def c4(e: Evidence) -> Weighed:
    """Episode above immediate at 1:1 with 5 clusters, for each R_plus and algorithm."""
    axes = {"algorithm": ALGORITHMS, "r_plus": R_PLUS, "form": FORMS}
    reward, greedy = e.of("reward", _FIVE, **axes), e.of("greedy_reward", _FIVE, **axes)
    cells = [(i, j) for i in range(2) for j in range(2)]
    return Weighed(
        parts=tuple(
            greater(
                f"{name(ALGORITHMS[i])}, {R_PLUS[j]}: episode above immediate",
                reward[:, i, j, 1] - reward[:, i, j, 0],
                "r^t",
            )
            for i, j in cells
        ),
        beside=tuple(
            greater(
                f"{name(ALGORITHMS[i])}, {R_PLUS[j]}: the same of greedy missions",
                greedy[:, i, j, 1] - greedy[:, i, j, 0],
                "r^t",
            )
            for i, j in cells
        ),
        tables=by_setting(e, _FIVE, axes, *_AT_ONE),
    )


def c5(e: Evidence) -> Weighed:
    """DQL and dueling DQL similar, and stable after 400 of 1000 episodes, at 1:1, in the episode form."""
    axes = {"r_plus": R_PLUS, "algorithm": ALGORITHMS}
    reward, middle = e.of("reward", _FIVE, **axes), e.of("middle", _FIVE, **axes)
    parts = []
    for i, r_plus in enumerate(R_PLUS):
        text = f"{r_plus}: dueling DQL and DQL are similar"
        parts.append(within(text, reward[:, i], lambda means: means[:, 1] / means[:, 0] - 1))
    for i, r_plus in enumerate(R_PLUS):
        for j, algorithm in enumerate(ALGORITHMS):
            text = f"{name(algorithm)}, {r_plus}: the last fifth is at the level of the third"
            drift = np.stack([middle[:, i, j], reward[:, i, j]], axis=1)
            parts.append(within(text, drift, lambda means: means[:, 1] / means[:, 0] - 1))
    rows = {"algorithm": ALGORITHMS, "r_plus": R_PLUS, "form": FORMS}
    return Weighed(tuple(parts), tables=by_setting(e, _FIVE, rows, *_AT_ONE))


def c6(e: Evidence) -> Weighed:
    """Dueling has the best of the four curves with exponential at 1:1, and converges sooner than DQL."""
    axes = {"algorithm": ALGORITHMS, "form": FORMS}
    reward, settled = e.of("reward", _FIVE, **axes), e.of("convergence", _FIVE, **axes)
    best = interval(reward, lambda means: means[:, 1].max(axis=1) - means[:, 0].max(axis=1))
    sooner = (settled[:, 0] - settled[:, 1]).mean(axis=1)
    return Weighed(
        parts=(
            greater("the best curve of dueling DQL is above the best of DQL", best, "r^t"),
            greater("dueling DQL converges sooner, mean of both forms", sooner, "episodes"),
        ),
        tables=by_setting(e, _FIVE, axes, *_AT_ONE),
    )


def c7(e: Evidence) -> Weighed:
    """Over the ratios with 5 clusters, episode form: dueling above DQL, and where exponential helps."""
    ratios = e.scale.ratios
    axes = {"algorithm": ALGORITHMS, "r_plus": R_PLUS, "ratio": ratios}
    share, common = e.of("reward_share", _FIVE, **axes), e.of("common_share", _FIVE, **axes)
    low = [i for i, ratio in enumerate(ratios) if _at_most_one(ratio)]
    high = [i for i in range(len(ratios)) if i not in low]
    advantage, same = share[:, :, 1] - share[:, :, 0], _second_less_first(common, 2)
    parts = [everywhere("dueling DQL above DQL", _second_less_first(share, 1), ratios, "share")]
    for i, algorithm in enumerate(ALGORITHMS):
        text = f"{name(algorithm)}: exponential above binary up to 1:1"
        parts.append(over_ratios(text, advantage[:, i][:, low], [ratios[k] for k in low], "share"))
    mean = advantage.mean(axis=1)
    less = mean[:, low].mean(axis=1) - mean[:, high].mean(axis=1)
    parts.append(greater("the advantage of exponential is less above 1:1", less, "share"))
    above = [ratios[k] for k in high]
    return Weighed(
        parts=tuple(parts),
        beside=(
            over_ratios(
                "above 1:1, binary above exponential (a stricter reading)", -mean[:, high], above, "share"
            ),
            over_ratios(
                "exponential above binary up to 1:1, both judged with binary",
                same[:, low],
                [ratios[k] for k in low],
                "share",
            ),
            over_ratios("the same above 1:1", same[:, high], above, "share"),
        ),
        tables=numbers(
            e,
            _FIVE,
            {"algorithm": ALGORITHMS, "r_plus": R_PLUS},
            ("ratio", ratios),
            *_REWARDS,
            "landing_rate",
        ),
    )


def c8(e: Evidence) -> Weighed:
    """DQL with 5 clusters: episode best and exponential fastest at 1:1, episode above immediate from 1:1."""
    axes = {"r_plus": R_PLUS, "form": FORMS}
    reward, settled = e.of("reward", _FIVE, **axes), e.of("convergence", _FIVE, **axes)
    best = interval(reward, lambda means: means[:, :, 1].max(axis=1) - means[:, :, 0].max(axis=1))
    fastest = interval(settled, lambda means: means[:, 0].min(axis=1) - means[:, 1].min(axis=1))
    ratios = e.scale.ratios
    share = e.of("reward_share", _FIVE, **axes, ratio=ratios)
    high = [i for i, ratio in enumerate(ratios) if ratio[0] >= ratio[1]]
    by_form = _second_less_first(share, 2)[:, high]
    return Weighed(
        parts=(
            greater("1:1: the best curve of episode is above the best of immediate", best, "r^t"),
            greater("1:1: the fastest curve of exponential is ahead of binary's", fastest, "episodes"),
            over_ratios("episode above immediate from 1:1 on", by_form, [ratios[i] for i in high], "share"),
        ),
        beside=(
            over_ratios(
                "exponential above binary at every ratio (said of this figure in the text)",
                _second_less_first(share, 1),
                ratios,
                "share",
            ),
        ),
        tables=(
            *by_setting(e, _FIVE, axes, *_AT_ONE),
            *numbers(e, _FIVE, axes, ("ratio", ratios), *_REWARDS),
        ),
    )


def c9(e: Evidence) -> Weighed:
    """Dueling DQL with 5 clusters: episode above immediate, over the ratios and both R_plus."""
    setting, ratios = _FIVE.with_(algorithm="dueling_dqn"), e.scale.ratios
    axes = {"r_plus": R_PLUS, "form": FORMS}
    share = e.of("reward_share", setting, **axes, ratio=ratios)
    greedy = e.of("greedy_reward_share", setting, **axes, ratio=ratios)
    return Weighed(
        parts=(over_ratios("episode above immediate", _second_less_first(share, 2), ratios, "share"),),
        beside=(
            over_ratios("the same of greedy missions", _second_less_first(greedy, 2), ratios, "share"),
            over_ratios("exponential above binary", _second_less_first(share, 1), ratios, "share"),
        ),
        tables=numbers(e, setting, axes, ("ratio", ratios), *_REWARDS),
    )


def _second_less_first(values: Array, axis: int) -> Array:
    """Difference along one of two axes before the ratios, mean over the other: `[E, 2, 2, R]` to `[E, R]`."""
    first, second = (values.take(i, axis=axis) for i in (0, 1))
    return (second - first).mean(axis=1)


def _at_most_one(ratio: Ratio) -> bool:
    return ratio[0] <= ratio[1]
