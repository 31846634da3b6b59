"""The paper's figures, drawn from the results in colours that are distinct for colour-blind readers."""

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap, to_rgb
from matplotlib.figure import Figure

from uav_dc_ros import files
from uav_dc_ros.core.reward import MISSION_REWARD
from uav_dc_ros.core.stats import band, interval
from uav_dc_ros.env.render import FAINT, INK, PAPER, PATH_COLOURS, picture
from uav_dc_ros.env.trajectory import Trajectory
from uav_dc_ros.errors import TrainingError
from uav_dc_ros.experiments.paper.evidence import SMOOTHING, Evidence, smooth
from uav_dc_ros.experiments.paper.plan import FIGURES, FigurePlan, Panel, figure_plan
from uav_dc_ros.experiments.paper.results import Results
from uav_dc_ros.experiments.paper.setting import Scale, Setting, domain, name

_DPI, _PICTURE_DPI = 150, 100  # of a figure, and of pictures of missions, which are not scaled
# Sizes in inches: of a panel, and of its margins.
_WIDE, _HIGH, _LEFT, _RIGHT, _BELOW, _ABOVE = 5.3, 3.3, 0.75, 0.25, 0.6, 0.8
# Metric: title of the axis, divisor. The words of `MISSION_REWARD` replace r^t.
_AXES = {
    "reward": ("reward r^t of a mission", 1.0),
    "reward_share": (r"reward r^t $/\,(\beta + \zeta)$", 1.0),
    "throughput_bps": ("throughput, Mbit/s", 1e6),
    "arrival_step": ("arrival step ($T_{cons}$ if not landed)", 1.0),
}
_MUTED, _WARNING = "#66707c", "#b3261e"
# With two axes, the first sets the colour, the second the dashes and the marker.
_FIRST = ("#1f5fa8", "#d1601f")
_SECOND: tuple[dict[str, Any], ...] = (
    {"ls": (0, (4, 2)), "marker": "o", "markerfacecolor": PAPER},
    {"ls": "-", "marker": "s"},
)
# From more weight on the trajectory, by the balance in ink, to more weight on the data.
_RATIOS = LinearSegmentedColormap.from_list("ratios", ["#79bce6", "#2b78bd", INK, "#cc5a1b", "#f0ad45"])
_VALUES = matplotlib.colormaps["viridis"]
_SYMBOLS = {"batch_size": "K", "learning_rate": "lr"}


def drawable(results: Results) -> list[str]:
    """Names of the figures for which the results have every run."""
    measured = {run.setting for run in results.planned}
    scale = results.metadata.scale
    return [
        figure
        for figure, plan in FIGURES.items()
        if all(measured.issuperset(panel.settings(scale)) for panel in plan.panels)
    ]


def draw(figure: str, results: Results, tracks: Sequence[Trajectory], path: Path) -> None:
    """Writes a figure as PNG, `Traj` with greedy missions; raises TrainingError where it cannot."""
    plan = figure_plan(figure)
    dpi = _DPI
    if plan.panels[0].kind == "tracks":
        dpi = _PICTURE_DPI
        drawn = _montage(plan, results.metadata.scale, tracks)
    elif figure not in drawable(results):
        raise TrainingError(f"figure {figure}: the results lack some of its runs")
    else:
        drawn = _panels(plan, results)
    try:
        with files.replacing(path) as partial:
            FigureCanvasAgg(drawn).figure.savefig(partial, dpi=dpi, format="png")
    except OSError as error:
        raise TrainingError(f"{path} cannot be written: {error.strerror or error}") from None


