"""The paper's claims on the throughput: C10 to C17."""

from collections.abc import Iterator

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.stats import interval
from uav_dc_ros.experiments.paper.claims.criteria import (
    ClaimTable,
    Criterion,
    all_within,
    beside,
    claim,
    everywhere,
    fall,
    greater,
    lead,
    over_ratios,
)
from uav_dc_ros.experiments.paper.claims.reward import FORMS_ARE_ONE
from uav_dc_ros.experiments.paper.evidence import Evidence
from uav_dc_ros.experiments.paper.setting import ALGORITHMS, FORMS, R_PLUS, Setting, name

_BETA_WEIGHS_DATA = (
    "Beta weighs the data (eq. 7). Of two agents that each maximise their own return, the one with the "
    "greater beta/zeta cannot collect less (of the discounted data that it maximises): adding up the two "
    "conditions of optimality gives (beta' - beta)(data' - data) >= 0. A throughput that falls with beta is "
    "one of agents that have not learnt to maximise their return."
)
_THROUGHPUT_IS_DATA = (
    "A mission flies all its T_cons steps, so its mean throughput is the data collected in a fixed time: "
    "flying home sooner does not raise it."
)

_THREE, _FIVE = Setting(scenario="three_clusters"), Setting(scenario="five_clusters")
_THREE_BINARY, _FIVE_BINARY = _THREE.with_(r_plus="binary"), _FIVE.with_(r_plus="binary")
_ALL = ("algorithm", "r_plus", "form")
_SHOWN = ("throughput_bps", "greedy_throughput_bps")
_ARRIVAL = ("arrival_step", "greedy_arrival_step")
_ONE, _TWO, _HALF = (1, 1), (2, 1), (1, 2)


def _throughput(e: Evidence, setting: Setting, *axes: str, greedy: bool = False) -> Array:
    """In Mbit/s, along `axes` and the ratios, `[E, ..., R]`."""
    return 1e-6 * e.of(_SHOWN[greedy], setting, *axes, "ratio")


@claim(
    "C10",
    "3 clusters, DQL, binary, episode: throughput",
    "highest at 1:1; falls as beta grows",
    _BETA_WEIGHS_DATA,
    "C11 puts the peak of DQL at 1:2 in the same figure. Both can be true only if that peak belongs to "
    "exponential.",
    tables=[ClaimTable(_THREE_BINARY, ("algorithm",), (*_SHOWN, "landing_rate", "arrival_step"), "ratio")],
)
def _c10(e: Evidence) -> Iterator[Criterion]:
    throughput, one = _throughput(e, _THREE_BINARY), e.scale.ratios.index(_ONE)
    yield greater("1:1 above the best of the others", lead(throughput, [one]), "Mbit/s")
    yield greater("falls from 1:1 on", fall(throughput[:, one:]), "Mbit/s per ratio")


@claim(
    "C11",
    "3 clusters: throughput",
    "best of all: dueling, 1:1, binary; above DQL's peak at 1:2",
    "The episode form. The peak of DQL is looked for in both R_plus: with binary alone, C10 puts it at 1:1.",
    "C17 finds exponential better than binary with 5 clusters.",
    tables=[ClaimTable(_THREE, _ALL, _SHOWN, "ratio")],
)
def _c11(e: Evidence) -> Iterator[Criterion]:
    ratios = e.scale.ratios
    throughput = _throughput(e, _THREE, "algorithm", "r_plus")  # [E, 2, 2, R]
    n, half = len(ratios), ratios.index(_HALF)
    options = throughput.reshape(len(throughput), -1)
    favourite = 2 * n + ratios.index(_ONE)
    best = lead(options, [favourite])
    yield greater("dueling DQL, binary, 1:1 above the best of the others", best, "Mbit/s")
    above = interval(options, lambda m: m[:, favourite] - m[:, : 2 * n].max(axis=1))
    yield greater("dueling DQL, binary, 1:1 above the peak of DQL", above, "Mbit/s")
    others = [i for i in range(n) if i != half]
    peak = interval(throughput[:, 0], lambda m: m[:, :, half].max(axis=1) - m[:, :, others].max(axis=(1, 2)))
    yield greater("DQL has its peak at 1:2", peak, "Mbit/s")


@claim(
    "C12",
    "5 clusters, DQL, binary, episode: throughput",
    "best at 1:1 and 2:1",
    "C14 claims stable up to 1:1: then 1:1 cannot stand out from 1:2.",
    _BETA_WEIGHS_DATA,
    tables=[ClaimTable(_FIVE_BINARY, (), (*_SHOWN, "landing_rate"), "ratio")],
)
def _c12(e: Evidence) -> Iterator[Criterion]:
    best = lead(_throughput(e, _FIVE_BINARY), [e.scale.ratios.index(ratio) for ratio in (_ONE, _TWO)])
    yield greater("both 1:1 and 2:1 above the best of the others", best, "Mbit/s")


@claim(
    "C13",
    "5 clusters, DQL, exponential, episode: throughput",
    "little difference between ratios",
    "C14 claims that the throughput falls above 1:1, of these settings too.",
    tables=[ClaimTable(_FIVE, (), (*_SHOWN, "landing_rate"), "ratio")],
)
def _c13(e: Evidence) -> Iterator[Criterion]:
    throughput = e.of("throughput_bps", _FIVE, "ratio")
    yield all_within("each ratio is near the mean of all", throughput, e.scale.ratios)


