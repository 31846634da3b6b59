"""The reward of the trade-off game: R_plus in two shapes, the reward in two forms."""

from dataclasses import dataclass
from typing import Literal, TypeAlias

from uav_dc_ros.core.arrays import Array, array_namespace

RPlus: TypeAlias = Literal["binary", "exponential"]
RewardForm: TypeAlias = Literal["immediate", "episode"]


@dataclass(frozen=True, kw_only=True)
class Rewards:
    """Reward settings of many worlds that differ in them, each `[...]`.

    Attributes:
        beta, zeta: weights of the data and of R_plus.
        r_plus: whether R_plus is exponential, bool; otherwise binary.
        form: whether the form is the episode's, bool; otherwise immediate.
        data_scale_bits: data of a user that counts as 1, bit.
    """

    beta: Array
    zeta: Array
    r_plus: Array
    form: Array
    data_scale_bits: Array


def r_plus(dock_distance_cells: Array, shape: RPlus | Array) -> Array:
    """Reward for the trajectory, in [0, 1], `[...]`.

    `binary` (eq. 8): 1 at the dock, else 0. `exponential` (eq. 9): `exp(-distance)`. The distance is in
    cells: in metres the exponential of any relevant distance is zero in floating point.

    Args:
        dock_distance_cells: horizontal distance to the dock, cells, `[...]`.
        shape: `binary` or `exponential`, or for each world whether it is exponential, bool `[...]`.
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

    `data_scale_bits` brings the first term to order one; the paper leaves its unit open.

    Args:
        data_bits: data collected while P(m, k) was 1, bit, `[..., U]` with U = M K users.
        r_plus: `[...]`.
        beta: weight of the data, a number or `[...]`.
        zeta: weight of the trajectory, a number or `[...]`.
        data_scale_bits: data of a user that counts as 1, bit, a number or `[...]`.
    """
    return beta * (array_namespace(data_bits).mean(data_bits, axis=-1) / data_scale_bits) + zeta * r_plus


def step_reward(total: Array, previous_total: Array, form: RewardForm | Array) -> Array:
    """The agent's reward for one step, `[...]`.

    `immediate` (r_1, eq. 23) is the difference `r^t - r^(t-1)`. `episode` (r_2, eq. 24) is the sum of
    all differences so far; that sum telescopes to r^t itself, since a mission starts from r = 0.

    Args:
        total: r^t, `[...]`.
        previous_total: r^(t-1), `[...]`; 0 at the first step.
        form: `immediate` or `episode`, or for each world whether it is the episode's, bool `[...]`.
    """
    if isinstance(form, str):
        return total - previous_total if form == "immediate" else total
    return array_namespace(total).where(form, total, total - previous_total)
