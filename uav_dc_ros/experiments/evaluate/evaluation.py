"""Evaluation of policies over many missions. Needs numpy only, except for the picture."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType

from uav_dc_ros import __version__
from uav_dc_ros.agents.agent import greedy_act
from uav_dc_ros.agents.policy import Policy
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.objective import DEFAULT_WEIGHT
from uav_dc_ros.core.reward import MISSION_REWARD, RewardData
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.core.stats import interval
from uav_dc_ros.core.world import Act
from uav_dc_ros.errors import FROM_TRAIN, UavDcError
from uav_dc_ros.experiments.evaluate.rollout import Missions, roll_out, roll_out_trajectory
from uav_dc_ros.experiments.evaluate.shifts import Shift, senders

# The missions on every policy card. Nothing is tuned or selected on them.
TEST_SEEDS = range(100)
ONE_MISSION = "nothing is drawn in this world, so every seed gives the same mission"


class Figure(msgspec.Struct, frozen=True, kw_only=True):
    """Statistics of one quantity over missions; null where unknown."""

    n: int  # missions that have the quantity
    mean: float | None = None  # over these missions
    # low, high: ends of the 95% bootstrap interval of the mean, for two missions or more; of fewer than 50
    # missions it may be wider than their range. It has no width where all missions are alike: 100 landings of
    # 100 do not exclude a rare failure.
    low: float | None = None
    high: float | None = None
    # min, max: extremes
    min: float | None = None
    max: float | None = None


class Evaluation(msgspec.Struct, frozen=True, kw_only=True):
    """The performance of a policy in a scenario."""

    # policy, sha256: name, and hash of config and model; no hash for a planner
    policy: str
    sha256: str | None
    # scenario, fingerprint: name, and hash of the world's values
    scenario: str
    fingerprint: str
    # Absent in the scenario as it is. `fingerprint` is that of the shifted world
    shift: Shift | UnsetType = UNSET
    version: str  # of the package
    seeds: tuple[int, int]  # first seed and number of seeds
    users_total: int  # users in the field
    objective: Figure  # J of a mission, see `core.objective`
    objective_weight: float  # w in J
    landing_rate: Figure  # 1 for a mission that landed, else 0
    # users_collected, steps: counts per mission
    users_collected: Figure
    steps: Figure
    arrival_step: Figure  # step after which the UAV stayed over the dock; missions that landed only
    sum_rate_bps: Figure  # mean over the steps of a mission, bit/s
    data_bits: Figure  # data collected in a mission, bit
    reward_data: RewardData  # data in r^t (eq. 7) in this scenario
    # Of a mission, with the weights of this scenario: r^t at its end with the data `so_far`, the mean of r^t
    # over its steps with the data of the `step`
    reward: Figure
    episode_return: Figure  # undiscounted sum of the agent's rewards
    # How users were served, see `core.users.service`: age of information, seconds; Jain's index of the data;
    # step in which the last of the collected users was collected
    mean_age_s: Figure
    fairness: Figure
    last_collected_step: Figure
    # Energy used in a mission, joules, and for each Mbit collected; absent in a scenario without a battery
    energy_used_j: Figure | UnsetType = UNSET
    energy_per_mbit_j: Figure | UnsetType = UNSET


class Comparison(msgspec.Struct, frozen=True, kw_only=True):
    """Two policies in the same missions, mission by mission."""

    # policy, baseline: names
    policy: str
    baseline: str
    # scenario, fingerprint, seeds: as in `Evaluation`
    scenario: str
    fingerprint: str
    shift: str | UnsetType = UNSET  # text of the shift of both; absent without one
    seeds: tuple[int, int]
    # `policy` minus `baseline`, by the name of the figure in `Evaluation`, over the missions in which both
    # have it
    differences: dict[str, Figure]


class ShiftEffect(msgspec.Struct, frozen=True, kw_only=True):
    """A policy in a shifted world and in the scenario as it is, mission by mission."""

    # policy, scenario: names
    policy: str
    scenario: str
    shift: str  # text of the shift
    seeds: tuple[int, int]  # as in `Evaluation`
    # Shifted minus unshifted, by the name of the figure in `Evaluation`, over the missions in which both
    # have it
    differences: dict[str, Figure]


class EvaluationReport(msgspec.Struct, frozen=True, kw_only=True):
    """The content of a file of `python -m uav_dc_ros.evaluate --json`."""

    # One for each policy in each scenario; with shifts, first as it is and then in each shifted world
    evaluations: list[Evaluation]
    comparisons: list[Comparison]  # in each world, every further policy with the first
    shifts: list[ShiftEffect] | UnsetType = UNSET  # one for each evaluation with a shift; absent without one


@dataclass(frozen=True, kw_only=True)
class EvaluatedMissions:
    """An evaluation, and the values of each figure by mission: `[S]`, NaN where a mission has none."""

    evaluation: Evaluation
    values: dict[str, Array]


def card_seeds(scenario: Scenario) -> range:
    """The missions on the card of a policy for a scenario: one where nothing is drawn."""
    return TEST_SEEDS if scenario.is_random else TEST_SEEDS[:1]


def evaluate(policy: Policy, scenario: Scenario, seeds: Sequence[int] = TEST_SEEDS) -> Evaluation:
    """Fly one mission per seed with greedy actions; raises PolicyError when the policy does not fit."""
    return evaluate_act(policy.name, policy.sha256, greedy_act(policy, scenario), scenario, seeds).evaluation


def evaluate_act(
    name: str,
    sha256: str | None,
    act: Act,
    scenario: Scenario,
    seeds: Sequence[int],
    shift: Shift | UnsetType = UNSET,
    weight: float = DEFAULT_WEIGHT,
) -> EvaluatedMissions:
    """Fly one mission per seed with the actions of a policy or a planner.

    `shift` is that of the scenario, and `weight` that of the objective.
    """
    missions = roll_out(scenario, act, seeds, transmitting=senders(scenario, seeds, shift))
    of_missions = {f.name: getattr(missions, f.name) for f in fields(Missions)}
    values = {name: np.asarray(v, np.float64) for name, v in of_missions.items() if v is not None}
    values["landing_rate"] = values.pop("landed")
    values["objective"] = missions.objective(scenario, weight)
    evaluation = Evaluation(
        policy=name,
        sha256=sha256,
        scenario=scenario.name,
        fingerprint=scenario.fingerprint,
        shift=shift,
        version=__version__,
        seeds=(seeds[0], len(seeds)),
        users_total=scenario.n_users,
        objective_weight=weight,
        reward_data=scenario.reward.data,
        **{name: figure(each, _RANGES.get(name)) for name, each in values.items()},
    )
    return EvaluatedMissions(evaluation=evaluation, values=values)


def compare(evaluated: EvaluatedMissions, baseline: EvaluatedMissions) -> Comparison:
    """`evaluated` minus `baseline`, of the same seeds in the same world."""
    evaluation = evaluated.evaluation
    return Comparison(
        policy=evaluation.policy,
        baseline=baseline.evaluation.policy,
        scenario=evaluation.scenario,
        fingerprint=evaluation.fingerprint,
        shift=UNSET if evaluation.shift is UNSET else evaluation.shift.text,
        seeds=evaluation.seeds,
        differences=_differences(evaluated, baseline),
    )


def shift_effect(shifted: EvaluatedMissions, unshifted: EvaluatedMissions) -> ShiftEffect:
    """`shifted` minus `unshifted`, of the same policy and seeds in the same scenario."""
    evaluation = shifted.evaluation
    assert evaluation.shift is not UNSET, "the first argument is the shifted one"
    return ShiftEffect(
        policy=evaluation.policy,
        scenario=evaluation.scenario,
        shift=evaluation.shift.text,
        seeds=evaluation.seeds,
        differences=_differences(shifted, unshifted),
    )


def _differences(evaluated: EvaluatedMissions, baseline: EvaluatedMissions) -> dict[str, Figure]:
    pairs = {
        name: (evaluated.values[name], baseline.values[name]) for name in TITLES if name in evaluated.values
    }
    return {name: figure(one - other) for name, (one, other) in pairs.items()}


_RANGES = dict.fromkeys(("objective", "landing_rate", "fairness"), (0.0, 1.0))  # intervals end there


def figure(values: Array, possible: tuple[float, float] | None = None) -> Figure:
    """Statistics of values `[n]`, of which NaN are left out; `possible`: the range of possible values."""
    known = values[np.isfinite(values)]
    if not known.size:
        return Figure(n=0)
    extremes = {"min": float(known.min()), "max": float(known.max())}
    if known.size == 1:
        return Figure(n=1, mean=float(known[0]), **extremes)
    found = interval(known)
    return Figure(n=known.size, **(found.within(*possible) if possible else found)._asdict(), **extremes)


# Of each figure: title, what to divide by, decimals.
_SHOWN = {
    "objective": ("objective J", 1.0, 3),  # with its weight behind it
    "landing_rate": ("landing rate", 1.0, 2),
    "users_collected": ("users collected", 1.0, 1),
    "steps": ("steps", 1.0, 1),
    "arrival_step": ("arrival step", 1.0, 1),
    "sum_rate_bps": ("sum-rate, Mbit/s", 1e6, 3),
    "data_bits": ("data, Mbit", 1e6, 1),
    "reward": ("reward", 1.0, 3),  # with the words of `MISSION_REWARD` behind it
    "episode_return": ("return", 1.0, 3),
    "mean_age_s": ("age of information, s", 1.0, 1),
    "fairness": ("fairness of data", 1.0, 3),
    "last_collected_step": ("last user collected at step", 1.0, 1),
    "energy_used_j": ("energy used, kJ", 1e3, 2),
    "energy_per_mbit_j": ("energy for data, J/Mbit", 1.0, 1),
}
TITLES = {name: title for name, (title, _, _) in _SHOWN.items()}
COLUMNS = ("", "mean", "95% interval", "min", "max")
OBJECTIVE_IN_WORDS = (
    "The objective J is w users / U + (1 - w) (1 - arrival / T_cons) of a mission that lands, else 0."
)


def rows(evaluation: Evaluation) -> list[tuple[str, ...]]:
    """The texts of `COLUMNS` for every figure."""
    table: list[tuple[str, ...]] = []
    for name, title in TITLES.items():
        figure: Figure | UnsetType = getattr(evaluation, name)
        if figure is UNSET:
            continue
        if name == "reward":
            title = f"{title} {MISSION_REWARD[evaluation.reward_data]}"
        elif name == "objective":
            title = f"{title}, w = {evaluation.objective_weight:.3g}"
        # Extremes of landings, which are 0 or 1, carry no information.
        extremes = ("", "") if name == "landing_rate" else (_text(name, figure.min), _text(name, figure.max))
        table.append((title, *mean_and_interval(name, figure), *extremes))
    return table


def mean_and_interval(name: str, figure: Figure, sign: Literal["", "+"] = "") -> tuple[str, str]:
    """A figure's mean and interval as text; with `+`, positive numbers have a sign."""
    low, high = _text(name, figure.low, sign), _text(name, figure.high, sign)
    return _text(name, figure.mean, sign), "-" if figure.low is None else f"{low} to {high}"


def _text(name: str, value: float | None, sign: str = "") -> str:
    _, unit, decimals = _SHOWN[name]
    return "-" if value is None else f"{value / unit:{sign}z.{decimals}f}"


def save_mission_picture(act: Act, scenario: Scenario, seed: int, path: Path) -> None:
    """Fly the mission of a seed and write its picture.

    Raises:
        UavDcError: matplotlib is not installed, or the picture cannot be written.
    """
    try:
        from uav_dc_ros.env.render import save_picture  # slow to import, and optional
    except ModuleNotFoundError:
        raise UavDcError(f"matplotlib {FROM_TRAIN}") from None
    try:
        save_picture(roll_out_trajectory(scenario, act, seed), path)
    except (OSError, ValueError) as error:
        raise UavDcError(f"{path} cannot be written: {getattr(error, 'strerror', None) or error}") from None
