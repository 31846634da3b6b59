"""The paper's claims, C1 to C20: what each says, how it is weighed, and what is to be said against it.

The rules are `evidence.RULES`. They were fixed before any result of the sweep was seen. A note owes
nothing to the results: it says where a claim contradicts arithmetic, the paper's text or another claim.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from uav_dc_ros.experiments.paper import claims_learning, claims_reward, claims_throughput
from uav_dc_ros.experiments.paper.evidence import Evidence, NotMeasured, Part, Verdict, Weighed, joint
from uav_dc_ros.experiments.paper.plan import FIGURES
from uav_dc_ros.experiments.paper.results import Results


class Claim(NamedTuple):
    """What the paper says.

    Attributes:
        id: C1 to C20.
        setting: where.
        text: what.
        weigh: from the evidence to what came of it.
        notes: what a reader should know beside the numbers.
    """

    id: str
    setting: str
    text: str
    weigh: Callable[[Evidence], Weighed]
    notes: tuple[str, ...] = ()

    @property
    def figures(self) -> tuple[str, ...]:
        """Names of the figures that show it."""
        return tuple(name for name, figure in FIGURES.items() if self.id in figure.claims)


class Finding(NamedTuple):
    """A claim and what came of it.

    Attributes:
        claim: what the paper says.
        verdict: whether it came true; `not tested` when the results lack runs for it.
        weighed: parts, measures beside them, tables.
    """

    claim: Claim
    verdict: Verdict
    weighed: Weighed

    @property
    def decisive(self) -> Part | None:
        """The part that decides: the first with the verdict of the whole."""
        return next((part for part in self.weighed.parts if part.verdict == self.verdict), None)


_FORMS_ARE_ONE = (
    "Far from the end of a mission both forms set the same goal to Q-learning. The episode form pays the "
    "sum of all immediate rewards so far, so what is earned with n steps still to fly counts "
    "(1 - gamma^n)/(1 - gamma) times as much as in the immediate form: 10 times early on, and less in the "
    "last twenty steps, so that it values a late landing less. Else a difference between them comes from "
    "how they are learnt (targets ten times as large, rewards that depend on a past which the position "
    "does not show), not from what they ask for."
)
_EXPONENTIAL_IS_MORE = (
    "For one and the same flight the exponential R_plus is never below the binary one, so its reward has a "
    "head start by definition. Beside stands the comparison in which both are judged with the binary "
    "R_plus."
)
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

CLAIMS = (
    Claim(
        "C1",
        "5 clusters, DQL trajectory",
        "visits about 40 users and lands",
        claims_reward.c1,
        (
            "The paper does not say with which reward; taken: exponential, episode, 1:1. The table has the "
            "others.",
            "The state is the position alone, so a greedy policy is one fixed path, which can hover only "
            "for good: it cannot wait over a cluster and go on.",
        ),
    ),
    Claim(
        "C2",
        "3 clusters, 2:1",
        "exponential reaches the best reward, and converges faster than binary",
        claims_reward.c2,
        ("The paper does not say which form; taken: episode.", _EXPONENTIAL_IS_MORE),
    ),
    Claim(
        "C3",
        "3 clusters, over beta/zeta",
        "mean reward: dueling > DQL; exponential > binary",
        claims_reward.c3,
        ("The paper does not say which form; taken: episode.", _EXPONENTIAL_IS_MORE),
    ),
    Claim(
        "C4",
        "5 clusters",
        "episode reward > immediate, for both R_plus and both algorithms",
        claims_reward.c4,
        (
            "The ratio is that of the figure, 1:1.",
            _FORMS_ARE_ONE,
            "Of the throughput figures the paper says that a *similar* reward is achieved with different "
            "reward settings: that and C4, C8, C9 cannot both be.",
        ),
    ),
    Claim(
        "C5",
        "5 clusters, 1:1",
        "DQL and dueling similar, stable after about 400 episodes",
        claims_reward.c5,
        (
            "The episode form. Stable: episodes 400 to 600 against the last 200 of 1000, as shares of the "
            "training at another scale.",
            "C6 (dueling best, at the same ratio with exponential) and C7 (dueling better at every ratio, "
            "1:1 among them) say otherwise, unless dueling is better by less than is visible.",
        ),
    ),
    Claim(
        "C6",
        "5 clusters, exponential",
        "dueling best, and converges faster than DQL",
        claims_reward.c6,
        ("Contradicts C5 unless the lead is too small to see.",),
    ),
    Claim(
        "C7",
        "5 clusters, over beta/zeta",
        "dueling > DQL everywhere; exponential > binary while beta/zeta <= 1:1, less effective above",
        claims_reward.c7,
        (
            "The paper does not say which form; taken: episode.",
            "Of the next figure the paper says that exponential is better than binary for *all* ratios (see"
            " C8): read strictly, one of the two is wrong.",
            _EXPONENTIAL_IS_MORE,
            "The head start is zeta/(beta + zeta) of the reward share, so the advantage of exponential "
            "shrinks as the ratio grows by arithmetic alone.",
        ),
    ),
    Claim(
        "C8",
        "5 clusters, DQL",
        "best with episode reward; exponential converges fastest; episode > immediate for beta/zeta >= 1:1",
        claims_reward.c8,
        (
            _FORMS_ARE_ONE,
            "C4 has the same comparison at 1:1, without a condition on the ratio.",
            "The text adds that exponential is better than binary for all ratios, against C7; it stands "
            "beside.",
        ),
    ),
    Claim(
        "C9",
        "5 clusters, dueling",
        "immediate is less effective than episode",
        claims_reward.c9,
        (_FORMS_ARE_ONE,),
    ),
    Claim(
        "C10",
        "3 clusters, DQL, binary, episode: throughput",
        "highest at 1:1; falls as beta grows",
        claims_throughput.c10,
        (
            _BETA_WEIGHS_DATA,
            "C11 puts the peak of DQL at 1:2 in the same figure. Both can be true only if that peak belongs"
            " to exponential.",
        ),
    ),
    Claim(
        "C11",
        "3 clusters: throughput",
        "best of all: dueling, 1:1, binary; above DQL's peak at 1:2",
        claims_throughput.c11,
        (
            "The episode form. The peak of DQL is looked for in both R_plus: with binary alone, C10 puts it"
            " at 1:1.",
            "C17 finds exponential better than binary with 5 clusters.",
        ),
    ),
    Claim(
        "C12",
        "5 clusters, DQL, binary, episode: throughput",
        "best at 1:1 and 2:1",
        claims_throughput.c12,
        (
            "C14 says stable up to 1:1: then 1:1 cannot stand out from 1:2.",
            _BETA_WEIGHS_DATA,
        ),
    ),
    Claim(
        "C13",
        "5 clusters, DQL, exponential, episode: throughput",
        "little difference between ratios",
        claims_throughput.c13,
        ("C14 says that the throughput falls above 1:1, of these settings too.",),
    ),
    Claim(
        "C14",
        "5 clusters: throughput",
        "stable for beta/zeta <= 1:1; falls as the ratio rises, while the mission gets shorter",
        claims_throughput.c14,
        (
            _BETA_WEIGHS_DATA,
            "By the same argument it is zeta, not beta, that hurries the UAV home: a mission that gets "
            "shorter as beta grows is the wrong way round.",
            _THROUGHPUT_IS_DATA,
            'C13, and the text on C17 ("stable with different beta/zeta values"), say that it does not fall.',
        ),
    ),
    Claim(
        "C15",
        "5 clusters: throughput",
        "episode > immediate for every ratio",
        claims_throughput.c15,
        (_FORMS_ARE_ONE, _THROUGHPUT_IS_DATA),
    ),
    Claim(
        "C16",
        "5 clusters, exponential: throughput",
        "dueling > DQL for almost all ratios, both reward forms",
        claims_throughput.c16,
        ('"Almost all" is read as all but one.',),
    ),
    Claim(
        "C17",
        "5 clusters, episode: throughput",
        "exponential > binary; best: dueling, exponential, episode",
        claims_throughput.c17,
        (
            "R_plus pays for the trajectory and not for data, so it has no direct way to raise the "
            "throughput.",
            "The paper itself adds that other settings are better in some scenarios; C11 is one.",
            "The text also calls the throughput stable over the ratios here, against C12 and C14; it stands"
            " beside.",
        ),
    ),
    Claim(
        "C18",
        "5 clusters, DQL",
        "best gamma 0.9 and epsilon 0.9",
        claims_learning.c18,
        (
            "The curves are of missions with exploration, so a greater epsilon looks better whether or not "
            "more was learnt; the greedy missions beside tell the two apart.",
            "What the winners were compared with is not in the paper; the grid is this project's.",
        ),
    ),
    Claim(
        "C19",
        "5 clusters, DQL",
        "batch 32 converges fastest",
        claims_learning.c19,
        (
            "The paper calls the difference slight.",
            "Runs with different batch sizes draw different numbers, so these pairs share the users' start "
            "only.",
        ),
    ),
    Claim(
        "C20",
        "5 clusters, DQL",
        "lr 0.01 fluctuates; 1e-4 and 1e-5 slower or stuck; 1e-3 best",
        claims_learning.c20,
        ('"Slower or stuck" is measured against the level that 1e-3 reaches in the same environment.',),
    ),
)


def check(results: Results) -> list[Finding]:
    """Every claim against the results, in the order of `CLAIMS`."""
    evidence = Evidence(results)
    return [finding(claim, evidence) for claim in CLAIMS]


def count(findings: Sequence[Finding], verdict: Verdict) -> int:
    """How many came out so."""
    return sum(one.verdict == verdict for one in findings)


def finding(claim: Claim, evidence: Evidence) -> Finding:
    """One claim, weighed."""
    try:
        weighed = claim.weigh(evidence)
    except NotMeasured:
        return Finding(claim, "not tested", Weighed(()))
    return Finding(claim, joint([part.verdict for part in weighed.parts]), weighed)
