"""A picture of a mission: the field from above, and altitude and users collected over the steps."""

import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import CircleCollection, LineCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon

from uav_dc_ros import files
from uav_dc_ros.core import mission, radio
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.env.trajectory import Trajectory

INK, PAPER, FAINT = "#1d2733", "#fbfaf7", "#d9d5cb"
WAITING, COLLECTED, DOCK = "#c9502c", "#2a8c6e", "#1d2733"
BUILDING: dict[str, Any] = {"fc": "#b3ab98", "ec": "#7d7665", "lw": 0.8}
NO_FLY: dict[str, Any] = {"fc": "#f3d9d2", "ec": "#c9502c", "lw": 0.8, "hatch": "///"}
BORDER, TICKS_MAX = 0.8, 20  # cells around the field's outermost centres; cells with a tick at every other
PATH_COLOURS = LinearSegmentedColormap.from_list("path", ["#2b3f7e", "#8c5aa6", "#f0a83a"])


def picture(trajectory: Trajectory) -> Array:
    """The mission so far, `[H, W, 3]` uint8."""
    canvas = FigureCanvasAgg(_figure(trajectory, dpi=100))
    canvas.draw()  # type: ignore[no-untyped-call]
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()  # type: ignore[no-untyped-call]


def save_picture(trajectory: Trajectory, path: Path) -> None:
    """Write the mission so far as an image; the path's suffix is the format, PNG without one."""
    with files.replacing(path) as partial:
        format = path.suffix.removeprefix(".") or "png"
        FigureCanvasAgg(_figure(trajectory, dpi=150)).figure.savefig(partial, format=format)


def _figure(trajectory: Trajectory, dpi: int) -> Figure:
    grid = trajectory.scenario.grid
    # Height of the field over its width; beyond these limits bands are left blank.
    ratio = min(1.6, max(0.2, (grid.n_y - 1 + 2 * BORDER) / (grid.n_x - 1 + 2 * BORDER)))
    height = 8.7 - 0.67 * 8.7 * (1.0 - ratio)
    per = 8.7 / height  # of the lengths below, which are shares of a square field's picture
    figure = Figure(figsize=(7.2, height), dpi=dpi, facecolor=PAPER)
    field = figure.add_axes((0.1, 0.235 * per, 0.81, 0.67 * ratio * per))
    steps = figure.add_axes((0.1, 0.06 * per, 0.81, 0.115 * per))
    _draw_field(field, trajectory)
    _draw_steps(steps, trajectory)
    step, n_steps = len(trajectory.cells) - 1, trajectory.scenario.mission.max_steps
    docked = bool(mission.at_dock(trajectory.cells[-1], trajectory.scenario.dock_cell))
    status = "over the dock" if docked else f"sum-rate {trajectory.sum_rate_bps[-1] / 1e6:.2f} Mbit/s"
    title = f"{trajectory.n_collected[-1]} of {trajectory.scenario.n_users} users collected"
    facts = f"{trajectory.scenario.name}   ·   step {step} of {n_steps}   ·   {status}"
    figure.text(0.1, 1.0 - 0.048 * per, title, color=INK, size=15, weight="bold")
    figure.text(0.1, 1.0 - 0.074 * per, facts, color=INK, size=9.5)
    return figure


