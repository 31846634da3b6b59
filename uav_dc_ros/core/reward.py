"""The reward of the trade-off game: R_plus in two shapes, the reward in two forms."""

from dataclasses import dataclass
from typing import Literal, TypeAlias

from uav_dc_ros.core.arrays import Array, array_namespace

RPlus: TypeAlias = Literal["binary", "exponential"]
RewardForm: TypeAlias = Literal["immediate", "episode"]


@dataclass(frozen=True, kw_only=True)
class Rewards:
    """Reward settings of many worlds that differ in them, each `[...]`; see `scenario.RewardSettings`."""

    beta: Array
    zeta: Array
    r_plus: Array  # whether R_plus is exponential, bool; otherwise binary
    form: Array  # whether the form is the episode's, bool; otherwise immediate
    data_scale_bits: Array


def r_plus(dock_distance_cells: Array, shape: RPlus | Array) -> Array:
    """Reward for the trajectory, in [0, 1], `[...]`.

    `binary` (eq. 8): 1 at the dock, else 0. `exponential` (eq. 9): `exp(-distance)`. The distance is in
    cells: in metres the exponential of any relevant distance is zero in floating point.

    `shape` is its name, or for each world whether it is exponential, bool `[...]`.
    """
    xp = array_namespace(dock_distance_cells)
    if isinstance(shape, str):
        if shape == "exponential":
            return xp.exp(-dock_distance_cells)
        return xp.astype(dock_distance_cells == 0.0, dock_distance_cells.dtype)
    return xp.where(shape, r_plus(dock_distance_cells, "exponential"), r_plus(dock_distance_cells, "binary"))


def total(
    data_bits: Array, r_plus: Array, beta: float | Array, zeta: float | Array, data_scale_bits: float | Array
) -> Array:
    """The reward r^t (eq. 7), `[...]`: `beta / (M K) sum(data) / data_scale_bits + zeta R_plus`.

    `data_bits` `[..., U]` is data collected while P(m, k) was 1, of U = M K users. `data_scale_bits` is the
    data of
    a user that counts as 1: it brings the first term to order one; the paper leaves its unit open. It,
        `beta` and
    `zeta` are numbers or `[...]`.
    """
    return beta * (array_namespace(data_bits).mean(data_bits, axis=-1) / data_scale_bits) + zeta * r_plus


def step_reward(total: Array, previous_total: Array, form: RewardForm | Array) -> Array:
    """The agent's reward for one step, `[...]`.

    `immediate` (r_1, eq. 23) is the difference `r^t - r^(t-1)`. `episode` (r_2, eq. 24) is the sum of
    all differences so far; that sum telescopes to r^t itself, since a mission starts from r = 0.

    `form` is its name, or for each world whether it is the episode's, bool `[...]`. `total` is r^t, `[...]`.
    """
    if isinstance(form, str):
        return total - previous_total if form == "immediate" else total
    return array_namespace(total).where(form, total, total - previous_total)
