"""The paper's claims on the throughput: C10 to C17."""

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.stats import interval
from uav_dc_ros.experiments.paper.claims_reward import FORMS_ARE_ONE
from uav_dc_ros.experiments.paper.criteria import (
    Assessment,
    Criterion,
    Table,
    all_within,
    claim,
    everywhere,
    fall,
    greater,
    lead,
    over_ratios,
)
from uav_dc_ros.experiments.paper.evidence import Evidence
from uav_dc_ros.experiments.paper.setting import ALGORITHMS, FORMS, R_PLUS, Setting, name

_BETA_WEIGHS_DATA = (
    "Beta weighs the data (eq. 7). Of two agents that each maximise their own return, the one with the "
    "greater beta/zeta cannot collect less (of the discounted data that it maximises): adding up the two "
    "conditions of optimality gives (beta' - beta)(data' - data) >= 0. A throughput that falls with beta is"
    " one of agents that have not learnt what they are paid for."
)
_THROUGHPUT_IS_DATA = (
    "A mission flies all its T_cons steps, so its mean throughput is the data collected in a fixed time: "
    "flying home sooner does not raise it."
)

_THREE, _FIVE = Setting(scenario="three_clusters"), Setting(scenario="five_clusters")
_THREE_BINARY, _FIVE_BINARY = _THREE.with_(r_plus="binary"), _FIVE.with_(r_plus="binary")
_ALL = ("algorithm", "r_plus", "form")
_SHOWN = ("throughput_bps", "greedy_throughput_bps")
_ARRIVAL = ("arrival_step", "greedy_arrival_step", "greedy_landing_rate")
_ONE, _TWO, _HALF = (1, 1), (2, 1), (1, 2)


def _throughput(e: Evidence, setting: Setting, *axes: str, greedy: bool = False) -> Array:
    """In Mbit/s, along `axes` and the ratios, `[E, ..., R]`."""
    return 1e-6 * e.of("greedy_throughput_bps" if greedy else "throughput_bps", setting, *axes, "ratio")


@claim(
    "C10",
    "3 clusters, DQL, binary, episode: throughput",
    "highest at 1:1; falls as beta grows",
    Table(_THREE_BINARY, ("algorithm",), (*_SHOWN, "landing_rate", "arrival_step"), "ratio"),
    notes=(
        _BETA_WEIGHS_DATA,
        "C11 puts the peak of DQL at 1:2 in the same figure. Both can be true only if that peak belongs"
        " to exponential.",
    ),
)
def _c10(e: Evidence) -> Assessment:
    throughput, one = _throughput(e, _THREE_BINARY), e.scale.ratios.index(_ONE)
    return Assessment(
        (
            greater("1:1 above the best of the others", lead(throughput, [one]), "Mbit/s"),
            greater("falls from 1:1 on", fall(throughput[:, one:]), "Mbit/s per ratio"),
        )
    )


@claim(
    "C11",
    "3 clusters: throughput",
    "best of all: dueling, 1:1, binary; above DQL's peak at 1:2",
    Table(_THREE, _ALL, _SHOWN, "ratio"),
    notes=(
        "The episode form. The peak of DQL is looked for in both R_plus: with binary alone, C10 puts it"
        " at 1:1.",
        "C17 finds exponential better than binary with 5 clusters.",
    ),
)
def _c11(e: Evidence) -> Assessment:
    ratios = e.scale.ratios
    throughput = _throughput(e, _THREE, "algorithm", "r_plus")  # [E, 2, 2, R]
    n, half = len(ratios), ratios.index(_HALF)
    options = throughput.reshape(len(throughput), -1)
    favourite = 2 * n + ratios.index(_ONE)
    others = [i for i in range(n) if i != half]
    peak = interval(throughput[:, 0], lambda m: m[:, :, half].max(axis=1) - m[:, :, others].max(axis=(1, 2)))
    above = interval(options, lambda m: m[:, favourite] - m[:, : 2 * n].max(axis=1))
    best = lead(options, [favourite])
    return Assessment(
        (
            greater("dueling DQL, binary, 1:1 above the best of the others", best, "Mbit/s"),
            greater("dueling DQL, binary, 1:1 above the peak of DQL", above, "Mbit/s"),
            greater("DQL has its peak at 1:2", peak, "Mbit/s"),
        )
    )


@claim(
    "C12",
    "5 clusters, DQL, binary, episode: throughput",
    "best at 1:1 and 2:1",
    Table(_FIVE_BINARY, (), (*_SHOWN, "landing_rate"), "ratio"),
    notes=("C14 says stable up to 1:1: then 1:1 cannot stand out from 1:2.", _BETA_WEIGHS_DATA),
)
def _c12(e: Evidence) -> Assessment:
    best = lead(_throughput(e, _FIVE_BINARY), [e.scale.ratios.index(ratio) for ratio in (_ONE, _TWO)])
    return Assessment((greater("both 1:1 and 2:1 above the best of the others", best, "Mbit/s"),))


@claim(
    "C13",
    "5 clusters, DQL, exponential, episode: throughput",
    "little difference between ratios",
    Table(_FIVE, (), (*_SHOWN, "landing_rate"), "ratio"),
    notes=("C14 says that the throughput falls above 1:1, of these settings too.",),
)
def _c13(e: Evidence) -> Assessment:
    throughput = e.of("throughput_bps", _FIVE, "ratio")
    return Assessment((all_within("each ratio is near the mean of all", throughput, e.scale.ratios),))


