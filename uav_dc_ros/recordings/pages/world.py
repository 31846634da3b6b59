"""What a page draws, and tells, of a world."""

from typing import Any

from uav_dc_ros.core import radio
from uav_dc_ros.core.scenario import Scenario


def world(scenario: Scenario) -> dict[str, Any]:
    """What a page draws, and tells, of the world."""
    grid, mission, reward = scenario.grid, scenario.mission, scenario.reward
    return {
        "name": scenario.name,
        "fingerprint": scenario.fingerprint,
        "users": scenario.n_users,
        "clusters": scenario.users.cluster_centres_m,
        "cluster_radius_m": scenario.users.cluster_radius_m,
        "n_x": grid.n_x,
        "n_y": grid.n_y,
        "cell_m": grid.cell_m,
        "top_m": grid.altitude_min_m + (grid.n_z - 1) * grid.altitude_step_m,
        "start_m": mission.start_m,
        "dock_m": mission.dock_m,
        "step_s": mission.step_s,
        "max_steps": mission.max_steps,
        "d_cons_m": mission.d_cons_m,
        "reach_m": radio.ground_reach_m(mission.d_cons_m, grid.altitude_min_m),
        "r_min_bits": mission.r_min_bits,
        "beta": reward.beta,
        "zeta": reward.zeta,
        "r_plus": reward.r_plus,
        "data_scale_bits": reward.data_scale_bits,
    }