def _draw_field(axes: Axes, trajectory: Trajectory) -> None:
    """The field from above; the path is coloured by step, and a dot grows with the time spent at it."""
    scenario, state = trajectory.scenario, trajectory.state
    assert state is not None, "only a started mission is drawn"
    cell_m = scenario.grid.cell_m
    path_m = np.stack(trajectory.cells)[:, :2] * cell_m
    limits = (0, scenario.mission.max_steps)

    for disc in scenario.users.clusters:
        axes.add_patch(Circle(disc.centre_m, disc.radius_m, fc="#e9e4d6", zorder=1))
    for obstacle in scenario.obstacles:
        style = BUILDING if obstacle.kind == "building" else NO_FLY
        axes.add_patch(Polygon(obstacle.polygon_m, zorder=1.5, **style))
    for done, colour, size in ((False, WAITING, 20), (True, COLLECTED, 26)):
        x_m, y_m = state.users_m[state.collected == done].T
        label = "collected" if done else "waiting"
        axes.scatter(x_m, y_m, s=size, c=colour, edgecolors=PAPER, linewidths=0.6, zorder=6.5, label=label)

    axes.plot(path_m[:, 0], path_m[:, 1], color=PAPER, lw=5, solid_capstyle="round", zorder=4)
    pieces = np.stack([path_m[:-1], path_m[1:]], axis=1)
    line = LineCollection(list(pieces), cmap=PATH_COLOURS, lw=2.6, capstyle="round", zorder=5)
    line.set_array(np.arange(1, len(path_m)))
    line.set_clim(*limits)
    axes.add_collection(line)
    spots, first, stays = np.unique(path_m, axis=0, return_index=True, return_counts=True)
    dots = CircleCollection(
        list(12.0 * stays), offsets=spots, offset_transform=axes.transData, cmap=PATH_COLOURS, zorder=6
    )
    dots.set_array(first)
    dots.set_clim(*limits)
    dots.set_edgecolor(PAPER)
    axes.add_collection(dots)

    (start_x_m, start_y_m, _), (dock_x_m, dock_y_m) = scenario.mission.start_m, scenario.mission.dock_m
    axes.scatter(start_x_m, start_y_m, s=70, facecolors="none", edgecolors=INK, lw=1.6, zorder=7)
    axes.scatter(dock_x_m, dock_y_m, marker="s", s=130, c=DOCK, edgecolors=PAPER, lw=1.2, zorder=7)
    for text, x_m, y_m, lift in (("start", start_x_m, start_y_m, -20), ("dock", dock_x_m, dock_y_m, 13)):
        axes.annotate(text, (x_m, y_m), (0, lift), textcoords="offset points", color=INK, size=9, ha="center")

    altitude_m = float(scenario.grid.centre_m(trajectory.cells[-1], like=state.users_m)[2])
    reach_m = radio.ground_reach_m(scenario.mission.d_cons_m, altitude_m)
    x_m, y_m = path_m[-1]
    axes.add_patch(Circle((x_m, y_m), reach_m, fill=False, ec=INK, lw=0.9, ls=(0, (5, 4)), zorder=2))
    axes.scatter(x_m, y_m, marker="^", s=90, c="#f2c14e", edgecolors=INK, lw=1.1, zorder=8, label="UAV")

    wide_m, high_m = (scenario.grid.n_x - 1) * cell_m, (scenario.grid.n_y - 1) * cell_m
    border_m = BORDER * cell_m
    axes.set(xlim=(-border_m, wide_m + border_m), ylim=(-border_m, high_m + border_m))
    axes.set_aspect("equal")
    apart_m = 2 * cell_m * math.ceil(max(scenario.grid.n_x, scenario.grid.n_y) / TICKS_MAX)
    axes.set_xticks(np.arange(0, wide_m + 1, apart_m))
    axes.set_yticks(np.arange(0, high_m + 1, apart_m))
    axes.set_xlabel("east, m", color=INK, size=9)
    axes.set_ylabel("north, m", color=INK, size=9)
    axes.legend(loc="upper left", frameon=False, fontsize=9, labelcolor=INK, handletextpad=0.2)
    _style(axes)


def _draw_steps(axes: Axes, trajectory: Trajectory) -> None:
    """Altitude and users collected over the steps."""
    scenario, grid = trajectory.scenario, trajectory.scenario.grid
    steps = np.arange(len(trajectory.cells))
    axes.fill_between(steps, trajectory.n_collected, color=COLLECTED, alpha=0.25, lw=0, step="post")
    axes.step(steps, trajectory.n_collected, color=COLLECTED, lw=1.6, where="post")
    axes.set(xlim=(0, scenario.mission.max_steps), ylim=(0, scenario.n_users * 1.08))
    axes.set_xlabel("step", color=INK, size=9)
    axes.set_ylabel("users\ncollected", color=COLLECTED, size=9)
    _style(axes)
    height = axes.twinx()
    altitudes_m = grid.altitude_min_m + np.stack(trajectory.cells)[:, 2] * grid.altitude_step_m
    top_m = grid.altitude_min_m + (grid.n_z - 1) * grid.altitude_step_m
    height.step(steps, altitudes_m, color=INK, lw=1.3, where="post")
    height.set_ylim(0, top_m * 1.2)
    height.set_ylabel("altitude, m", color=INK, size=9)
    _style(height)


def _style(axes: Axes) -> None:
    axes.set_facecolor("none")
    axes.tick_params(colors=INK, labelsize=8, length=0)
    axes.grid(color=FAINT, lw=0.5, alpha=0.6)
    axes.set_axisbelow(True)
    for spine in axes.spines.values():
        spine.set_color(FAINT)
