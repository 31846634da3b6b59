"""Evaluation of policies over many missions. Needs numpy only, but for the picture."""

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from uav_dc_ros import __version__
from uav_dc_ros.agents.policy import Policy
from uav_dc_ros.core import world
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.env.batch import observe
from uav_dc_ros.errors import UavDcError
from uav_dc_ros.experiments.fly import Act, Missions, flight, fly

# The missions on every card: seeds 0 to 99. Nothing is tuned or chosen on them.
TEST_SEEDS = range(100)


class Figure(msgspec.Struct, frozen=True, kw_only=True):
    """One quantity over missions: mean, least and greatest; null where no mission has it."""

    mean: float | None
    min: float | None
    max: float | None


class Evaluation(msgspec.Struct, frozen=True, kw_only=True):
    """How a policy does in a scenario.

    Attributes:
        policy, sha256: which policy, and the hash of its config and model; none for a planner.
        scenario, fingerprint: which world, and the hash of its values.
        version: of the package that flew.
        seeds: first seed and number of seeds.
        users_total: users in the field.
        landing_rate: share of missions that landed.
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
    landing_rate: float
    users_collected: Figure
    steps: Figure
    arrival_step: Figure
    sum_rate_bps: Figure
    data_bits: Figure
    reward: Figure
    episode_return: Figure


def steer(policy: Policy, scenario: Scenario) -> Act:
    """The policy as whoever steers missions in `scenario`.

    Raises:
        PolicyError: it does not fit the scenario.
    """
    policy.check(scenario)
    return lambda state: policy.act(observe(policy.config.observation, scenario, state))


def evaluate(policy: Policy, scenario: Scenario, seeds: Sequence[int] = TEST_SEEDS) -> Evaluation:
    """Flies one mission per seed, greedily; raises PolicyError when the policy does not fit."""
    return judge(policy.name, policy.sha256, steer(policy, scenario), scenario, seeds)


def judge(name: str, sha256: str | None, act: Act, scenario: Scenario, seeds: Sequence[int]) -> Evaluation:
    """Flies one mission per seed with whoever steers by `act`."""
    missions = fly(scenario, act, seeds)
    figures = {f.name: _figure(getattr(missions, f.name)) for f in fields(Missions) if f.name != "landed"}
    return Evaluation(
        policy=name,
        sha256=sha256,
        scenario=scenario.name,
        fingerprint=scenario.fingerprint,
        version=__version__,
        seeds=(seeds[0], len(seeds)),
        users_total=scenario.n_users,
        landing_rate=float(np.mean(missions.landed)),
        **figures,
    )


def _figure(values: np.ndarray) -> Figure:
    known = values[np.isfinite(values)]
    if not known.size:
        return Figure(mean=None, min=None, max=None)
    return Figure(mean=float(known.mean()), min=float(known.min()), max=float(known.max()))


# Title, attribute, what to divide by, decimals: the rows of every table of an evaluation.
_ROWS = (
    ("users collected", "users_collected", 1.0, 1),
    ("steps", "steps", 1.0, 1),
    ("arrival step", "arrival_step", 1.0, 1),
    ("sum-rate, Mbit/s", "sum_rate_bps", 1e6, 3),
    ("data, Mbit", "data_bits", 1e6, 1),
    ("reward r^t at the end", "reward", 1.0, 3),
    ("return", "episode_return", 1.0, 3),
)


def rows(evaluation: Evaluation) -> list[tuple[str, str, str, str]]:
    """Title, mean, least and greatest of every figure, as text."""
    table = [("landing rate", f"{evaluation.landing_rate:.2f}", "", "")]
    for title, attribute, unit, decimals in _ROWS:
        figure = getattr(evaluation, attribute)
        cells = [
            "-" if value is None else f"{value / unit:.{decimals}f}"
            for value in (figure.mean, figure.min, figure.max)
        ]
        table.append((title, cells[0], cells[1], cells[2]))
    return table


def save_mission_picture(act: Act, scenario: Scenario, seed: int, path: Path) -> None:
    """Flies the mission with this seed, and writes its picture.

    Raises:
        UavDcError: matplotlib is not installed, or the picture cannot be written.
    """
    try:
        from uav_dc_ros.env.render import Track, save_picture  # slow to import, and not always there
    except ModuleNotFoundError:
        raise UavDcError(
            'matplotlib is not installed; expected it from: pip install "uav_dc_ros[train]"'
        ) from None

    def first(batch: Any) -> Any:
        return type(batch)(**{f.name: getattr(batch, f.name)[0] for f in fields(batch)})

    track = Track(scenario)
    for state, outcome in flight(scenario, act, [seed]):
        link: world.Link | None = first(outcome.link) if outcome else None
        track.add(first(state), link)
        if outcome and (outcome.terminated | outcome.truncated)[0]:
            break
    try:
        save_picture(track, path)
    except (OSError, ValueError) as error:
        raise UavDcError(f"{path} cannot be written: {error}") from None
