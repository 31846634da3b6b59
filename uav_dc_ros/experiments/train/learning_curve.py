"""The picture of how a population learnt. Needs matplotlib."""

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.env.render import COLLECTED, FAINT, INK, PAPER
from uav_dc_ros.experiments.train.training import Training

# Curve, title, and its scale: what a reader asks first.
_PANELS = (
    ("users_collected", "users collected", 1.0),
    ("landing_rate", "share of missions that landed", 1.0),
    ("episode_return", "return of an episode", 1.0),
)
_SMOOTHING = 50


def save_learning_curve(training: Training, chosen: int, path: Path) -> None:
    """Draws the curves of all runs, of which run `chosen` became the policy, as means over 50 episodes."""
    figure = Figure(figsize=(7.2, 6.6), dpi=130, facecolor=PAPER)
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots(len(_PANELS), 1, sharex=True)
    n_episodes, n_runs = training.curves["reward"].shape
    window = max(1, min(_SMOOTHING, n_episodes // 10))
    episodes = np.arange(window, n_episodes + 1)
    for axis, (name, title, scale) in zip(axes, _PANELS, strict=True):
        smooth = _running_mean(training.curves[name] / scale, window)
        others = [run for run in range(n_runs) if run != chosen]
        axis.plot(episodes, smooth[:, others], color=FAINT, linewidth=1.0)
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
    known = np.isfinite(values)
    sums = np.cumsum(np.where(known, values, 0.0), axis=0, dtype=np.float64)
    counts = np.cumsum(known, axis=0)
    zero = np.zeros((1, values.shape[1]))
    total = np.concatenate([zero, sums])
    count = np.concatenate([zero, counts])
    with np.errstate(invalid="ignore"):
        return (total[window:] - total[:-window]) / (count[window:] - count[:-window])
