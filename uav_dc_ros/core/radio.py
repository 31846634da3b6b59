"""The uplink: distance, path gain, SINR and rate. Equation numbers are those of the paper.

`mission` decides which users are served.
"""

import math
from functools import cache
from typing import Any, Literal, TypeAlias, get_args

from uav_dc_ros.core.arrays import Array, array_namespace, constant

Interference: TypeAlias = Literal["all", "associated", "none"]


def distance(uav_m: Array, users_m: Array) -> Array:
    """3D distance `[..., U]` (eq. 1) between the UAV `[..., 3]` and users on the ground `[..., U, 2]`.

    Integers become float64.
    """
    xp = array_namespace(uav_m, users_m)
    uav_m, users_m = _floating(xp, uav_m), _floating(xp, users_m)
    dx = uav_m[..., 0:1] - users_m[..., 0]
    dy = uav_m[..., 1:2] - users_m[..., 1]
    dz = uav_m[..., 2:3]
    return xp.sqrt(dx * dx + dy * dy + dz * dz)


def ground_distance(uav_m: Array, users_m: Array) -> Array:
    """Horizontal distance `[..., U]`; arguments as in `distance`."""
    xp = array_namespace(uav_m, users_m)
    uav_m, users_m = _floating(xp, uav_m), _floating(xp, users_m)
    dx = uav_m[..., 0:1] - users_m[..., 0]
    dy = uav_m[..., 1:2] - users_m[..., 1]
    return xp.sqrt(dx * dx + dy * dy)


def ground_reach_m(distance_m: float, altitude_m: float) -> float:
    """Radius of the circle on the ground within a 3D distance of the UAV (eq. 1), metres; 0: out of range."""
    return math.sqrt(max(distance_m * distance_m - altitude_m * altitude_m, 0.0))


def path_gain(distance_m: Array, ref_gain: float, exponent: float = 2.0) -> Array:
    """Channel power gain of a line-of-sight link, `beta_0 d^-exponent` (eq. 2), linear.

    `ref_gain` is beta_0, the linear gain at 1 m; the exponent of the paper's free space is 2.
    """
    return ref_gain / distance_m**exponent


def sinr(
    gain: Array,
    power_w: float | Array,
    noise_w: float,
    interference: Interference = "all",
    served: Array | None = None,
) -> Array:
    """Signal over interference and noise of every user at the UAV (part of eq. 3), linear, `[..., U]`.

    Args:
        gain: channel power gain, linear, `[..., U]`.
        power_w: transmit power, a number or `[..., U]`.
        noise_w: noise power.
        interference: transmitting users. `all`: every user, at every step (the paper's equation as
            written). `associated`: only the users in `served`; the others have SINR 0. `none`: orthogonal
            channels, noise only.
        served: associated users, bool `[..., U]`; needed for `associated` only.

    Raises:
        ValueError: unknown `interference`, or `associated` without `served`.
    """
    received_w = power_w * gain
    if interference == "none":
        return received_w / noise_w
    if interference == "associated":
        if served is None:
            raise ValueError("interference='associated' needs `served`, bool [..., U]; got None")
        received_w = array_namespace(gain).where(served, received_w, 0.0)
    elif interference != "all":
        raise ValueError(
            f"interference is {interference!r}; expected one of {', '.join(get_args(Interference))}"
        )
    return received_w / (_sum_of_others(received_w) + noise_w)


def rate_bps(sinr: Array, bandwidth_hz: float) -> Array:
    """Achievable rate `B log2(1 + SINR)`, bit/s (eq. 3), of a linear SINR of any shape."""
    # log1p keeps the digits that 1 + sinr drops for a user far below the noise.
    return (bandwidth_hz / math.log(2.0)) * array_namespace(sinr).log1p(sinr)


def _floating(xp: Any, values: Array) -> Array:
    """Integers as float64: torch takes their square root in float32."""
    return values if _is_real(xp, values.dtype) else xp.astype(values, xp.float64)


@cache
def _is_real(xp: Any, dtype: Any) -> bool:
    return bool(xp.isdtype(dtype, "real floating"))


def _sum_of_others(received_w: Array) -> Array:
    """For each user, the sum over every other one, `[..., U]`.

    It is the sum of all but the strongest user, plus the difference of the strongest and this user. The total
    less the user's own share loses half of its digits beside a user ten thousand times stronger.
    """
    xp = array_namespace(received_w)
    strongest = received_w.argmax(axis=-1, keepdims=True)
    weaker_w = received_w * (constant(range(received_w.shape[-1]), strongest) != strongest)
    return weaker_w.sum(axis=-1, keepdims=True) + (xp.max(received_w, axis=-1, keepdims=True) - received_w)
