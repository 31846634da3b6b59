"""What a flown mission brought, in numbers."""

import msgspec

from uav_dc_ros.messages import Phase


class Summary(msgspec.Struct, frozen=True, kw_only=True):
    """One mission, as `--summary` writes it and `fly` returns it.

    Attributes:
        scenario, policy: names.
        seed: seed of the mission's users.
        outcome: `landed`, `timeout` or `aborted`.
        steps: steps flown.
        steps_not_reached: of them, those whose cell a real vehicle did not reach.
        users_collected, users_total: users.
        data_bits: data collected from all users, bit.
        sum_rate_bps: sum of the served users' rates, mean over the steps, bit/s.
        distance_m: length of the path flown, metres.
        reward: r^t at the end (eq. 7), as `evaluate` and the policies' cards have it.
        reason: how a real vehicle came to its end, or why a mission was aborted, in words; else empty.
        bag: folder of the bag, or null.
    """

    scenario: str
    policy: str
    seed: int
    outcome: Phase
    steps: int
    steps_not_reached: int
    users_collected: int
    users_total: int
    data_bits: float
    sum_rate_bps: float
    distance_m: float
    reward: float
    reason: str
    bag: str | None
