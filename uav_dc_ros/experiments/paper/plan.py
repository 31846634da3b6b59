"""The figures of the paper as data, and the runs that each of them needs."""

from collections.abc import Iterable
from typing import Literal, NamedTuple

from uav_dc_ros.errors import TrainingError
from uav_dc_ros.experiments.paper.setting import PlannedRun, Scale, Setting


class Panel(NamedTuple):
    """One part of a figure."""

    # `curves` over the episodes, final levels over the `ratios`, a `grid` of final levels over the two axes,
    # or the `tracks` of greedy missions.
    kind: Literal["curves", "ratios", "grid", "tracks"]
    title: str  # the setting in words
    metric: str  # one of `results.METRICS`
    setting: Setting  # common to all lines
    vary: tuple[str, ...] = ()  # the axes in which lines differ: fields of `Setting`, or `ratio`

    def lines(self, scale: Scale) -> list[Setting]:
        """A setting for each line."""
        return self.setting.along(self.vary, scale)

    def settings(self, scale: Scale) -> list[Setting]:
        """Every setting that the panel shows."""
        return self.setting.along((*self.vary, "ratio") if self.kind == "ratios" else self.vary, scale)


class FigurePlan(NamedTuple):
    """A figure of the paper. Where the paper leaves a setting open, the panel's title states the choice."""

    caption: str
    claims: tuple[str, ...]
    panels: tuple[Panel, ...]


_THREE, _FIVE = Setting(scenario="three_clusters"), Setting()
_DUELING = _FIVE.with_(algorithm="dueling_dqn")
_THREE_BINARY, _FIVE_BINARY = _THREE.with_(r_plus="binary"), _FIVE.with_(r_plus="binary")
_THREE_IMMEDIATE = _THREE.with_(form="immediate")
_BOTH = ("algorithm", "r_plus")
_LEARNER_FORM = ("algorithm", "form")
_REWARD_KIND = ("r_plus", "form")
_RATIO = ("ratio",)
_RATE = "throughput_bps"


def _figure(caption: str, claims: tuple[str, ...], *panels: Panel) -> FigurePlan:
    return FigurePlan(caption, claims, panels)


