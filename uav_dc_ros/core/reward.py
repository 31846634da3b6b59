"""The reward of the trade-off game: R_plus in two shapes, the reward in two forms."""

from dataclasses import dataclass
from typing import Literal, TypeAlias

from uav_dc_ros.core.arrays import Array, array_namespace

RPlus: TypeAlias = Literal["binary", "exponential"]
RewardForm: TypeAlias = Literal["immediate", "episode"]


@dataclass(frozen=True, kw_only=True)
class Rewards:
    """The trade-off game of many worlds that are paid in different ways, each `[...]`.

    Attributes:
        beta, zeta: weights of the data and of R_plus.
        r_plus: where R_plus is exponential, bool; elsewhere it is binary.
        form: where the form is the episode's, bool; elsewhere it is immediate.
        data_scale_bits: data of a user that counts as 1, bit.
    """

    beta: Array
    zeta: Array
    r_plus: Array
    form: Array
    data_scale_bits: Array


def r_plus(dock_distance_cells: Array, shape: RPlus | Array) -> Array:
    """Reward for the trajectory.

    `binary` (eq. 8): 1 at the dock, else 0. `exponential` (eq. 9): 1 at the dock, else
    `exp(-distance)`. The distance is in grid cells: in metres the exponential of any distance worth
    flying is zero in floating point.

    Args:
        dock_distance_cells: horizontal distance to the dock, cells, `[...]`.
        shape: `binary` or `exponential`, or for each world whether it is exponential, bool `[...]`.

    Returns:
        R_plus, in [0, 1], `[...]`.
    """
    xp = array_namespace(dock_distance_cells)
    if isinstance(shape, str):
        if shape == "exponential":
            return xp.exp(-dock_distance_cells)
        return xp.astype(dock_distance_cells == 0.0, dock_distance_cells.dtype)
    return xp.where(shape, r_plus(dock_distance_cells, "exponential"), r_plus(dock_distance_cells, "binary"))


def total(
    data_bits: Array,
    r_plus: Array,
    beta: float | Array,
    zeta: float | Array,
    data_scale_bits: float | Array,
) -> Array:
    """The reward r^t (eq. 7): `beta / (M K) sum(data) / data_scale_bits + zeta R_plus`.

    `data_bits` already holds only what was collected while P(m, k) was 1. `data_scale_bits` brings
    the first term to order one; the paper leaves its unit open.

    Args:
        data_bits: data collected up to now, bit, `[..., U]` with U = M K users.
        r_plus: `[...]`.
        beta: weight of the data, a number or `[...]`.
        zeta: weight of the trajectory, a number or `[...]`.
        data_scale_bits: data of a user that counts as 1, bit, a number or `[...]`.

    Returns:
        r^t, `[...]`.
    """
    return beta * (array_namespace(data_bits).mean(data_bits, axis=-1) / data_scale_bits) + zeta * r_plus


def earned(total: Array, previous_total: Array, form: RewardForm | Array) -> Array:
    """What the agent is paid for one step.

    `immediate` (r_1, eq. 23) is the difference `r^t - r^(t-1)`. `episode` (r_2, eq. 24) is the sum of
    all differences so far; that sum telescopes to r^t itself, since a mission starts from r = 0.

    Args:
        total: r^t, `[...]`.
        previous_total: r^(t-1), `[...]`; 0 at the first step.
        form: `immediate` or `episode`, or for each world whether it is the episode's, bool `[...]`.

    Returns:
        The reward of the step, `[...]`.
    """
    if isinstance(form, str):
        return total - previous_total if form == "immediate" else total
    return array_namespace(total).where(form, total, total - previous_total)
