"""The plot of learning curves. Needs matplotlib."""

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.env.render import COLLECTED, FAINT, INK, PAPER
from uav_dc_ros.experiments.train.training import Training

_TITLES = {
    "users_collected": "users collected",
    "landing_rate": "share of missions that landed",
    "episode_return": "return of an episode",
}
_SMOOTHING = 50  # episodes


def save_learning_curve(training: Training, chosen: int, path: Path) -> None:
    """Plots the smoothed curves of all runs, with run `chosen`, which became the policy, in green."""
    figure = Figure(figsize=(7.2, 6.6), dpi=130, facecolor=PAPER)
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots(len(_TITLES), 1, sharex=True)
    n_episodes, n_runs = training.curves["reward"].shape
    window = max(1, min(_SMOOTHING, n_episodes // 10))
    episodes = np.arange(window, n_episodes + 1)
    for axis, (name, title) in zip(axes, _TITLES.items(), strict=True):
        smooth = _running_mean(training.curves[name], window)
        axis.plot(episodes, np.delete(smooth, chosen, axis=1), color=FAINT, linewidth=1.0)
        axis.plot(episodes, smooth[:, chosen], color=COLLECTED, linewidth=1.8)
        axis.set_title(title, loc="left", color=INK, size=10, weight="bold")
        axis.set_facecolor(PAPER)
        axis.tick_params(colors=INK, labelsize=8)
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(color=FAINT, linewidth=0.5)
    axes[-1].set_xlabel(
        f"episode; exploring missions, mean over {window} episodes; green: the run that was kept"
        + (f", grey: {n_runs - 1} others" if n_runs > 1 else ""),
        color=INK,
        size=9,
    )
    figure.tight_layout()
    canvas.print_png(path)  # type: ignore[no-untyped-call]


def _running_mean(values: Array, window: int) -> Array:
    """Mean of each value `[T, N]` and those before it, `[T - window + 1, N]`; NaN are left out."""
    finite = np.isfinite(values)
    sums, counts = (
        np.pad(np.cumsum(terms, axis=0, dtype=np.float64), ((1, 0), (0, 0)))
        for terms in (np.where(finite, values, 0.0), finite)
    )
    with np.errstate(invalid="ignore"):
        return (sums[window:] - sums[:-window]) / (counts[window:] - counts[:-window])
