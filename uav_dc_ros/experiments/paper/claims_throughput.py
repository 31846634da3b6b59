"""The paper's claims on the throughput: C10 to C17."""

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.stats import interval
from uav_dc_ros.experiments.paper.evidence import (
    Evidence,
    Part,
    Weighed,
    all_within,
    everywhere,
    fall,
    greater,
    lead,
    name,
    over_ratios,
)
from uav_dc_ros.experiments.paper.setting import ALGORITHMS, FORMS, R_PLUS, Setting
from uav_dc_ros.experiments.paper.tables import numbers

_THREE, _FIVE = Setting(scenario="three_clusters"), Setting(scenario="five_clusters")
_SHOWN = ("throughput_bps", "greedy_throughput_bps")
_ALL = {"algorithm": ALGORITHMS, "r_plus": R_PLUS, "form": FORMS}
_ONE, _TWO, _HALF = (1, 1), (2, 1), (1, 2)
_MBPS = 1e-6


def c10(e: Evidence) -> Weighed:
    """3 clusters, DQL, binary, episode: highest at 1:1, and falls as beta grows."""
    setting, ratios = _THREE.with_(r_plus="binary"), e.scale.ratios
    throughput = _MBPS * e.of("throughput_bps", setting, ratio=ratios)
    one = ratios.index(_ONE)
    return Weighed(
        parts=(
            greater("1:1 above the best of the others", lead(throughput, [one]), "Mbit/s"),
            greater("falls from 1:1 on", fall(throughput[:, one:]), "Mbit/s per ratio"),
        ),
        tables=numbers(
            e, setting, {"algorithm": ALGORITHMS}, ("ratio", ratios), *_SHOWN, "landing_rate", "arrival_step"
        ),
    )


def c11(e: Evidence) -> Weighed:
    """3 clusters, episode: dueling, binary, 1:1 best of all; the best of DQL is at 1:2."""
    ratios = e.scale.ratios
    axes = {"algorithm": ALGORITHMS, "r_plus": R_PLUS, "ratio": ratios}
    throughput = _MBPS * e.of("throughput_bps", _THREE, **axes)  # [E, 2, 2, R]
    n, one, half = len(ratios), ratios.index(_ONE), ratios.index(_HALF)
    everything = throughput.reshape(len(throughput), -1)
    dueling_binary_one = 2 * n + one
    of_dqn = throughput[:, 0]  # [E, 2, R]
    others = [i for i in range(n) if i != half]
    peak = interval(of_dqn, lambda m: m[:, :, half].max(axis=1) - m[:, :, others].max(axis=(1, 2)))
    above = interval(everything, lambda m: m[:, dueling_binary_one] - m[:, : 2 * n].max(axis=1))
    return Weighed(
        parts=(
            greater(
                "dueling DQL, binary, 1:1 above the best of the others",
                lead(everything, [dueling_binary_one]),
                "Mbit/s",
            ),
            greater("dueling DQL, binary, 1:1 above the peak of DQL", above, "Mbit/s"),
            greater("DQL has its peak at 1:2", peak, "Mbit/s"),
        ),
        tables=numbers(e, _THREE, _ALL, ("ratio", ratios), *_SHOWN),
    )


def c12(e: Evidence) -> Weighed:
    """5 clusters, DQL, binary, episode: best at 1:1 and 2:1."""
    setting, ratios = _FIVE.with_(r_plus="binary"), e.scale.ratios
    throughput = _MBPS * e.of("throughput_bps", setting, ratio=ratios)
    favoured = [ratios.index(_ONE), ratios.index(_TWO)]
    return Weighed(
        parts=(
            greater("both 1:1 and 2:1 above the best of the others", lead(throughput, favoured), "Mbit/s"),
        ),
        tables=numbers(e, setting, {"algorithm": ["dqn"]}, ("ratio", ratios), *_SHOWN, "landing_rate"),
    )


def c13(e: Evidence) -> Weighed:
    """5 clusters, DQL, exponential, episode: little difference between ratios."""
    throughput = e.of("throughput_bps", _FIVE, ratio=e.scale.ratios)
    return Weighed(
        parts=(all_within("each ratio is near the mean of all", throughput, e.scale.ratios),),
        tables=numbers(e, _FIVE, {"algorithm": ["dqn"]}, ("ratio", e.scale.ratios), *_SHOWN, "landing_rate"),
    )


