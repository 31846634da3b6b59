"""The mission's books: who is served, what is collected, has the UAV landed."""

from uav_dc_ros.core.arrays import Array, array_namespace


def served(distance_m: Array, collected: Array, d_cons_m: float) -> Array:
    """P(m, k): the user is within `d_cons_m` and not collected yet.

    Args:
        distance_m: 3D distance, metres, `[..., U]`.
        collected: bool `[..., U]`.
        d_cons_m: greatest distance at which a user can be served, metres.

    Returns:
        bool `[..., U]`.
    """
    return (distance_m <= d_cons_m) & ~collected


def collect(
    data_bits: Array,
    collected: Array,
    served: Array,
    rate_bps: Array,
    step_s: float,
    r_min_bits: float,
) -> tuple[Array, Array]:
    """Data of each user after a step (eq. 4, with the rate constant over a step).

    Args:
        data_bits: data so far, bit, `[..., U]`.
        collected: bool `[..., U]`.
        served: P of this step, bool `[..., U]`.
        rate_bps: rate in this step, bit/s, `[..., U]`.
        step_s: duration of a step, seconds.
        r_min_bits: data at which a user counts as collected, bit.

    Returns:
        `data_bits` and `collected` after the step. Data is never taken back, and a collected user
        stays collected for this mission.
    """
    data_bits = data_bits + rate_bps * step_s * served
    return data_bits, collected | (data_bits >= r_min_bits)


def sum_rate(served: Array, rate_bps: Array) -> Array:
    """Sum of the rates of the served users, bit/s, `[...]`."""
    return (rate_bps * served).sum(axis=-1)


def at_dock(cell: Array, dock_cell: tuple[int, int]) -> Array:
    """Is the UAV over the dock? X_target is the column of cells above it, bool `[...]`.

    The paper measures the way to the destination horizontally, and calls X_target a set.
    """
    east, north = dock_cell
    return (cell[..., 0] == east) & (cell[..., 1] == north)


def dock_distance_cells(cell: Array, dock_cell: tuple[int, int], like: Array) -> Array:
    """Horizontal distance to the dock, in cells, `[...]`, with the dtype of `like`."""
    xp = array_namespace(cell)
    east, north = dock_cell
    dx, dy = xp.astype(cell[..., 0] - east, like.dtype), xp.astype(cell[..., 1] - north, like.dtype)
    return xp.sqrt(dx * dx + dy * dy)
