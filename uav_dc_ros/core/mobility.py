"""Where users start, and how they walk about."""

import math

from uav_dc_ros.core.arrays import Array, array_namespace


def scatter(centres_m: Array, radius_m: float, draws: Array) -> Array:
    """Users placed uniformly, by area, in the disc around their cluster's centre.

    Args:
        centres_m: centre of each user's cluster, metres, `[U, 2]`.
        radius_m: radius C of a cluster, metres.
        draws: uniform in [0, 1), `[..., U, 2]`.

    Returns:
        Positions x, y, metres, `[..., U, 2]`.
    """
    xp = array_namespace(draws)
    # The square root makes equal areas, not equal radii, equally likely.
    return centres_m + _polar(radius_m * xp.sqrt(draws[..., 0]), draws[..., 1])


def walk(users_m: Array, v_max_mps: float, step_s: float, draws: Array) -> Array:
    """One step of the random walk: a fresh direction, a speed uniform up to `v_max_mps`.

    Args:
        users_m: positions x, y, metres, `[..., U, 2]`.
        v_max_mps: greatest speed v, m/s.
        step_s: duration of a step, seconds.
        draws: uniform in [0, 1), `[..., U, 2]`.

    Returns:
        Positions after the step, metres, `[..., U, 2]`. Nothing confines the walk.
    """
    return users_m + _polar(v_max_mps * step_s * draws[..., 0], draws[..., 1])


def _polar(radius_m: Array, turn: Array) -> Array:
    """Radius `[...]` and angle in turns `[...]` as x, y, `[..., 2]`."""
    xp = array_namespace(radius_m)
    angle_rad = (2.0 * math.pi) * turn
    radius_m, angle_rad = radius_m[..., None], angle_rad[..., None]  # as `stack` does, at twice the cost
    return xp.concat([radius_m * xp.cos(angle_rad), radius_m * xp.sin(angle_rad)], axis=-1)
