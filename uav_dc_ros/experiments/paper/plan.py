"""The paper's sweep as data: its figures, and the runs that each of them needs."""

from collections.abc import Iterable
from itertools import product
from typing import Literal, NamedTuple

from uav_dc_ros.errors import TrainingError
from uav_dc_ros.experiments.paper.setting import Planned, Scale, Setting, domain


class Panel(NamedTuple):
    """One part of a figure: `setting`, varied along each of `vary`.

    Attributes:
        kind: `curves` over the episodes, final levels over the `ratios`, a `grid` of final levels over
            the two varied parameters, or the `tracks` of greedy missions.
        title: the setting in words.
        metric: which of `results.METRICS`.
        setting: what all lines share.
        vary: what lines differ in: fields of `Setting`, or `ratio`.
    """

    kind: Literal["curves", "ratios", "grid", "tracks"]
    title: str
    metric: str
    setting: Setting
    vary: tuple[str, ...] = ()

    def lines(self, scale: Scale) -> list[Setting]:
        """A setting for each line; along the ratios, each at the first ratio."""
        domains = [domain(name, scale) for name in self.vary]
        start = self.setting.with_(ratio=scale.ratios[0]) if self.kind == "ratios" else self.setting
        return [start.with_(**dict(zip(self.vary, values, strict=True))) for values in product(*domains)]

    def settings(self, scale: Scale) -> list[Setting]:
        """Every setting that the panel shows."""
        if self.kind != "ratios":
            return self.lines(scale)
        return [line.with_(ratio=ratio) for line in self.lines(scale) for ratio in scale.ratios]


class FigurePlan(NamedTuple):
    """A figure of the paper.

    Attributes:
        label: the paper's label of it.
        caption: the paper's caption.
        claims: which claims it serves.
        panels: its parts. Where the paper leaves a setting open, the title says what was taken.
    """

    label: str
    caption: str
    claims: tuple[str, ...]
    panels: tuple[Panel, ...]


_THREE, _FIVE = Setting(scenario="three_clusters"), Setting()
_DQN, _DUELING = _FIVE, _FIVE.with_(algorithm="dueling_dqn")
_BINARY = {"r_plus": "binary"}
_IMMEDIATE = {"form": "immediate"}
_BOTH = ("algorithm", "r_plus")
_LEARNER_FORM = ("algorithm", "form")
_REWARD_KIND = ("r_plus", "form")

