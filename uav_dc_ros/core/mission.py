"""The state of a mission: users served, data collected, UAV over the dock."""

from uav_dc_ros.core.arrays import Array, array_namespace


def served(distance_m: Array, collected: Array, d_cons_m: float) -> Array:
    """P(m, k), bool `[..., U]`: the user is within `d_cons_m` (3D, metres) and not collected yet."""
    return (distance_m <= d_cons_m) & ~collected


def delivered(served: Array, rate_bps: Array, step_s: float) -> Array:
    """Data that each user delivers in a step (eq. 4, the rate constant over a step), bit, `[..., U]`."""
    return rate_bps * step_s * served


def collect(
    data_bits: Array, collected: Array, delivered_bits: Array, r_min_bits: float | Array
) -> tuple[Array, Array]:
    """`data_bits` and `collected` after a step with `delivered_bits`, all `[..., U]`; see `delivered`.

    A user counts as collected from `r_min_bits`, a number or `[U]`, to the end of the mission.
    """
    data_bits = data_bits + delivered_bits
    return data_bits, collected | (data_bits >= r_min_bits)


def sum_rate(served: Array, rate_bps: Array) -> Array:
    """Sum of the rates of the served users, bit/s, `[...]`."""
    return (rate_bps * served).sum(axis=-1)


def at_dock(cell: Array, dock_cell: tuple[int, int]) -> Array:
    """Whether the UAV is over the dock, bool `[...]`.

    X_target is the column of cells above the dock: the paper measures the distance to the destination
    horizontally, and calls X_target a set.
    """
    east, north = dock_cell
    return (cell[..., 0] == east) & (cell[..., 1] == north)


def dock_distance_cells(cell: Array, dock_cell: tuple[int, int], like: Array) -> Array:
    """Horizontal distance to the dock, in cells, `[...]`, with the dtype of `like`."""
    xp = array_namespace(cell)
    east, north = dock_cell
    dx, dy = xp.astype(cell[..., 0] - east, like.dtype), xp.astype(cell[..., 1] - north, like.dtype)
    return xp.sqrt(dx * dx + dy * dy)
