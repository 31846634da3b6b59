"""A page of a scenario: a map for each layer, what a check finds, and the clusters."""

from typing import Any

import msgspec
import numpy as np

from uav_dc_ros import __version__
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import ScenarioError
from uav_dc_ros.experiments.scenarios.rate_map import rate_map, scale_bar_m
from uav_dc_ros.recordings.pages.page import Page, world_data
from uav_dc_ros.scenarios.generation import flyable

USERS_MAX = 5000  # drawn


def content(scenario: Scenario) -> bytes:
    """The page, UTF-8."""
    page = Page("field", f"{scenario.name}: map")
    if not page.add("data", _data(scenario)):
        raise ScenarioError(f"{scenario.name}: its page does not fit into 3 MB; expected a smaller field")
    return page.content()


def _data(scenario: Scenario) -> dict[str, Any]:
    rates, grid = rate_map(scenario), scenario.grid
    hovers_m = flyable.nearest_cells_m(scenario, np.asarray(scenario.cluster_centres_m))[:, :2]
    return {
        "version": __version__,
        "world": world_data(scenario),
        "east_m": rates.east_m.tolist(),
        "north_m": rates.north_m.tolist(),
        "layers": [
            {
                "altitude_m": layer.altitude_m,
                "reach_m": layer.reach_m,
                # Rows from south to north, as Plotly draws them; NaN becomes null.
                "sum_rate_bps": [[float(f"{rate:.4g}") for rate in row] for row in layer.sum_rate_bps.T],
            }
            for layer in rates.layers
        ],
        "missions": rates.missions,
        "users_m": rates.users_m[:USERS_MAX].round(1).T.tolist(),
        "hovers_m": hovers_m.tolist(),
        "out_of_reach_m": flyable.out_of_reach_m(scenario)[:USERS_MAX].round(1).T.tolist(),
        "scale_bar_m": scale_bar_m(grid.n_x * grid.cell_m),
        "check": msgspec.to_builtins(flyable.examine(scenario)),
    }