# The paper does not say which form of the reward its figures with 3 clusters use, nor reward5clusters2.
# They are drawn with the episode form, which it finds best; with 3 clusters a further panel has the other.
FIGURES: dict[str, FigurePlan] = {
    "Traj": FigurePlan(
        "fig:Traj",
        "Trajectory obtained by using our DQL algorithm",
        ("C1",),
        (Panel("tracks", "5 clusters, DQL, exponential, episode, 1:1", "users_collected", _DQN),),
    ),
    "reward3clusters": FigurePlan(
        "fig:reward3clusters",
        "The performance when using the DQL and dueling DQL algorithms with 3 clusters while considering "
        "different beta/zeta values",
        ("C2", "C3"),
        (
            Panel("curves", "3 clusters, 2:1, episode", "reward", _THREE.with_(ratio=(2, 1)), _BOTH),
            Panel("ratios", "3 clusters, episode", "reward", _THREE, _BOTH),
            Panel("ratios", "3 clusters, immediate", "reward", _THREE.with_(**_IMMEDIATE), _BOTH),
        ),
    ),
    "reward5clusters": FigurePlan(
        "fig:reward5clusters",
        "The expected reward when using the DQL and dueling DQL algorithms with 5-cluster scenario",
        ("C4", "C5", "C6"),
        (
            Panel("curves", "5 clusters, binary, 1:1", "reward", _FIVE.with_(**_BINARY), _LEARNER_FORM),
            Panel("curves", "5 clusters, exponential, 1:1", "reward", _FIVE, _LEARNER_FORM),
        ),
    ),
    "reward5clusters2": FigurePlan(
        "fig:reward5clusters2",
        "The performance when using the DQL and dueling DQL algorithms with 5 clusters and different "
        "beta/zeta values",
        ("C7",),
        (Panel("ratios", "5 clusters, episode", "reward", _FIVE, _BOTH),),
    ),
    "reward5clusters3": FigurePlan(
        "fig:reward5clusters3",
        "The expected reward when using the DQL algorithm with 5 clusters and different reward function "
        "settings",
        ("C8",),
        (
            Panel("curves", "5 clusters, DQL, 1:1", "reward", _DQN, _REWARD_KIND),
            Panel("ratios", "5 clusters, DQL", "reward", _DQN, _REWARD_KIND),
        ),
    ),
    "reward5clusters4": FigurePlan(
        "fig:reward5clusters4",
        "The performance when using the dueling DQL with 5 clusters, and different beta/zeta values",
        ("C9",),
        (Panel("ratios", "5 clusters, dueling DQL", "reward", _DUELING, _REWARD_KIND),),
    ),
    "throughput3clusters": FigurePlan(
        "fig:throughput3clusters",
        "The network's sum-rate when using the DQL and dueling DQL algorithms with 3 clusters",
        ("C10", "C11"),
        (
            Panel(
                "curves",
                "3 clusters, DQL, binary, episode",
                "throughput_bps",
                _THREE.with_(**_BINARY),
                ("ratio",),
            ),
            Panel("ratios", "3 clusters, episode", "throughput_bps", _THREE, _BOTH),
            Panel("ratios", "3 clusters, immediate", "throughput_bps", _THREE.with_(**_IMMEDIATE), _BOTH),
        ),
    ),
    "throughput5clusters": FigurePlan(
        "fig:throughput5clusters",
        "The obtained total throughput when using the DQL algorithm with 5 clusters",
        ("C12", "C13"),
        (
            Panel(
                "curves",
                "5 clusters, DQL, binary, episode",
                "throughput_bps",
                _DQN.with_(**_BINARY),
                ("ratio",),
            ),
            Panel("curves", "5 clusters, DQL, exponential, episode", "throughput_bps", _DQN, ("ratio",)),
        ),
    ),
    # The caption names both algorithms, the text all reward functions; the panels are this project's reading.
    # The text draws the length of the missions from it too.
    "throughput5clusters2": FigurePlan(
        "fig:throughput5clusters2",
        "The obtained throughput when using the DQL and dueling DQL algorithms in 5-cluster scenario",
        ("C14", "C15"),
        (
            Panel("ratios", "5 clusters, DQL", "throughput_bps", _DQN, _REWARD_KIND),
            Panel("ratios", "5 clusters, dueling DQL", "throughput_bps", _DUELING, _REWARD_KIND),
            Panel("ratios", "5 clusters, DQL", "arrival_step", _DQN, _REWARD_KIND),
            Panel("ratios", "5 clusters, dueling DQL", "arrival_step", _DUELING, _REWARD_KIND),
        ),
    ),
    "throughput5clusters3": FigurePlan(
        "fig:throughput5clusters3",
        "The expected throughput when using the DQL and dueling DQL algorithms with 5 clusters",
        ("C16", "C17"),
        (
            Panel("ratios", "5 clusters, exponential", "throughput_bps", _FIVE, _LEARNER_FORM),
            Panel("ratios", "5 clusters, episode", "throughput_bps", _FIVE, _BOTH),
            # Not in the paper's figure, and in the claim: the best of all settings.
            Panel("ratios", "5 clusters, binary", "throughput_bps", _FIVE.with_(**_BINARY), _LEARNER_FORM),
        ),
    ),
    "exp": FigurePlan(
        "fig:exp",
        "The performance when using the DQL algorithm with different discount factors, gamma, and "
        "exploration factors, epsilon",
        ("C18",),
        (Panel("grid", "5 clusters, DQL, exponential, episode, 1:1", "reward", _DQN, ("gamma", "epsilon")),),
    ),
    "batch": FigurePlan(
        "fig:batch3clusters",
        "The performance when using the DQL algorithm in 5-cluster scenario and different batch sizes, K",
        ("C19",),
        (Panel("curves", "5 clusters, DQL, exponential, episode, 1:1", "reward", _DQN, ("batch_size",)),),
    ),
    "lr": FigurePlan(
        "fig:lr",
        "The performance when using DQL algorithm with different learning rate, lr",
        ("C20",),
        (Panel("curves", "5 clusters, DQL, exponential, episode, 1:1", "reward", _DQN, ("learning_rate",)),),
    ),
}


def runs(scale: Scale, only: Iterable[str] | None = None) -> list[Planned]:
    """The runs that figures need, each once, in an order that is always the same.

    Args:
        scale: how much.
        only: names of figures; None for all.

    Raises:
        TrainingError: there is no such figure.
    """
    names = list(FIGURES) if only is None else list(only)
    if unknown := [name for name in names if name not in FIGURES]:
        raise TrainingError(f"no figure {unknown[0]!r}; expected one of {', '.join(FIGURES)}")
    # In the table's order, whatever the order of `only`; a dict keeps the first of equal settings.
    settings = {
        setting: None
        for name, figure in FIGURES.items()
        if name in names
        for panel in figure.panels
        for setting in panel.settings(scale)
    }
    return [
        Planned(setting, environment, repeat)
        for setting in settings
        for environment in scale.environments
        for repeat in range(scale.repeats)
    ]
