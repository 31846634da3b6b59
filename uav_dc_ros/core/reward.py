"""The reward of the trade-off game: data in two readings, R_plus in two shapes, the reward in two forms."""

from dataclasses import dataclass
from typing import Literal, TypeAlias

from uav_dc_ros.core.arrays import Array, array_namespace

RPlus: TypeAlias = Literal["binary", "exponential"]
RewardForm: TypeAlias = Literal["immediate", "episode"]
RewardData: TypeAlias = Literal["step", "so_far"]

# Words for every table, figure and page: R in r^t (eq. 7), and the reward of a mission, see `mission_reward`.
DATA: dict[RewardData, str] = {"step": "data of the step", "so_far": "data so far"}
MISSION_REWARD: dict[RewardData, str] = {"step": "r^t, mean over the steps", "so_far": "r^t at the end"}


@dataclass(frozen=True, kw_only=True)
class Rewards:
    """Reward settings of many worlds that differ in them, each `[...]`; see `scenario.RewardSettings`."""

    beta: Array
    zeta: Array
    r_plus: Array  # whether R_plus is exponential, bool; otherwise binary
    form: Array  # whether the form is the episode's, bool; otherwise immediate
    data: Array  # whether R is the data of the step, bool; otherwise the data so far
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


def counted_data(delivered_bits: Array, data_bits: Array, data: RewardData | Array) -> Array:
    """R of each user in r^t (eq. 7), bit, `[..., U]`; the paper leaves open which data it is.

    `step`: what the user delivers in step t, `delivered_bits`. `so_far`: what it has delivered in the steps
    up to t, `data_bits`. Both are `[..., U]`.

    `data` is the reading's name, or for each world whether it is `step`, bool `[...]`.
    """
    if isinstance(data, str):
        return delivered_bits if data == "step" else data_bits
    return array_namespace(data_bits).where(data[..., None], delivered_bits, data_bits)


def total(
    counted_bits: Array,
    r_plus: Array,
    beta: float | Array,
    zeta: float | Array,
    data_scale_bits: float | Array,
    weights: Array | None = None,
) -> Array:
    """The reward r^t (eq. 7), `[...]`: `beta / (M K) sum(R) / data_scale_bits + zeta R_plus`.

    `counted_bits` `[..., U]` is R of U = M K users, see `counted_data`. `data_scale_bits` is the data of a
    user that counts as 1: it brings the first term to order one; the paper leaves its unit open. It, `beta`
    and `zeta` are numbers or `[...]`. With `weights` `[U]`, which add up to 1, the mean over the users is
    `sum(weights R)`.
    """
    if weights is None:
        mean_bits = array_namespace(counted_bits).mean(counted_bits, axis=-1)
    else:
        mean_bits = (counted_bits * weights).sum(axis=-1)
    return beta * (mean_bits / data_scale_bits) + zeta * r_plus


def step_reward(total: Array, previous_total: Array, form: RewardForm | Array) -> Array:
    """The agent's reward for one step, `[...]`.

    `immediate` (r_1, eq. 23) is the difference `r^t - r^(t-1)`. `episode` (r_2, eq. 24) is the sum of
    all differences so far; that sum telescopes to r^t itself, since a mission starts from r = 0.

    So the immediate rewards of a mission add up to its last r^t: with the data `so_far` it holds the data of
    all steps, with the data of the `step` that of the last step only. The episode rewards add up to the sum
    of r^t: with the data of the `step` a bit counts once in it, with the data `so_far` once for each step
    from its own to the last.

    `form` is its name, or for each world whether it is the episode's, bool `[...]`. `total` is r^t, `[...]`.
    """
    if isinstance(form, str):
        return total - previous_total if form == "immediate" else total
    return array_namespace(total).where(form, total, total - previous_total)


def mission_reward(before: Array, total: Array, n_steps: Array, data: RewardData | Array) -> Array:
    """The reward of a mission, by which missions are compared, after `n_steps` steps, `[...]`.

    `so_far`: r^t at its end, which holds the data of all steps. `step`: the mean of r^t over its steps.
    `MISSION_REWARD` has the words.

    `before` is the reward of the mission one step earlier, 0 before the first, and `total` is r^t of the
    last step, both `[...]`. `n_steps` counts the steps with a known r^t, `[...]`, with the dtype of `total`.
    `data` is the reading's name, or for each world whether it is `step`, bool `[...]`.
    """
    mean = before + (total - before) / n_steps
    if isinstance(data, str):
        return mean if data == "step" else total
    return array_namespace(total).where(data, mean, total)
