"""The figure of the multiverse: claims by worlds, in colours that are distinct for colour-blind readers."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle

from uav_dc_ros import files
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.env.render import FAINT, INK, PAPER
from uav_dc_ros.errors import TrainingError
from uav_dc_ros.experiments.paper.claims.criteria import Verdict
from uav_dc_ros.experiments.paper.worlds.choices import CHOICES
from uav_dc_ros.experiments.paper.worlds.choose import choose
from uav_dc_ros.experiments.paper.worlds.verdicts import IDS, VERDICTS, Multiverse

# Blue, grey and vermilion of Okabe and Ito: they differ in hue for every reader, and in lightness in print.
COLOURS: dict[Verdict, str] = {"holds": "#0072b2", "undecided": "#d9d9d9", "does not hold": "#e69f00"}
_CUT, _MUTED, _WARNING = "#f4f2ec", "#66707c", "#b3261e"
_READINGS = ("data", "episode_end", "interference")  # below the claims, one row each
_GREYS = ("#2f3b46", "#8d99a5", "#dfe3e6")
# Sizes in inches.
_CELL_HIGH, _LEFT, _RIGHT, _ABOVE, _BELOW = 0.23, 1.15, 2.05, 1.05, 0.55
_MIN_WIDE, _MAX_CELL_WIDE = 4.0, 0.4
_DPI = 150


def order(multiverse: Multiverse) -> Array:
    """Indices of the worlds, integers `[W]`: most claims that hold first, then fewest that do not."""
    verdicts = multiverse.verdicts
    holds, fails = (verdicts == "holds").sum(axis=1), (verdicts == "does not hold").sum(axis=1)
    return np.lexsort((np.arange(len(verdicts)), fails, -holds))


def draw(multiverse: Multiverse, path: Path) -> None:
    """Writes the figure as PNG; raises TrainingError if it cannot."""
    ordered = order(multiverse)
    n_worlds, n_claims, n_readings = len(ordered), len(IDS), len(_READINGS)
    cells_wide = max(_MIN_WIDE, min(_MAX_CELL_WIDE * n_worlds, 11.0))
    claims_high, readings_high = n_claims * _CELL_HIGH, n_readings * _CELL_HIGH
    wide = _LEFT + cells_wide + _RIGHT
    high = _ABOVE + claims_high + 0.12 + readings_high + _BELOW
    figure = Figure(figsize=(wide, high), facecolor=PAPER)

    def axes(bottom: float, height: float) -> Axes:
        return figure.add_axes((_LEFT / wide, bottom / high, cells_wide / wide, height / high))

    above = axes(_BELOW + readings_high + 0.12, claims_high)
    _claims(above, multiverse, ordered)
    below = axes(_BELOW, readings_high)
    _readings(below, multiverse, ordered)
    framed = "the chosen one is framed" if choose(multiverse) else "C1 holds in none"
    worlds = "1 world" if n_worlds == 1 else f"{n_worlds} worlds"
    title = f"{worlds}, sorted by the number of claims that hold; {framed}"
    below.set_xlabel(title, color=INK, size=9)
    _header(figure, multiverse, wide, high)
    try:
        with files.replacing(path) as partial:
            FigureCanvasAgg(figure).figure.savefig(partial, dpi=_DPI, format="png")
    except OSError as error:
        raise TrainingError(f"{path} cannot be written: {error.strerror or error}") from None


def _header(figure: Figure, multiverse: Multiverse, wide: float, high: float) -> None:
    title = "The paper's claims in worlds drawn over what it leaves open"
    figure.text(0.2 / wide, 1 - 0.2 / high, title, color=INK, size=12, weight="bold", va="center")
    smoke = multiverse.metadata.scale.name != "full"
    facts = f"{multiverse.metadata.scale.episodes} episodes, {len(multiverse.metadata.scale.environments)} "
    facts += "environments; verdicts by the rules of the sweep"
    facts = "smoke test: these verdicts mean nothing" if smoke else facts
    colour = _WARNING if smoke else _MUTED
    figure.text(0.2 / wide, 1 - 0.46 / high, facts, color=colour, size=8.5, va="center")
    patches = [Patch(facecolor=COLOURS[verdict], label=verdict) for verdict in VERDICTS]
    patches.append(Patch(facecolor=_CUT, edgecolor=FAINT, hatch="////", label="not weighed: undecided"))
    figure.legend(
        handles=patches,
        loc="center left",
        bbox_to_anchor=(0.12 / wide, 1 - 0.76 / high),
        ncols=4,
        frameon=False,
        fontsize=8.5,
        labelcolor=INK,
        handlelength=1.2,
        columnspacing=1.4,
    )


def _claims(axes: Axes, multiverse: Multiverse, ordered: Array) -> None:
    index = {verdict: i for i, verdict in enumerate(VERDICTS)}
    verdicts = multiverse.verdicts[ordered].T
    values = np.vectorize(index.__getitem__)(verdicts)
    _mesh(axes, values, [COLOURS[verdict] for verdict in VERDICTS])
    for row, (name, tested) in enumerate(zip(IDS, multiverse.tested, strict=True)):
        if not tested:
            axes.add_patch(
                Rectangle((0, row), len(ordered), 1, facecolor=_CUT, edgecolor=FAINT, hatch="////", lw=0)
            )
        counts = [int((verdicts[row] == verdict).sum()) for verdict in ("holds", "does not hold")]
        text = f"{counts[0]} hold, {counts[1]} do not" if tested else "not weighed"
        axes.text(len(ordered) * 1.01, row + 0.5, text, color=_MUTED, size=8, va="center")
        axes.text(-0.01 * len(ordered), row + 0.5, name, color=INK, size=8.5, va="center", ha="right")
    chosen = choose(multiverse)
    if chosen is not None:
        x = [multiverse.worlds[i].number for i in ordered].index(chosen.number)
        axes.add_patch(Rectangle((x, 0), 1, len(IDS), fill=False, edgecolor=INK, lw=1.8, clip_on=False))


def _readings(axes: Axes, multiverse: Multiverse, ordered: Array) -> None:
    titles = {choice.name: choice.title for choice in CHOICES}
    rows, keys = [], []
    for name in _READINGS:
        made: list[str] = [getattr(multiverse.worlds[i], name) for i in ordered]
        kinds = sorted(set(made))
        shades = dict(zip(kinds, (0, 2) if len(kinds) == 2 else (0, 1, 2), strict=False))
        rows.append([shades[value] for value in made])
        keys.append(kinds)
    _mesh(axes, np.array(rows), _GREYS)
    for row, (name, kinds) in enumerate(zip(_READINGS, keys, strict=True)):
        title = titles[name].replace("users that transmit", "interference")
        axes.text(-0.01 * len(ordered), row + 0.5, title, color=INK, size=7, va="center", ha="right")
        _key(axes, len(ordered), row, kinds)


def _key(axes: Axes, n_worlds: int, row: int, kinds: Sequence[str]) -> None:
    """The shades of a reading, right of its row."""
    shades = ("dark", "light") if len(kinds) == 2 else ("dark", "mid", "light")
    text = ", ".join(f"{shade}: {kind}" for shade, kind in zip(shades, kinds, strict=False))
    axes.text(n_worlds * 1.01, row + 0.5, text, color=_MUTED, size=7, va="center")


def _mesh(axes: Axes, values: Array, colours: Sequence[Any]) -> None:
    """Cells of classes `[rows, W]`, the first row at the top, with a thin gap between them."""
    axes.pcolormesh(
        values,
        cmap=ListedColormap(colours),
        vmin=-0.5,
        vmax=len(colours) - 0.5,
        edgecolors=PAPER,
        linewidth=0.7,
    )
    axes.set_xlim(0, values.shape[1])
    axes.set_ylim(values.shape[0], 0)
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)
