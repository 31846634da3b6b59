"""A picture of a scenario: one map for each of up to four layers."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon

from uav_dc_ros import files
from uav_dc_ros.core import channel
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.env.render import BUILDING, DOCK, FAINT, INK, NO_FLY, PAPER, WAITING
from uav_dc_ros.experiments.scenarios.rate_map import Layer, RateMap, rate_map, scale_bar_m
from uav_dc_ros.recordings.thinning import spread
from uav_dc_ros.scenarios.generation import flyable

PANELS_MAX = 4
PANEL_IN = 4.6  # width of a panel, inches
# Light enough for circles and users to show on every tile
RATES = LinearSegmentedColormap.from_list("rates", ["#fffde8", "#d5eebb", "#7cc9bb", "#2f8fbf"])
DASHES = (0, (5, 4))
OUT_OF_REACH = "#b3261e"


def save(scenario: Scenario, path: Path) -> None:
    """Write the picture; the path's suffix is the format, PNG without one."""
    made = _figure(scenario)
    with files.replacing(path) as partial:
        FigureCanvasAgg(made).figure.savefig(partial, format=path.suffix.removeprefix(".") or "png")


def _figure(scenario: Scenario) -> Figure:
    rates = rate_map(scenario)
    shown = [rates.layers[i] for i in spread(len(rates.layers), PANELS_MAX)]
    n_columns = 2 if len(shown) == 4 else len(shown)
    n_rows = -(-len(shown) // n_columns)
    (west_m, east_m), (south_m, north_m) = _limits_m(scenario)
    shape = min(max((north_m - south_m) / (east_m - west_m), 0.3), 2.0)
    size = (PANEL_IN * n_columns + 1.2, (PANEL_IN * shape + 0.5) * n_rows + 1.2)
    figure = Figure(figsize=size, dpi=120, facecolor=PAPER, layout="constrained")
    panels = figure.subplots(n_rows, n_columns, squeeze=False, sharex=True, sharey=True).ravel()
    highest = max(float(np.nan_to_num(layer.sum_rate_bps).max()) for layer in shown) / 1e6
    norm = Normalize(0.0, highest or 1.0)
    for axes, layer in zip(panels, shown, strict=True):
        tiles = axes.pcolormesh(
            _edges(rates.east_m, scenario.grid.cell_m),
            _edges(rates.north_m, scenario.grid.cell_m),
            layer.sum_rate_bps.T / 1e6,
            cmap=RATES,
            norm=norm,
        )
        _draw_field(axes, scenario, rates, layer)
    bar = figure.colorbar(tiles, ax=list(panels), shrink=0.8, pad=0.02)
    bar.set_label("sum-rate of the users in reach, UAV over the cell, Mbit/s", color=INK, size=9)
    bar.ax.tick_params(colors=INK, labelsize=8, length=0)
    bar.outline.set_edgecolor(FAINT)
    grid, limits = scenario.grid, scenario.mission
    facts = (
        f"{scenario.n_users} users in {scenario.n_clusters} clusters",
        f"{grid.n_x} x {grid.n_y} x {grid.n_z} cells of {grid.cell_m:g} m",
        f"{limits.max_steps} steps of {limits.step_s:g} s",
        f"reach {limits.d_cons_m:g} m",
        channel.title(scenario.radio),
    )
    figure.suptitle("\n", size=15)  # room for two lines
    figure.text(0.02, 1.0 - 0.12 / size[1], scenario.name, color=INK, size=15, weight="bold", va="top")
    figure.text(0.02, 1.0 - 0.45 / size[1], "   ·   ".join(facts), color=INK, size=9, va="top")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside lower left", ncols=6, frameon=False, fontsize=9, labelcolor=INK
    )
    return figure