@claim(
    "C14",
    "5 clusters: throughput",
    "stable for beta/zeta <= 1:1; falls as the ratio rises, while the mission gets shorter",
    Table(_FIVE, _ALL, (*_SHOWN, *_ARRIVAL), "ratio"),
    notes=(
        _BETA_WEIGHS_DATA,
        "By the same argument it is zeta, not beta, that hurries the UAV home: a mission that gets "
        "shorter as beta grows is the wrong way round.",
        _THROUGHPUT_IS_DATA,
        'C13, and the text on C17 ("stable with different beta/zeta values"), say that it does not fall.',
    ),
)
def _c14(e: Evidence) -> Assessment:
    ratios = e.scale.ratios
    one = ratios.index(_ONE)
    throughput_bps, arrival, greedy = (
        e.of(measure, _FIVE, *_ALL, "ratio").mean(axis=(1, 2, 3))
        for measure in ("throughput_bps", *_ARRIVAL[:2])
    )
    throughput = 1e-6 * throughput_bps
    up_to_one = throughput[:, : one + 1]
    return Assessment(
        (
            all_within("up to 1:1, each ratio is near their mean", up_to_one, ratios[: one + 1]),
            greater("the throughput falls from 1:1 on", fall(throughput[:, one:]), "Mbit/s per ratio"),
            greater("the UAV arrives sooner from 1:1 on", fall(arrival[:, one:]), "steps per ratio"),
        ),
        (greater("greedy missions arrive sooner from 1:1 on", fall(greedy[:, one:]), "steps per ratio"),),
    )


@claim(
    "C15",
    "5 clusters: throughput",
    "episode > immediate for every ratio",
    Table(_FIVE, _ALL, _SHOWN, "ratio"),
    notes=(FORMS_ARE_ONE, _THROUGHPUT_IS_DATA),
)
def _c15(e: Evidence) -> Assessment:
    ratios = e.scale.ratios
    throughput, greedy = _throughput(e, _FIVE, *_ALL), _throughput(e, _FIVE, *_ALL, greedy=True)
    gain, greedy_gain = (values[:, :, :, 1] - values[:, :, :, 0] for values in (throughput, greedy))
    mean, greedy_mean = (values.mean(axis=(1, 2)) for values in (gain, greedy_gain))
    alone = (
        everywhere(f"{name(algorithm)}, {r_plus} alone", gain[:, i, j], ratios, "Mbit/s")
        for i, algorithm in enumerate(ALGORITHMS)
        for j, r_plus in enumerate(R_PLUS)
    )
    return Assessment(
        (everywhere("episode above immediate", mean, ratios, "Mbit/s"),),
        (everywhere("the same of greedy missions", greedy_mean, ratios, "Mbit/s"), *alone),
    )


@claim(
    "C16",
    "5 clusters, exponential: throughput",
    "dueling > DQL for almost all ratios, both reward forms",
    Table(_FIVE, ("algorithm", "form"), _SHOWN, "ratio"),
    notes=('"Almost all" is read as all but one.',),
)
def _c16(e: Evidence) -> Assessment:
    ratios = e.scale.ratios

    def criteria(greedy: bool, text: str) -> tuple[Criterion, ...]:
        throughput = _throughput(e, _FIVE, "algorithm", "form", greedy=greedy)
        gain = throughput[:, 1] - throughput[:, 0]  # [E, forms, R]
        return tuple(
            everywhere(f"{form}: dueling DQL above DQL{text}", gain[:, i], ratios, "Mbit/s", exceptions=1)
            for i, form in enumerate(FORMS)
        )

    return Assessment(criteria(False, ""), criteria(True, ", greedy missions"))


@claim(
    "C17",
    "5 clusters, episode: throughput",
    "exponential > binary; best: dueling, exponential, episode",
    Table(_FIVE, _ALL, (*_SHOWN, "landing_rate"), "ratio"),
    notes=(
        "R_plus pays for the trajectory and not for data, so it has no direct way to raise the throughput.",
        "The paper itself adds that other settings are better in some scenarios; C11 is one.",
        "The text also calls the throughput stable over the ratios here, against C12 and C14; it stands"
        " beside.",
    ),
)
def _c17(e: Evidence) -> Assessment:
    ratios = e.scale.ratios
    throughput = _throughput(e, _FIVE, *_ALL)  # [E, 2, 2, 2, R]
    by_r_plus = (throughput[:, :, 1, 1] - throughput[:, :, 0, 1]).mean(axis=1)
    options = throughput.mean(axis=-1).reshape(len(throughput), -1)  # [E, 8], the favourite last
    best = lead(options, [options.shape[1] - 1])
    stable = throughput[:, :, :, 1].mean(axis=(1, 2))
    text = "dueling, exponential, episode above the best of the others, mean over ratios"
    stated = "episode: each ratio is near the mean of all (said in the text)"
    return Assessment(
        (
            over_ratios("exponential above binary", by_r_plus, ratios, "Mbit/s"),
            greater(text, best, "Mbit/s"),
        ),
        (all_within(stated, stable, ratios),),
    )


CLAIMS = (_c10, _c11, _c12, _c13, _c14, _c15, _c16, _c17)