def _panels(plan: FigurePlan, results: Results) -> Figure:
    """Panels two in a row, each with its title and legend above it; the first of an odd number is wide."""
    evidence, scale = Evidence(results), results.metadata.scale
    n_panels = len(plan.panels)
    n_columns = min(n_panels, 2)
    n_rows = -(-n_panels // n_columns)
    column_wide, row_high = _LEFT + _WIDE + _RIGHT, _ABOVE + _HIGH + _BELOW
    wide, header = n_columns * column_wide, _header_high(plan.caption, n_columns * column_wide)
    high = header + n_rows * row_high
    figure = Figure(figsize=(wide, high), facecolor=PAPER)
    _header(figure, plan.caption, _facts(plan, scale), scale)
    shared: dict[tuple[str, str], Axes] = {}
    for i, panel in enumerate(plan.panels):
        spans = n_columns if i == 0 and n_panels % n_columns else 1
        row, column = divmod(i + n_panels % n_columns if i else 0, n_columns)
        x, y = column * column_wide + _LEFT, high - header - (row + 1) * row_high + _BELOW
        size = (_WIDE + (spans - 1) * column_wide, _HIGH)
        # Panels of one kind and metric share the axis, so that they can be compared.
        twin = shared.get((panel.kind, panel.metric))
        axes = figure.add_axes((x / wide, y / high, size[0] / wide, size[1] / high), sharey=twin)
        shared.setdefault((panel.kind, panel.metric), axes)
        _DRAW[panel.kind](axes, panel, evidence)
        letter = f"({'abcd'[i]}) " if n_panels > 1 else ""
        above = _HIGH + (0.6 if len(panel.vary) == 2 and panel.kind != "grid" else 0.42)
        title = f"{letter}{panel.title}"
        figure.text(x / wide, (y + above) / high, title, color=INK, size=10.5, weight="bold", va="center")
    return figure


def _axis(metric: str, panel: Panel, evidence: Evidence) -> tuple[str, float]:
    """Title and divisor of a metric's axis."""
    title, unit = _AXES[metric]
    data = evidence.results.metadata.worlds[panel.setting.scenario].reward_data
    return title.replace("r^t", MISSION_REWARD[data].replace("r^t", "$r^t$")), unit


def _curves(axes: Axes, panel: Panel, evidence: Evidence) -> None:
    """Mean over environments of smoothed curves, with its interval as a band."""
    episode = evidence.results.episode
    title, unit = _axis(panel.metric, panel, evidence)
    lines = panel.lines(evidence.scale)
    for line, look in zip(lines, _looks(lines, panel.vary), strict=True):
        mean, low, high = band(smooth(evidence.curves(panel.metric, line)) / unit)
        axes.plot(episode, mean, **look | {"marker": ""})
        axes.fill_between(episode, low, high, color=look["color"], alpha=0.13, lw=0)
    axes.set_xlim(0, episode[-1])
    _finish(axes, panel, len(lines), "episode", title)


def _ratios(axes: Axes, panel: Panel, evidence: Evidence) -> None:
    """Performance over the ratios, mean over environments with its interval as a bar."""
    metric = "reward_share" if panel.metric == "reward" else panel.metric
    title, unit = _axis(metric, panel, evidence)
    ratios, lines = evidence.scale.ratios, panel.lines(evidence.scale)
    for i, (line, look) in enumerate(zip(lines, _looks(lines, panel.vary), strict=True)):
        mean, low, high = band(evidence.of(metric, line, "ratio") / unit)
        # Side by side, so that no bar hides another.
        x = np.arange(len(ratios)) + 0.09 * (i - (len(lines) - 1) / 2)
        bars = np.stack([mean - low, high - mean])
        axes.errorbar(x, mean, yerr=bars, ms=4.5, elinewidth=1.0, **look | {"lw": 1.3})
    axes.set_xticks(range(len(ratios)), [name(ratio) for ratio in ratios])
    _finish(axes, panel, len(lines), r"$\beta : \zeta$", title)


def _grid(axes: Axes, panel: Panel, evidence: Evidence) -> None:
    """Performance over gamma and epsilon, as a map; the paper's choice has a frame."""
    title, unit = _axis(panel.metric, panel, evidence)
    gammas, epsilons = (domain(axis, evidence.scale) for axis in panel.vary)
    measured = evidence.of(panel.metric, panel.setting, *panel.vary) / unit
    image = axes.imshow(measured.mean(axis=0), cmap=PATH_COLOURS, aspect="auto", origin="lower")
    for i, gamma in enumerate(gammas):
        for j, epsilon in enumerate(epsilons):
            mean, low, high = interval(measured[:, i, j])
            colour = _readable_on(image.to_rgba(np.array([mean]))[0])
            axes.text(j, i + 0.1, f"{mean:.3f}", color=colour, size=11, ha="center", va="center")
            axes.text(j, i - 0.2, f"{low:.3f} to {high:.3f}", color=colour, size=7, ha="center", va="center")
            if (gamma, epsilon) == Setting().values(panel.vary):
                x, y = np.array([-1, 1, 1, -1, -1]) * 0.46 + j, np.array([-1, -1, 1, 1, -1]) * 0.46 + i
                axes.plot(x, y, color=PAPER, lw=2.2)
    axes.set_xticks(range(len(epsilons)), [name(epsilon) for epsilon in epsilons])
    axes.set_yticks(range(len(gammas)), [name(gamma) for gamma in gammas])
    axes.set_xlabel(r"$\epsilon$, probability of the greedy action", color=INK, size=9)
    axes.set_ylabel(r"$\gamma$, discount", color=INK, size=9)
    _dress(axes)
    axes.grid(False)
    text = f"{title}; the paper's choice is framed"
    axes.text(0, 1.03, text, transform=axes.transAxes, color=_MUTED, size=8.5)


_DRAW = {"curves": _curves, "ratios": _ratios, "grid": _grid}


def _looks(lines: Sequence[Setting], vary: tuple[str, ...]) -> list[dict[str, Any]]:
    """Label, colour, width and marker of each line of a panel; the paper's value is emphasised."""
    values = [line.values(vary) for line in lines]
    looks = []
    for i, value in enumerate(values):
        words = (
            f"{_SYMBOLS[axis]} = {name(one)}" if axis in _SYMBOLS else name(one)
            for axis, one in zip(vary, value, strict=True)
        )
        look: dict[str, Any] = {"label": ", ".join(words), "lw": 1.8, "zorder": 4}
        if len(vary) == 2:
            first, second = (list(dict.fromkeys(column)) for column in zip(*values, strict=True))
            look |= {"color": _FIRST[first.index(value[0])]} | _SECOND[second.index(value[1])]
        else:
            where = i / max(len(values) - 1, 1)
            look["color"] = _RATIOS(where) if vary == ("ratio",) else _VALUES(0.82 * where)
            look |= {"lw": 2.6, "zorder": 5} if value == Setting().values(vary) else {"lw": 1.5}
        looks.append(look)
    return looks


def _readable_on(colour: Any) -> str:
    """The colour of text on a colour: ink or paper."""
    red, green, blue = to_rgb(colour)
    return INK if 0.3 * red + 0.59 * green + 0.11 * blue > 0.5 else PAPER


def _finish(axes: Axes, panel: Panel, n_lines: int, x_title: str, y_title: str) -> None:
    """Titles of the axes, and the legend above them, where it hides nothing."""
    axes.margins(y=0.06)
    axes.set_xlabel(x_title, color=INK, size=9)
    axes.set_ylabel(y_title, color=INK, size=9)
    two_axes = len(panel.vary) == 2
    axes.legend(
        loc="lower left",
        bbox_to_anchor=(-0.01, 1.0),
        borderaxespad=0.1,
        ncols=2 if two_axes else n_lines,
        frameon=False,
        fontsize=8.5,
        labelcolor=INK,
        handlelength=2.6 if two_axes else 1.2,
        columnspacing=1.2,
        handletextpad=0.5,
        labelspacing=0.3,
    )
    _dress(axes)


def _dress(axes: Axes) -> None:
    """A faint grid, two spines."""
    axes.set_facecolor("none")
    axes.tick_params(colors=INK, labelsize=8.5, length=0)
    axes.grid(color=FAINT, lw=0.6, alpha=0.7)
    axes.set_axisbelow(True)
    for side, spine in axes.spines.items():
        spine.set_color(FAINT)
        spine.set_visible(side in ("left", "bottom"))


def _montage(plan: FigurePlan, scale: Scale, tracks: Sequence[Trajectory]) -> Figure:
    """The pictures of missions, three in a row."""
    if not tracks:
        raise TrainingError("0 missions to draw; expected at least 1")
    pictures = [picture(track) for track in tracks]
    n_columns = min(len(pictures), 3)
    n_rows = -(-len(pictures) // n_columns)
    one_high, one_wide = (size / _PICTURE_DPI for size in pictures[0].shape[:2])
    wide = n_columns * one_wide
    header = _header_high(plan.caption, wide)
    high = header + n_rows * (one_high + 0.3)
    figure = Figure(figsize=(wide, high), facecolor=PAPER)
    facts = f"{plan.panels[0].title}; greedy missions after training, one in each environment"
    _header(figure, plan.caption, facts, scale)
    for i, image in enumerate(pictures):
        row, column = divmod(i, n_columns)
        y = high - header - (row + 1) * (one_high + 0.3)
        axes = figure.add_axes((column / n_columns, y / high, 1 / n_columns, one_high / high))
        axes.imshow(image, interpolation="lanczos")
        axes.axis("off")
        where = ((column + 0.1) / n_columns, (y + one_high + 0.05) / high)
        figure.text(*where, f"environment {scale.environments[i]}", color=_MUTED, size=11)
    return figure


def _header(figure: Figure, title: str, facts: str, scale: Scale) -> None:
    """Title, facts, and the warning of a smoke test."""
    wide, high = figure.get_size_inches()
    x, y = 0.25 / wide, 1 - 0.18 / high
    text = "\n".join(_lines(title, wide))
    figure.text(x, y, text, color=INK, size=12, weight="bold", va="top", linespacing=1.15)
    y = 1 - (_header_high(title, wide) - 0.15) / high
    smoke = scale.name == "smoke"
    facts = "smoke test: these numbers mean nothing" if smoke else facts
    colour, weight = (_WARNING, "bold") if smoke else (_MUTED, "normal")
    figure.text(x, y, facts, color=colour, size=8.5, weight=weight, va="center")


def _header_high(title: str, wide: float) -> float:
    """Height of the title and the line below it in a figure of some width, all in inches."""
    return 0.45 + 0.22 * len(_lines(title, wide))


def _lines(title: str, wide: float) -> list[str]:
    # A bold letter of this size is about a tenth of an inch wide.
    return textwrap.wrap(title.replace("beta/zeta", "β/ζ"), int((wide - 0.5) / 0.105))


def _facts(plan: FigurePlan, scale: Scale) -> str:
    """The meaning of the marks."""
    runs = f"{scale.repeats} runs" if scale.repeats > 1 else "1 run"
    marks = f"{len(scale.environments)} environments × {runs}: mean, 95% studentised bootstrap interval"  # noqa: RUF001
    if any(panel.kind == "curves" for panel in plan.panels):
        marks += f"; curves: moving average over {SMOOTHING * scale.episodes_per_point} episodes"
    if any(panel.kind != "curves" for panel in plan.panels):
        marks += "; levels: last fifth of the training"
    return marks
