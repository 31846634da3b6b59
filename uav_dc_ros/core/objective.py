"""The objective J of a mission: a number in [0, 1] by which policies, planners and bounds are compared.

    J = w users / U + (1 - w) (1 - arrival / T_cons)    for a mission that lands, and 0 for any other

`users` are those collected, of U; `arrival` is the step at which the UAV arrives over the dock to stay. The
weight w is chosen when a policy flies: 1 counts the users only, 0 the time only.

The paper has no such number. Its trade-off game (eq. 7) adds what is collected and how the UAV comes home;
J has the same two terms, each as a share of the best possible. The second term is never negative: with
`- (1 - w) arrival / T_cons`, a late landing with few users would be worth less than none at all.
"""

from uav_dc_ros.core.arrays import Array, array_namespace
from uav_dc_ros.errors import UavDcError

# All users weigh ten times as much as all the time: a hundredth of the users as much as a tenth of the time.
DEFAULT_WEIGHT = 10 / 11
EXPECTED_WEIGHT = "a weight between 0 (time only) and 1 (users only)"


def objective(
    users_collected: Array,
    arrival_step: Array,
    landed: Array,
    *,
    n_users: int,
    max_steps: int,
    weight: float = DEFAULT_WEIGHT,
) -> Array:
    """J of missions, float `[...]`.

    `users_collected` and `arrival_step` are numbers `[...]`; the latter may be NaN, or anything, where
    `landed` (bool `[...]`) is false. `weight` is w; see `check_weight`.
    """
    xp = array_namespace(landed)
    value = weight * (users_collected / n_users) + (1.0 - weight) * (1.0 - arrival_step / max_steps)
    return xp.where(landed, value, xp.zeros_like(value))


def check_weight(weight: float, name: str) -> float:
    """A weight w between 0 and 1; `name` is that of the option or parameter in errors.

    Raises:
        UavDcError: it is no such number.
    """
    if not 0.0 <= weight <= 1.0:  # also NaN
        raise UavDcError(f"{name} {weight:g}; expected {EXPECTED_WEIGHT}")
    return weight
