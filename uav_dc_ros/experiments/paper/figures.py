"""The paper's figures, drawn from the results."""

import textwrap
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from uav_dc_ros import files
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.stats import interval
from uav_dc_ros.env.render import PATH_COLOURS, picture
from uav_dc_ros.env.trajectory import Trajectory
from uav_dc_ros.errors import TrainingError
from uav_dc_ros.experiments.paper import style
from uav_dc_ros.experiments.paper.evidence import SMOOTHING, Evidence, name, smooth
from uav_dc_ros.experiments.paper.plan import FIGURES, FigurePlan, Panel
from uav_dc_ros.experiments.paper.results import Results
from uav_dc_ros.experiments.paper.setting import Scale, Setting

# Dots per inch: of a figure, and of the pictures of missions as they come.
_DPI, _PICTURE_DPI = 150, 100
# Sizes in inches: a panel, and what surrounds it.
_WIDE, _HIGH, _LEFT, _RIGHT, _BELOW, _ABOVE = 5.3, 3.3, 0.75, 0.25, 0.6, 0.8
# Metric: title of the axis, what to divide by.
_AXES = {
    "reward": ("reward $r^t$ at the end of a mission", 1.0),
    "reward_share": (r"reward $r^t\,/\,(\beta + \zeta)$", 1.0),
    "throughput_bps": ("throughput, Mbit/s", 1e6),
    "arrival_step": ("arrival step ($T_{cons}$ if not landed)", 1.0),
}


def drawable(results: Results) -> list[str]:
    """Names of the figures for which the results have every run."""
    there = {run.setting for run in results.planned}
    return [
        figure
        for figure, plan in FIGURES.items()
        if all(
            setting in there for panel in plan.panels for setting in panel.settings(results.metadata.scale)
        )
    ]


def draw(figure: str, results: Results, tracks: Sequence[Trajectory], path: Path) -> None:
    """Writes one figure as a PNG file.

    Args:
        figure: a name in `FIGURES`.
        results: what was measured.
        tracks: a greedy mission in each environment; for the figure `Traj` only.
        path: where to.

    Raises:
        TrainingError: no such figure, runs or missions that it lacks, or a file that cannot be written.
    """
    if figure not in FIGURES:
        raise TrainingError(f"no figure {figure!r}; expected one of {', '.join(FIGURES)}")
    plan = FIGURES[figure]
    dpi = _DPI
    if plan.panels[0].kind == "tracks":
        dpi = _PICTURE_DPI  # its dots as they are
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
    drawn = Figure(figsize=(wide, high), facecolor=style.PAPER)
    _header(drawn, plan.caption, _facts(plan, scale), scale)
    shared: dict[tuple[str, str], Axes] = {}
    for i, panel in enumerate(plan.panels):
        spans = n_columns if i == 0 and n_panels % n_columns else 1
        row, column = divmod(i + n_panels % n_columns if i else 0, n_columns)
        x, y = column * column_wide + _LEFT, high - header - (row + 1) * row_high + _BELOW
        size = (_WIDE + (spans - 1) * column_wide, _HIGH)
        # What has one measure has one axis, so that two panels can be compared.
        twin = shared.get((panel.kind, panel.metric))
        axes = drawn.add_axes((x / wide, y / high, size[0] / wide, size[1] / high), sharey=twin)
        shared.setdefault((panel.kind, panel.metric), axes)
        _DRAW[panel.kind](axes, panel, evidence)
        letter = f"({'abcd'[i]}) " if n_panels > 1 else ""
        above = _HIGH + (0.6 if len(panel.vary) == 2 and panel.kind != "grid" else 0.42)
        where = (x / wide, (y + above) / high)
        title = f"{letter}{panel.title}"
        drawn.text(*where, title, color=style.INK, size=10.5, weight="bold", va="center")
    return drawn


def _curves(axes: Axes, panel: Panel, evidence: Evidence) -> None:
    """Mean over environments of smoothed curves, with its interval as a band."""
    results = evidence.results
    title, unit = _AXES[panel.metric]
    lines = panel.lines(evidence.scale)
    values = [tuple(getattr(line, key) for key in panel.vary) for line in lines]
    for line in lines:
        curves = smooth(evidence.curves(panel.metric, line)) / unit  # [E, P]
        mean, low, high = _bands(curves)
        properties = style.look(line, panel.vary, values) | {"marker": ""}
        axes.plot(results.episode, mean, label=style.label(line, panel.vary), **properties)
        axes.fill_between(results.episode, low, high, color=properties["color"], alpha=0.13, lw=0)
    axes.set_xlim(0, results.episode[-1])
    axes.margins(y=0.06)
    axes.set_xlabel("episode", color=style.INK, size=9)
    axes.set_ylabel(title, color=style.INK, size=9)
    _legend(axes, len(lines), panel.vary)


def _ratios(axes: Axes, panel: Panel, evidence: Evidence) -> None:
    """Performance over the ratios, mean over environments with its interval as a bar."""
    metric = "reward_share" if panel.metric == "reward" else panel.metric
    title, unit = _AXES[metric]
    ratios, lines = evidence.scale.ratios, panel.lines(evidence.scale)
    values = [tuple(getattr(line, key) for key in panel.vary) for line in lines]
    for i, line in enumerate(lines):
        measured = evidence.of(metric, line, ratio=ratios) / unit
        mean, low, high = _bands(measured)
        # Side by side, so that no bar hides another.
        x = np.arange(len(ratios)) + 0.09 * (i - (len(lines) - 1) / 2)
        axes.errorbar(
            x,
            mean,
            yerr=np.stack([mean - low, high - mean]),
            label=style.label(line, panel.vary),
            ms=4.5,
            elinewidth=1.0,
            **style.look(line, panel.vary, values) | {"lw": 1.3},
        )
    axes.set_xticks(range(len(ratios)), [name(ratio) for ratio in ratios])
    axes.margins(y=0.06)
    axes.set_xlabel(r"$\beta : \zeta$", color=style.INK, size=9)
    axes.set_ylabel(title, color=style.INK, size=9)
    _legend(axes, len(lines), panel.vary)