# The paper does not state the form of the reward in its figures with 3 clusters, nor in reward5clusters2.
# They are drawn with the episode form, the best in the paper; with 3 clusters a further panel has the other.
FIGURES: dict[str, FigurePlan] = {
    "Traj": _figure(
        "Trajectory obtained by using our DQL algorithm",
        ("C1",),
        Panel("tracks", "5 clusters, DQL, exponential, episode, 1:1", "users_collected", _FIVE),
    ),
    "reward3clusters": _figure(
        "The performance when using the DQL and dueling DQL algorithms with 3 clusters while considering "
        "different beta/zeta values",
        ("C2", "C3"),
        Panel("curves", "3 clusters, 2:1, episode", "reward", _THREE.with_(ratio=(2, 1)), _BOTH),
        Panel("ratios", "3 clusters, episode", "reward", _THREE, _BOTH),
        Panel("ratios", "3 clusters, immediate", "reward", _THREE_IMMEDIATE, _BOTH),
    ),
    "reward5clusters": _figure(
        "The expected reward when using the DQL and dueling DQL algorithms with 5-cluster scenario",
        ("C4", "C5", "C6"),
        Panel("curves", "5 clusters, binary, 1:1", "reward", _FIVE_BINARY, _LEARNER_FORM),
        Panel("curves", "5 clusters, exponential, 1:1", "reward", _FIVE, _LEARNER_FORM),
    ),
    "reward5clusters2": _figure(
        "The performance when using the DQL and dueling DQL algorithms with 5 clusters and different "
        "beta/zeta values",
        ("C7",),
        Panel("ratios", "5 clusters, episode", "reward", _FIVE, _BOTH),
    ),
    "reward5clusters3": _figure(
        "The expected reward when using the DQL algorithm with 5 clusters and different reward function "
        "settings",
        ("C8",),
        Panel("curves", "5 clusters, DQL, 1:1", "reward", _FIVE, _REWARD_KIND),
        Panel("ratios", "5 clusters, DQL", "reward", _FIVE, _REWARD_KIND),
    ),
    "reward5clusters4": _figure(
        "The performance when using the dueling DQL with 5 clusters, and different beta/zeta values",
        ("C9",),
        Panel("ratios", "5 clusters, dueling DQL", "reward", _DUELING, _REWARD_KIND),
    ),
    "throughput3clusters": _figure(
        "The network's sum-rate when using the DQL and dueling DQL algorithms with 3 clusters",
        ("C10", "C11"),
        Panel("curves", "3 clusters, DQL, binary, episode", _RATE, _THREE_BINARY, _RATIO),
        Panel("ratios", "3 clusters, episode", _RATE, _THREE, _BOTH),
        Panel("ratios", "3 clusters, immediate", _RATE, _THREE_IMMEDIATE, _BOTH),
    ),
    "throughput5clusters": _figure(
        "The obtained total throughput when using the DQL algorithm with 5 clusters",
        ("C12", "C13"),
        Panel("curves", "5 clusters, DQL, binary, episode", _RATE, _FIVE_BINARY, _RATIO),
        Panel("curves", "5 clusters, DQL, exponential, episode", _RATE, _FIVE, _RATIO),
    ),
    # The caption names both algorithms, the text all reward functions and the length of the missions; the
    # panels are this project's reading.
    "throughput5clusters2": _figure(
        "The obtained throughput when using the DQL and dueling DQL algorithms in 5-cluster scenario",
        ("C14", "C15"),
        Panel("ratios", "5 clusters, DQL", _RATE, _FIVE, _REWARD_KIND),
        Panel("ratios", "5 clusters, dueling DQL", _RATE, _DUELING, _REWARD_KIND),
        Panel("ratios", "5 clusters, DQL", "arrival_step", _FIVE, _REWARD_KIND),
        Panel("ratios", "5 clusters, dueling DQL", "arrival_step", _DUELING, _REWARD_KIND),
    ),
    "throughput5clusters3": _figure(
        "The expected throughput when using the DQL and dueling DQL algorithms with 5 clusters",
        ("C16", "C17"),
        Panel("ratios", "5 clusters, exponential", _RATE, _FIVE, _LEARNER_FORM),
        Panel("ratios", "5 clusters, episode", _RATE, _FIVE, _BOTH),
        # Not in the paper's figure, but needed for its claim on the best of all settings.
        Panel("ratios", "5 clusters, binary", _RATE, _FIVE_BINARY, _LEARNER_FORM),
    ),
    "exp": _figure(
        "The performance when using the DQL algorithm with different discount factors, gamma, and "
        "exploration factors, epsilon",
        ("C18",),
        Panel("grid", "5 clusters, DQL, exponential, episode, 1:1", "reward", _FIVE, ("gamma", "epsilon")),
    ),
    "batch": _figure(
        "The performance when using the DQL algorithm in 5-cluster scenario and different batch sizes, K",
        ("C19",),
        Panel("curves", "5 clusters, DQL, exponential, episode, 1:1", "reward", _FIVE, ("batch_size",)),
    ),
    "lr": _figure(
        "The performance when using DQL algorithm with different learning rate, lr",
        ("C20",),
        Panel("curves", "5 clusters, DQL, exponential, episode, 1:1", "reward", _FIVE, ("learning_rate",)),
    ),
}


def figure_plan(name: str) -> FigurePlan:
    """The figure with a name; raises TrainingError if there is none."""
    if name not in FIGURES:
        raise TrainingError(f"no figure {name!r}; expected one of {', '.join(FIGURES)}")
    return FIGURES[name]


def runs(scale: Scale, only: Iterable[str] | None = None) -> list[PlannedRun]:
    """The runs that figures need (without `only` all), each once, in a fixed order; or a TrainingError."""
    names = list(FIGURES if only is None else only)
    for name in names:
        figure_plan(name)
    settings = dict.fromkeys(
        setting
        for name, figure in FIGURES.items()
        if name in names
        for panel in figure.panels
        for setting in panel.settings(scale)
    )
    return [
        PlannedRun(setting, environment, repeat)
        for setting in settings
        for environment in scale.environments
        for repeat in range(scale.repeats)
    ]
