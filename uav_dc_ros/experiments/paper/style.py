"""How the figures look: colours that colour-blind readers can tell apart, lines, names."""

from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, to_rgb

from uav_dc_ros.env.render import FAINT, INK, PAPER
from uav_dc_ros.experiments.paper.evidence import name
from uav_dc_ros.experiments.paper.setting import Setting

__all__ = ["FAINT", "INK", "MUTED", "PAPER", "WARNING", "dress", "label", "look", "shade"]

MUTED, WARNING = "#66707c", "#b3261e"
# What differs first is told by the colour, what differs second by dashes and an open marker.
_FIRST = ("#1f5fa8", "#d1601f")
_SECOND: tuple[dict[str, Any], ...] = (
    {"ls": (0, (4, 2)), "marker": "o", "markerfacecolor": PAPER},
    {"ls": "-", "marker": "s"},
)
# From more weight on the trajectory, by the balance in ink, to more weight on the data.
_RATIOS = LinearSegmentedColormap.from_list("ratios", ["#79bce6", "#2b78bd", INK, "#cc5a1b", "#f0ad45"])
_VALUES = matplotlib.colormaps["viridis"]
_SYMBOLS = {"batch_size": "K", "learning_rate": "lr", "gamma": r"$\gamma$", "epsilon": r"$\epsilon$"}


def look(setting: Setting, vary: tuple[str, ...], values: list[tuple[object, ...]]) -> dict[str, Any]:
    """Line properties of a setting among those of a panel.

    Args:
        setting: whose line.
        vary: what the panel's lines differ in.
        values: what every line has there, in order.
    """
    mine = _values(setting, vary)
    emphasised = {"lw": 1.8, "zorder": 4}
    if len(vary) == 2:
        first, second = ([point[i] for point in values] for i in (0, 1))
        colour = _FIRST[list(dict.fromkeys(first)).index(mine[0])]
        return emphasised | {"color": colour} | _SECOND[list(dict.fromkeys(second)).index(mine[1])]
    where = values.index(mine) / max(len(values) - 1, 1)
    shade_of = _RATIOS(where) if vary == ("ratio",) else _VALUES(0.82 * where)
    # The value that the paper settles on, or finds best.
    if mine == _values(Setting(), vary):
        return emphasised | {"color": shade_of, "lw": 2.6, "zorder": 5}
    return emphasised | {"color": shade_of, "lw": 1.5}


def label(setting: Setting, vary: tuple[str, ...]) -> str:
    """A line's name in a legend."""
    words = []
    for key, value in zip(vary, _values(setting, vary), strict=True):
        words.append(f"{_SYMBOLS[key]} = {name(value)}" if key in _SYMBOLS else name(value))
    return ", ".join(words)


def shade(colour: Any) -> str:
    """Ink or paper: which of the two can be read on a colour."""
    red, green, blue = to_rgb(colour)
    return INK if 0.3 * red + 0.59 * green + 0.11 * blue > 0.5 else PAPER


def dress(axes: Axes) -> None:
    """Quiet axes: a faint grid, two spines."""
    axes.set_facecolor("none")
    axes.tick_params(colors=INK, labelsize=8.5, length=0)
    axes.grid(color=FAINT, lw=0.6, alpha=0.7)
    axes.set_axisbelow(True)
    for side, spine in axes.spines.items():
        spine.set_color(FAINT)
        spine.set_visible(side in ("left", "bottom"))


def _values(setting: Setting, vary: tuple[str, ...]) -> tuple[object, ...]:
    return tuple(getattr(setting, key) for key in vary)