def _grid(axes: Axes, panel: Panel, evidence: Evidence) -> None:
    """Performance over two parameters, as a map; the paper's choice has a frame."""
    title, unit = _AXES[panel.metric]
    scale = evidence.scale
    measured = evidence.of(panel.metric, panel.setting, gamma=scale.gammas, epsilon=scale.epsilons) / unit
    means = measured.mean(axis=0)
    image = axes.imshow(means, cmap=PATH_COLOURS, aspect="auto", origin="lower")
    for i, gamma in enumerate(scale.gammas):
        for j, epsilon in enumerate(scale.epsilons):
            mean, low, high = interval(measured[:, i, j])
            colour = style.shade(image.to_rgba(np.array([mean]))[0])
            axes.text(j, i + 0.1, f"{mean:.3f}", color=colour, size=11, ha="center", va="center")
            axes.text(j, i - 0.2, f"{low:.3f} to {high:.3f}", color=colour, size=7, ha="center", va="center")
            if (gamma, epsilon) == (Setting().gamma, Setting().epsilon):
                x, y = np.array([-1, 1, 1, -1, -1]) * 0.46 + j, np.array([-1, -1, 1, 1, -1]) * 0.46 + i
                axes.plot(x, y, color=style.PAPER, lw=2.2)
    axes.set_xticks(range(len(scale.epsilons)), [f"{value:g}" for value in scale.epsilons])
    axes.set_yticks(range(len(scale.gammas)), [f"{value:g}" for value in scale.gammas])
    axes.set_xlabel(r"$\epsilon$, probability of the greedy action", color=style.INK, size=9)
    axes.set_ylabel(r"$\gamma$, discount", color=style.INK, size=9)
    style.dress(axes)
    axes.grid(False)
    text = f"{title}; the paper's choice is framed"
    axes.text(0, 1.03, text, transform=axes.transAxes, color=style.MUTED, size=8.5)


_DRAW = {"curves": _curves, "ratios": _ratios, "grid": _grid}


def _legend(axes: Axes, n_lines: int, vary: tuple[str, ...]) -> None:
    """Above the axes, where it covers nothing."""
    n_columns = 2 if len(vary) == 2 else n_lines
    axes.legend(
        loc="lower left",
        bbox_to_anchor=(-0.01, 1.0),
        borderaxespad=0.1,
        ncols=n_columns,
        frameon=False,
        fontsize=8.5,
        labelcolor=style.INK,
        handlelength=2.6 if len(vary) == 2 else 1.2,
        columnspacing=1.2,
        handletextpad=0.5,
        labelspacing=0.3,
    )
    style.dress(axes)


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
    drawn = Figure(figsize=(wide, high), facecolor=style.PAPER)
    facts = f"{plan.panels[0].title}; greedy missions after training, one in each environment"
    _header(drawn, plan.caption, facts, scale)
    for i, image in enumerate(pictures):
        row, column = divmod(i, n_columns)
        y = high - header - (row + 1) * (one_high + 0.3)
        axes = drawn.add_axes((column / n_columns, y / high, 1 / n_columns, one_high / high))
        axes.imshow(image, interpolation="lanczos")
        axes.axis("off")
        where = ((column + 0.1) / n_columns, (y + one_high + 0.05) / high)
        drawn.text(*where, f"environment {scale.environments[i]}", color=style.MUTED, size=11)
    return drawn


def _header(drawn: Figure, title: str, facts: str, scale: Scale) -> None:
    """Title, facts, and the warning that a smoke test needs."""
    wide, high = drawn.get_size_inches()
    x, y = 0.25 / wide, 1 - 0.18 / high
    text = "\n".join(_lines(title, wide))
    drawn.text(x, y, text, color=style.INK, size=12, weight="bold", va="top", linespacing=1.15)
    y = 1 - (_header_high(title, wide) - 0.15) / high
    smoke = scale.name == "smoke"
    facts = "smoke test: these numbers mean nothing" if smoke else facts
    colour = style.WARNING if smoke else style.MUTED
    drawn.text(x, y, facts, color=colour, size=8.5, weight="bold" if smoke else "normal", va="center")


def _header_high(title: str, wide: float) -> float:
    """Inches that the title, in a figure of some width in inches, and the line below it take."""
    return 0.45 + 0.22 * len(_lines(title, wide))


def _lines(title: str, wide: float) -> list[str]:
    # A bold letter of this size is about a tenth of an inch wide.
    return textwrap.wrap(title.replace("beta/zeta", "β/ζ"), int((wide - 0.5) / 0.105))


def _facts(plan: FigurePlan, scale: Scale) -> str:
    """What the marks are."""
    runs = f"{scale.repeats} runs" if scale.repeats > 1 else "1 run"
    marks = f"{len(scale.environments)} environments × {runs}: mean, 95% bootstrap interval"  # noqa: RUF001
    if any(panel.kind == "curves" for panel in plan.panels):
        marks += f"; curves: moving average over {SMOOTHING * scale.episodes_per_point} episodes"
    if any(panel.kind != "curves" for panel in plan.panels):
        marks += "; levels: last fifth of the training"
    return marks


def _bands(values: Array) -> tuple[Array, Array, Array]:
    """Mean of each column of `[E, P]`, and its interval, each `[P]`."""
    mean, low, high = np.array([interval(column) for column in values.T]).T
    return mean, low, high
