"""Evaluation of policies over many missions. Needs numpy only, but for the picture."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from uav_dc_ros import __version__
from uav_dc_ros.agents.policy import Policy
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.core.stats import interval
from uav_dc_ros.core.world import observe
from uav_dc_ros.errors import UavDcError
from uav_dc_ros.experiments.evaluate.rollout import Act, Missions, roll_out

# The missions on every card: seeds 0 to 99. Nothing is tuned or chosen on them.
TEST_SEEDS = range(100)


class Figure(msgspec.Struct, frozen=True, kw_only=True):
    """One quantity over missions; null where it cannot be known.

    Attributes:
        n: missions that have it.
        mean: over these missions.
        low, high: ends of the 95% bootstrap interval of the mean; of two missions or more. Where all
            missions are alike it has no width: after 100 landings of 100 it says nothing of the odds of
            a rare failure.
        min, max: least and greatest.
    """

    n: int
    mean: float | None = None
    low: float | None = None
    high: float | None = None
    min: float | None = None
    max: float | None = None


class Evaluation(msgspec.Struct, frozen=True, kw_only=True):
    """How a policy does in a scenario.

    Attributes:
        policy, sha256: which policy, and the hash of its config and model; none for a planner.
        scenario, fingerprint: which world, and the hash of its values.
        version: of the package that flew.
        seeds: first seed and number of seeds.
        users_total: users in the field.
        landing_rate: 1 for a mission that landed, else 0.
        users_collected, steps: counts per mission.
        arrival_step: step after which the UAV stayed over the dock; missions that landed only.
        sum_rate_bps: mean over the steps of a mission, bit/s.
        data_bits: data collected in a mission, bit.
        reward: r^t at the end of a mission (eq. 7), with the weights of this scenario.
        episode_return: undiscounted sum of what the agent was paid.
    """

    policy: str
    sha256: str | None
    scenario: str
    fingerprint: str
    version: str
    seeds: tuple[int, int]
    users_total: int
    landing_rate: Figure
    users_collected: Figure
    steps: Figure
    arrival_step: Figure
    sum_rate_bps: Figure
    data_bits: Figure
    reward: Figure
    episode_return: Figure


class Comparison(msgspec.Struct, frozen=True, kw_only=True):
    """Two policies in the same missions, mission by mission.

    Attributes:
        policy, baseline: who is compared with whom.
        scenario, fingerprint, seeds: as in `Evaluation`.
        differences: `policy` less `baseline`, by the name of the figure in `Evaluation`, over the
            missions in which both have it.
    """

    policy: str
    baseline: str
    scenario: str
    fingerprint: str
    seeds: tuple[int, int]
    differences: dict[str, Figure]


class EvaluationReport(msgspec.Struct, frozen=True, kw_only=True):
    """What `python -m uav_dc_ros.evaluate --json` writes.

    Attributes:
        evaluations: one for each policy in each scenario.
        comparisons: in each scenario, every further policy against the first.
    """

    evaluations: list[Evaluation]
    comparisons: list[Comparison]


@dataclass(frozen=True, kw_only=True)
class EvaluatedMissions:
    """An evaluation, and each of its figures mission by mission: `[S]`, NaN where a mission has none."""

    evaluation: Evaluation
    values: dict[str, Array]


def steer(policy: Policy, scenario: Scenario) -> Act:
    """The policy as whoever steers missions in `scenario`.

    Raises:
        PolicyError: it does not fit the scenario.
    """
    policy.check(scenario)
    return lambda state: policy.act(observe(policy.config.observation, scenario, state))


def evaluate(policy: Policy, scenario: Scenario, seeds: Sequence[int] = TEST_SEEDS) -> Evaluation:
    """Flies one mission per seed, greedily; raises PolicyError when the policy does not fit."""
    return judge(policy.name, policy.sha256, steer(policy, scenario), scenario, seeds).evaluation


def judge(
    name: str, sha256: str | None, act: Act, scenario: Scenario, seeds: Sequence[int]
) -> EvaluatedMissions:
    """Flies one mission per seed with whoever steers by `act`."""
    missions = roll_out(scenario, act, seeds)
    values = {f.name: np.asarray(getattr(missions, f.name), np.float64) for f in fields(Missions)}
    values["landing_rate"] = values.pop("landed")
    evaluation = Evaluation(
        policy=name,
        sha256=sha256,
        scenario=scenario.name,
        fingerprint=scenario.fingerprint,
        version=__version__,
        seeds=(seeds[0], len(seeds)),
        users_total=scenario.n_users,
        **{figure: _figure(of_missions) for figure, of_missions in values.items()},
    )
    return EvaluatedMissions(evaluation=evaluation, values=values)


def compare(flown: EvaluatedMissions, baseline: EvaluatedMissions) -> Comparison:
    """`flown` less `baseline`, which has flown the same seeds in the same scenario."""
    mine, other = flown.evaluation, baseline.evaluation
    return Comparison(
        policy=mine.policy,
        baseline=other.policy,
        scenario=mine.scenario,
        fingerprint=mine.fingerprint,
        seeds=mine.seeds,
        differences={name: _figure(flown.values[name] - baseline.values[name]) for name in TITLES},
    )


def _figure(values: Array) -> Figure:
    known = values[np.isfinite(values)]
    if not known.size:
        return Figure(n=0)
    mean, low, high = interval(known) if known.size > 1 else (float(known[0]), None, None)
    return Figure(n=known.size, mean=mean, low=low, high=high, min=float(known.min()), max=float(known.max()))


# Of each figure: title, what to divide by, decimals.
_SHOWN = {
    "landing_rate": ("landing rate", 1.0, 2),
    "users_collected": ("users collected", 1.0, 1),
    "steps": ("steps", 1.0, 1),
    "arrival_step": ("arrival step", 1.0, 1),
    "sum_rate_bps": ("sum-rate, Mbit/s", 1e6, 3),
    "data_bits": ("data, Mbit", 1e6, 1),
    "reward": ("reward r^t at the end", 1.0, 3),
    "episode_return": ("return", 1.0, 3),
}
TITLES = {name: title for name, (title, _, _) in _SHOWN.items()}
COLUMNS = ("", "mean", "95% interval", "least", "greatest")


def rows(evaluation: Evaluation) -> list[tuple[str, ...]]:
    """What stands in the `COLUMNS` of every figure, as text."""
    table: list[tuple[str, ...]] = []
    for name, title in TITLES.items():
        figure: Figure = getattr(evaluation, name)
        # Of landings, which are 0 or 1, the least and the greatest say nothing.
        extremes = ("", "") if name == "landing_rate" else (_text(name, figure.min), _text(name, figure.max))
        table.append((title, *mean_and_interval(name, figure), *extremes))
    return table


def mean_and_interval(name: str, figure: Figure, sign: Literal["", "+"] = "") -> tuple[str, str]:
    """A figure's mean, and the ends of its interval, as text; with `+` also positive numbers have a sign."""
    low, high = _text(name, figure.low, sign), _text(name, figure.high, sign)
    return _text(name, figure.mean, sign), "-" if figure.low is None else f"{low} to {high}"


def _text(name: str, value: float | None, sign: str = "") -> str:
    _, unit, decimals = _SHOWN[name]
    return "-" if value is None else f"{value / unit:{sign}z.{decimals}f}"


def save_mission_picture(act: Act, scenario: Scenario, seed: int, path: Path) -> None:
    """Flies the mission with this seed, and writes its picture.

    Raises:
        UavDcError: matplotlib is not installed, or the picture cannot be written.
    """
    try:
        # Slow to import, and not always there.
        from uav_dc_ros.env.render import save_picture
        from uav_dc_ros.experiments.evaluate.trajectory import roll_out_trajectory
    except ModuleNotFoundError:
        raise UavDcError(
            'matplotlib is not installed; expected it from: pip install "uav_dc_ros[train]"'
        ) from None
    try:
        save_picture(roll_out_trajectory(scenario, act, seed), path)
    except (OSError, ValueError) as error:
        raise UavDcError(f"{path} cannot be written: {getattr(error, 'strerror', None) or error}") from None