def _draw_field(axes: Axes, scenario: Scenario, rates: RateMap, layer: Layer) -> None:
    """What is the same in every layer, and the circles on the ground that this layer reaches."""
    cell_m, wide_m = scenario.grid.cell_m, _extent_m(scenario)[0]
    hovers_m = flyable.nearest_cells_m(scenario, np.asarray(scenario.cluster_centres_m))[:, :2]
    for obstacle in scenario.obstacles:
        closes = obstacle.base_m <= layer.altitude_m <= obstacle.top_m
        style = BUILDING if obstacle.kind == "building" else NO_FLY
        axes.add_patch(Polygon(obstacle.polygon_m, zorder=2, alpha=0.9 if closes else 0.35, **style))
    for kind, style, label in (("building", BUILDING, "building"), ("no_fly", NO_FLY, "no-fly zone")):
        if any(obstacle.kind == kind for obstacle in scenario.obstacles):
            axes.fill([], [], label=f"{label} (faint: not at this altitude)", **style)
    for disc, hover_m in zip(scenario.users.clusters, hovers_m, strict=True):
        axes.add_patch(Circle(disc.centre_m, disc.radius_m, fill=False, ec=INK, lw=1.2, zorder=3))
        axes.add_patch(Circle(hover_m, layer.reach_m, fill=False, ec=INK, lw=0.9, ls=DASHES, zorder=3))
    if any(disc.radius_m for disc in scenario.users.clusters):
        axes.plot([], [], "o", markersize=9, mfc="none", mec=INK, mew=1.2, label="cluster")
    reach = f"in reach from above a cluster ({scenario.mission.d_cons_m:g} m)"
    axes.plot([], [], color=INK, lw=0.9, ls=DASHES, label=reach)
    axes.scatter(
        rates.users_m[:, 0],
        rates.users_m[:, 1],
        s=11,
        c=WAITING,
        edgecolors=PAPER,
        linewidths=0.4,
        zorder=4,
        label="users (seed 0)",
    )
    missed_m = flyable.out_of_reach_m(scenario)[::3]
    if len(missed_m):
        axes.scatter(
            missed_m[:, 0],
            missed_m[:, 1],
            s=12,
            marker="x",
            c=OUT_OF_REACH,
            lw=0.8,
            zorder=3,
            label="out of reach of every cell",
        )
    (start_x_m, start_y_m, _), dock_m = scenario.mission.start_m, scenario.mission.dock_m
    axes.scatter(
        start_x_m, start_y_m, s=70, facecolors=PAPER, edgecolors=INK, lw=1.6, zorder=5, label="start"
    )
    axes.scatter(*dock_m, marker="s", s=90, c=DOCK, edgecolors=PAPER, lw=1.2, zorder=5, label="dock")

    limits_m = _limits_m(scenario)
    length_m, y_m = scale_bar_m(wide_m + cell_m), -0.5 * cell_m - 0.85 * _room_m(scenario)
    axes.plot([wide_m - length_m, wide_m], [y_m, y_m], color=INK, lw=3, solid_capstyle="butt")
    axes.annotate(
        f"{length_m:g} m",
        (wide_m - length_m / 2, y_m),
        (0, 3),
        textcoords="offset points",
        color=INK,
        size=8,
        ha="center",
    )
    axes.set(xlim=limits_m[0], ylim=limits_m[1])
    axes.set_facecolor("none")
    axes.set_aspect("equal")
    axes.set_title(
        f"altitude {layer.altitude_m:g} m, reaches {layer.reach_m:.0f} m on the ground",
        color=INK,
        size=10,
        loc="left",
    )
    axes.set_xlabel("east, m", color=INK, size=9)
    axes.set_ylabel("north, m", color=INK, size=9)
    axes.tick_params(colors=INK, labelsize=8, length=0)
    axes.label_outer()
    for spine in axes.spines.values():
        spine.set_color(FAINT)


def _extent_m(scenario: Scenario) -> tuple[float, float]:
    grid = scenario.grid
    return (grid.n_x - 1) * grid.cell_m, (grid.n_y - 1) * grid.cell_m


def _room_m(scenario: Scenario) -> float:
    """Room below the field for the scale bar."""
    return max(scenario.grid.cell_m, 0.08 * max(_extent_m(scenario)))


def _limits_m(scenario: Scenario) -> tuple[tuple[float, float], tuple[float, float]]:
    """What a panel shows, from west to east and from south to north."""
    cell_m, (wide_m, high_m) = scenario.grid.cell_m, _extent_m(scenario)
    centres_m = np.asarray(scenario.cluster_centres_m)
    radii_m = np.asarray([[disc.radius_m] for disc in scenario.users.clusters])
    (west_m, south_m), (east_m, north_m) = (
        (centres_m - radii_m).min(axis=0),
        (centres_m + radii_m).max(axis=0),
    )
    south_m = min(-0.5 * cell_m - 1.25 * _room_m(scenario), south_m)
    return (min(-0.9 * cell_m, west_m), max(wide_m + 0.9 * cell_m, east_m)), (
        south_m,
        max(high_m + 0.9 * cell_m, north_m),
    )


def _edges(centres_m: Array, cell_m: float) -> Array:
    """Edges of tiles around their centres, `[N + 1]`."""
    between = (centres_m[1:] + centres_m[:-1]) / 2.0
    return np.concatenate([centres_m[:1] - cell_m / 2.0, between, centres_m[-1:] + cell_m / 2.0])
