"""The plot of a generalist's learning curve. Needs matplotlib."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from uav_dc_ros.env.render import COLLECTED, FAINT, INK, PAPER
from uav_dc_ros.experiments.train.generalist.training import Iteration


def save_curve(
    curve: Sequence[Iteration],
    scores: Sequence[tuple[int, float]],
    baselines: Mapping[str, float],
    path: Path,
) -> None:
    """Plot J of each iteration's missions, and of the greedy policy in the layouts that select."""
    figure = Figure(figsize=(7.2, 4.0), dpi=130, facecolor=PAPER)
    canvas = FigureCanvasAgg(figure)
    axis = figure.subplots()
    explored = [one.objective for one in curve]
    axis.plot(range(1, len(curve) + 1), explored, color=FAINT, linewidth=0.8, label="exploring, new layouts")
    axis.plot(*zip(*scores, strict=True), color=COLLECTED, linewidth=1.8, label="greedy, layouts that select")
    for (name, value), style in zip(baselines.items(), ("--", ":", "-."), strict=False):
        axis.axhline(value, color=INK, linewidth=1.0, linestyle=style, label=f"{name}, in the same layouts")
    axis.set_title("objective J", loc="left", color=INK, size=10, weight="bold")
    axis.set_xlabel("iteration", color=INK, size=9)
    axis.set_facecolor(PAPER)
    axis.tick_params(colors=INK, labelsize=8)
    axis.spines[["top", "right"]].set_visible(False)
    axis.grid(color=FAINT, linewidth=0.5)
    axis.legend(fontsize=8, frameon=False, loc="lower right")
    figure.tight_layout()
    canvas.print_png(path)  # type: ignore[no-untyped-call]
