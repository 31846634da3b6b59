"""The result of a flown mission."""

import msgspec

from uav_dc_ros.core.reward import RewardData
from uav_dc_ros.messages import Phase


class Summary(msgspec.Struct, frozen=True, kw_only=True):
    """One mission, as in the file of `--summary` and returned by `fly`.

    Attributes:
        scenario, policy: names.
        seed: seed of the mission's users.
        outcome: `landed`, `timeout` or `aborted`.
        steps: steps flown.
        steps_not_reached: flown steps whose cell a real vehicle did not reach.
        data_bits: data collected from all users, bit.
        sum_rate_bps: sum of the served users' rates, mean over the steps, bit/s.
        distance_m: length of the path, metres.
        reward: of the mission (eq. 7), as in `evaluate` and policy cards: with the data `so_far`, r^t at the
            end; with the data of the `step`, the mean of r^t over the steps with rates.
        reward_data: data in r^t, `so_far` or `step`.
        reason: end of a real vehicle's mission, or cause of an abort, in words; else empty.
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
    reward_data: RewardData
    reason: str
    bag: str | None