def c14(e: Evidence) -> Weighed:
    """5 clusters, all settings: stable up to 1:1, falls above, while the mission gets shorter."""
    ratios = e.scale.ratios
    one = ratios.index(_ONE)
    throughput = _MBPS * _mean(e.of("throughput_bps", _FIVE, **_ALL, ratio=ratios))
    arrival = _mean(e.of("arrival_step", _FIVE, **_ALL, ratio=ratios))
    greedy = _mean(e.of("greedy_arrival_step", _FIVE, **_ALL, ratio=ratios))
    return Weighed(
        parts=(
            all_within(
                "up to 1:1, each ratio is near their mean", throughput[:, : one + 1], ratios[: one + 1]
            ),
            greater("the throughput falls from 1:1 on", fall(throughput[:, one:]), "Mbit/s per ratio"),
            greater("the UAV arrives sooner from 1:1 on", fall(arrival[:, one:]), "steps per ratio"),
        ),
        beside=(
            greater("greedy missions arrive sooner from 1:1 on", fall(greedy[:, one:]), "steps per ratio"),
        ),
        tables=numbers(
            e,
            _FIVE,
            _ALL,
            ("ratio", ratios),
            *_SHOWN,
            "arrival_step",
            "greedy_arrival_step",
            "greedy_landing_rate",
        ),
    )


def c15(e: Evidence) -> Weighed:
    """5 clusters: episode above immediate at every ratio, mean over algorithms and R_plus."""
    ratios = e.scale.ratios
    throughput = _MBPS * e.of("throughput_bps", _FIVE, **_ALL, ratio=ratios)
    greedy = _MBPS * e.of("greedy_throughput_bps", _FIVE, **_ALL, ratio=ratios)
    by_form, by_form_greedy = (v[:, :, :, 1] - v[:, :, :, 0] for v in (throughput, greedy))
    beside = [everywhere("the same of greedy missions", by_form_greedy.mean(axis=(1, 2)), ratios, "Mbit/s")]
    for i, algorithm in enumerate(ALGORITHMS):
        for j, r_plus in enumerate(R_PLUS):
            text = f"{name(algorithm)}, {r_plus} alone"
            beside.append(everywhere(text, by_form[:, i, j], ratios, "Mbit/s"))
    return Weighed(
        (everywhere("episode above immediate", by_form.mean(axis=(1, 2)), ratios, "Mbit/s"),),
        tuple(beside),
        numbers(e, _FIVE, _ALL, ("ratio", ratios), *_SHOWN),
    )


def c16(e: Evidence) -> Weighed:
    """5 clusters, exponential: dueling above DQL at almost all ratios, in either form."""
    ratios = e.scale.ratios
    axes = {"algorithm": ALGORITHMS, "form": FORMS}

    def parts(measure: str, what: str) -> tuple[Part, ...]:
        throughput = _MBPS * e.of(measure, _FIVE, **axes, ratio=ratios)
        gain = throughput[:, 1] - throughput[:, 0]  # [E, forms, R]
        return tuple(
            everywhere(f"{form}: dueling DQL above DQL{what}", gain[:, i], ratios, "Mbit/s", exceptions=1)
            for i, form in enumerate(FORMS)
        )

    return Weighed(
        parts("throughput_bps", ""),
        parts("greedy_throughput_bps", ", greedy missions"),
        numbers(e, _FIVE, axes, ("ratio", ratios), *_SHOWN),
    )


def c17(e: Evidence) -> Weighed:
    """5 clusters: exponential above binary in the episode form; dueling, exponential, episode best of all."""
    ratios = e.scale.ratios
    throughput = _MBPS * e.of("throughput_bps", _FIVE, **_ALL, ratio=ratios)  # [E, 2, 2, 2, R]
    by_r_plus = (throughput[:, :, 1, 1] - throughput[:, :, 0, 1]).mean(axis=1)
    options = throughput.mean(axis=-1).reshape(len(throughput), -1)  # [E, 8], the favourite last
    stable = throughput[:, :, :, 1].mean(axis=(1, 2))
    return Weighed(
        parts=(
            over_ratios("exponential above binary", by_r_plus, ratios, "Mbit/s"),
            greater(
                "dueling, exponential, episode above the best of the others, mean over ratios",
                lead(options, [options.shape[1] - 1]),
                "Mbit/s",
            ),
        ),
        beside=(
            all_within("episode: each ratio is near the mean of all (said in the text)", stable, ratios),
        ),
        tables=numbers(e, _FIVE, _ALL, ("ratio", ratios), *_SHOWN, "landing_rate"),
    )


def _mean(values: Array) -> Array:
    """Mean over algorithms, R_plus and forms, `[E, 2, 2, 2, R]` to `[E, R]`."""
    return values.mean(axis=(1, 2, 3))