@claim(
    "C14",
    "5 clusters: throughput",
    "stable for beta/zeta <= 1:1; falls as the ratio rises, while the mission gets shorter",
    _BETA_WEIGHS_DATA,
    "By the same argument it is zeta, not beta, that hurries the UAV home: a mission that gets shorter as "
    "beta grows is the wrong way round.",
    _THROUGHPUT_IS_DATA,
    'C13, and the text on C17 ("stable with different beta/zeta values"), claim that it does not fall.',
    tables=[ClaimTable(_FIVE, _ALL, (*_SHOWN, *_ARRIVAL, "greedy_landing_rate"), "ratio")],
)
def _c14(e: Evidence) -> Iterator[Criterion]:
    ratios = e.scale.ratios
    one = ratios.index(_ONE)
    throughput_bps, arrival, greedy_arrival = (
        e.of(measure, _FIVE, *_ALL, "ratio").mean(axis=(1, 2, 3)) for measure in (_SHOWN[0], *_ARRIVAL)
    )
    throughput = 1e-6 * throughput_bps
    text = "up to 1:1, each ratio is near their mean"
    yield all_within(text, throughput[:, : one + 1], ratios[: one + 1])
    yield greater("the throughput falls from 1:1 on", fall(throughput[:, one:]), "Mbit/s per ratio")
    yield greater("the UAV arrives sooner from 1:1 on", fall(arrival[:, one:]), "steps per ratio")
    text = "greedy missions arrive sooner from 1:1 on"
    yield beside(greater(text, fall(greedy_arrival[:, one:]), "steps per ratio"))


@claim(
    "C15",
    "5 clusters: throughput",
    "episode > immediate for every ratio",
    FORMS_ARE_ONE,
    _THROUGHPUT_IS_DATA,
    tables=[ClaimTable(_FIVE, _ALL, _SHOWN, "ratio")],
)
def _c15(e: Evidence) -> Iterator[Criterion]:
    ratios = e.scale.ratios
    throughput, greedy = _throughput(e, _FIVE, *_ALL), _throughput(e, _FIVE, *_ALL, greedy=True)
    gain, greedy_gain = (values[:, :, :, 1] - values[:, :, :, 0] for values in (throughput, greedy))
    yield everywhere("episode above immediate", gain.mean(axis=(1, 2)), ratios, "Mbit/s")
    text = "the same of greedy missions"
    yield beside(everywhere(text, greedy_gain.mean(axis=(1, 2)), ratios, "Mbit/s"))
    for i, algorithm in enumerate(map(name, ALGORITHMS)):
        for j, r_plus in enumerate(R_PLUS):
            yield beside(everywhere(f"{algorithm}, {r_plus} alone", gain[:, i, j], ratios, "Mbit/s"))


@claim(
    "C16",
    "5 clusters, exponential: throughput",
    "dueling > DQL for almost all ratios, both reward forms",
    '"Almost all" is read as all but one.',
    tables=[ClaimTable(_FIVE, ("algorithm", "form"), _SHOWN, "ratio")],
)
def _c16(e: Evidence) -> Iterator[Criterion]:
    def criterion(form: str, text: str, greedy: bool) -> Criterion:
        throughput = _throughput(e, _FIVE, "algorithm", "form", greedy=greedy)  # [E, 2, 2, R]
        gain = (throughput[:, 1] - throughput[:, 0])[:, FORMS.index(form)]
        return everywhere(f"{form}: {text}", gain, e.scale.ratios, "Mbit/s", exceptions=1)

    for form in FORMS:
        yield criterion(form, "dueling DQL above DQL", greedy=False)
        yield beside(criterion(form, "dueling DQL above DQL, greedy missions", greedy=True))


@claim(
    "C17",
    "5 clusters, episode: throughput",
    "exponential > binary; best: dueling, exponential, episode",
    "R_plus rewards the trajectory and not the data, so it has no direct way to raise the throughput.",
    "The paper itself adds that other settings are better in some scenarios; C11 is one.",
    "The text also calls the throughput stable over the ratios here, against C12 and C14; it stands beside.",
    tables=[ClaimTable(_FIVE, _ALL, (*_SHOWN, "landing_rate"), "ratio")],
)
def _c17(e: Evidence) -> Iterator[Criterion]:
    ratios = e.scale.ratios
    throughput = _throughput(e, _FIVE, *_ALL)  # [E, 2, 2, 2, R]
    by_r_plus = (throughput[:, :, 1, 1] - throughput[:, :, 0, 1]).mean(axis=1)
    yield over_ratios("exponential above binary", by_r_plus, ratios, "Mbit/s")
    options = throughput.mean(axis=-1).reshape(len(throughput), -1)  # [E, 8], the favourite last
    best = lead(options, [options.shape[1] - 1])
    text = "dueling, exponential, episode above the best of the others, mean over ratios"
    yield greater(text, best, "Mbit/s")
    text = "episode: each ratio is near the mean of all (stated in the text)"
    yield beside(all_within(text, throughput[:, :, :, 1].mean(axis=(1, 2)), ratios))


CLAIMS = (_c10, _c11, _c12, _c13, _c14, _c15, _c16, _c17)
