"""The result of a flown mission."""

import msgspec
from msgspec import UNSET, UnsetType

from uav_dc_ros.core.reward import RewardData
from uav_dc_ros.messages import Phase


class Summary(msgspec.Struct, frozen=True, kw_only=True):
    """One mission, as in the file of `--summary` and returned by `fly`."""

    scenario: str  # its name
    policy: str  # its name
    seed: int  # of the mission's users
    outcome: Phase  # `landed`, `timeout` or `aborted`
    steps: int  # flown
    steps_not_reached: int  # flown steps whose cell a real vehicle did not reach
    users_collected: int
    users_total: int
    data_bits: float  # collected from all users, bit
    sum_rate_bps: float  # sum of the served users' rates, mean over the steps, bit/s
    distance_m: float  # length of the path, metres
    # Of the mission (eq. 7), as in `evaluate` and policy cards: with the data `so_far`, r^t at the end; with
    # the data of the `step`, the mean of r^t over the steps with rates.
    reward: float
    reward_data: RewardData  # data in r^t, `so_far` or `step`
    # How users were served, see `core.users.service`: age of information, seconds; Jain's index of the data;
    # step in which the last of the collected users was collected. Null where unknown
    mean_age_s: float | None
    fairness: float | None
    last_collected_step: int | None
    # Energy by the scenario's model, joules, and for each Mbit collected (null where none was); absent in a
    # scenario without a battery
    energy_used_j: float | UnsetType = UNSET
    energy_per_mbit_j: float | UnsetType | None = UNSET
    reason: str  # end of a real vehicle's mission, or cause of an abort, in words; else empty
    bag: str | None  # folder of the bag, or null
    bag_lacks: str | UnsetType = UNSET  # messages of the run that were not recorded; absent if none
