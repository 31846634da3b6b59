"""Missions flown side by side to their end, one per seed, in numpy: the evaluation of every policy."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from uav_dc_ros.core import energy, mission, world
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.objective import DEFAULT_WEIGHT, objective
from uav_dc_ros.core.reward import Rewards
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.core.users.service import ServiceRecord
from uav_dc_ros.core.world import Act, Layouts, State, rollout_steps
from uav_dc_ros.env.trajectory import Trajectory


@dataclass(frozen=True, kw_only=True)
class Missions:
    """Results of missions, one entry per seed, each `[..., S]`."""

    users_collected: Array
    landed: Array  # whether the mission ended over the dock
    steps: Array  # flown
    arrival_step: Array  # step after which the UAV stayed over the dock; NaN when it did not land
    sum_rate_bps: Array  # of the served users, mean over the steps
    data_bits: Array  # collected from all users
    reward: Array  # of the mission, see `core.reward.mission_reward`
    episode_return: Array  # undiscounted sum of the agent's rewards
    # How users were served, see `core.users.service`; None in a rollout without it
    mean_age_s: Array | None = None
    fairness: Array | None = None
    last_collected_step: Array | None = None
    # Energy used, joules, and for each Mbit collected (NaN where none was); None without a battery
    energy_used_j: Array | None = None
    energy_per_mbit_j: Array | None = None

    def objective(self, scenario: Scenario, weight: float = DEFAULT_WEIGHT) -> Array:
        """J of each mission, see `core.objective`."""
        return objective(
            self.users_collected,
            self.arrival_step,
            self.landed,
            n_users=scenario.n_users,
            max_steps=scenario.mission.max_steps,
            weight=weight,
        )


def roll_out(
    scenario: Scenario,
    act: Act,
    seeds: Sequence[int],
    layouts: Layouts = (),
    rewards: Rewards | None = None,
    transmitting: Array | None = None,
    *,
    service: bool = True,
) -> Missions:
    """Fly every mission to its end; arguments as in `rollout_steps`, results `[S]` or `[R, S]`.

    Without `service` the result lacks how users were served.
    """
    return roll_out_to_end(scenario, act, seeds, layouts, rewards, transmitting, service=service)[0]


def roll_out_to_end(
    scenario: Scenario,
    act: Act,
    seeds: Sequence[int],
    layouts: Layouts = (),
    rewards: Rewards | None = None,
    transmitting: Array | None = None,
    *,
    service: bool = True,
) -> tuple[Missions, State]:
    """As `roll_out`, and the state at the end of each mission."""
    steps = rollout_steps(scenario, act, seeds, layouts, rewards, transmitting)
    final, _ = next(steps)
    over = final.step < 0
    landed, arrival = over, np.full(over.shape, np.nan)
    rate_sum, episode_return = np.zeros(over.shape), np.zeros(over.shape)
    record = ServiceRecord(np.zeros(final.data_bits.shape)) if service else None
    for state, outcome in steps:
        assert outcome is not None, "every step but the start has one"
        final = world.select(over, final, state)
        docked = mission.at_dock(final.cell, scenario.dock_cell)
        arrival = np.where(docked, np.where(np.isnan(arrival), final.step, arrival), np.nan)
        rate_sum += np.where(over, 0.0, outcome.link.sum_rate_bps)
        episode_return += np.where(over, 0.0, outcome.reward)
        if record is not None:
            record.add(state.step, outcome.link.served, state.collected, over)
        landed = landed | (outcome.landed & ~over)
        over = over | outcome.terminated | outcome.truncated
        if over.all():
            break
    data_bits = np.sum(final.data_bits, axis=-1)
    battery = {}
    if scenario.energy is not None:
        per_mbit_j = energy.per_mbit_j(final.energy_used_j, data_bits)
        battery = {"energy_used_j": final.energy_used_j, "energy_per_mbit_j": per_mbit_j}
    missions = Missions(
        users_collected=np.sum(final.collected, axis=-1),
        landed=landed,
        steps=final.step,
        arrival_step=np.where(landed, arrival, np.nan),
        sum_rate_bps=rate_sum / final.step,
        data_bits=data_bits,
        reward=final.mission_reward,
        episode_return=episode_return,
        **({} if record is None else record.figures(scenario, final.data_bits)),
        **battery,
    )
    return missions, final


def roll_out_trajectory(scenario: Scenario, act: Act, seed: int, layout: Array | None = None) -> Trajectory:
    """Fly the mission of a seed, step by step; `layout` as one of `rollout_steps`, `[U, D]`."""

    def unbatched(batch: Any) -> Any:
        return type(batch)(**{f.name: getattr(batch, f.name)[0, 0] for f in fields(batch)})

    trajectory = Trajectory(scenario)
    for state, outcome in rollout_steps(scenario, act, [seed], layouts=[layout]):
        trajectory.add(unbatched(state), unbatched(outcome.link) if outcome else None)
        if outcome and (outcome.terminated | outcome.truncated).all():
            break
    return trajectory
