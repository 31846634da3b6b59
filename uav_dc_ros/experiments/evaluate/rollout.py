"""Missions flown side by side, one per seed, in numpy: the judge of every policy.

Seed s draws from `numpy.random.default_rng(s)`: `(U, 2)` numbers for the start, then `(U, 2)` for each
step. The environment and the ROS nodes do the same, so seed s is the same mission everywhere.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from uav_dc_ros.core import mission, world
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.reward import Rewards
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.core.world import select

# Greedy or not: from the state of the missions, `[..., S]`, an action for each, integers `[..., S]`.
Act = Callable[[world.State], Array]


@dataclass(frozen=True, kw_only=True)
class Missions:
    """How missions went, one entry per seed, each `[..., S]`.

    Attributes:
        users_collected: users collected.
        landed: the mission ended over the dock.
        steps: steps flown.
        arrival_step: step after which the UAV stayed over the dock; NaN when it did not land.
        sum_rate_bps: sum-rate of the served users, mean over the steps, bit/s.
        data_bits: data collected from all users, bit.
        reward: r^t at the end (eq. 7).
        episode_return: sum of what the agent was paid, undiscounted.
    """

    users_collected: Array
    landed: Array
    steps: Array
    arrival_step: Array
    sum_rate_bps: Array
    data_bits: Array
    reward: Array
    episode_return: Array


def flight(
    scenario: Scenario,
    act: Act,
    seeds: Sequence[int],
    layouts: Sequence[Array | None] | None = None,
    rewards: Rewards | None = None,
) -> Iterator[tuple[world.State, world.Outcome | None]]:
    """The missions step by step: first their start, without an outcome, then every step.

    Args:
        scenario: the world's values.
        act: who steers.
        seeds: the S missions.
        layouts: when several runs fly all S missions each, `[R, S]`: for each the draws for where
            users start, `[U, 2]`, or None for the seed's own.
        rewards: how each run is paid, `[R, 1]`; as the scenario says unless told.
    """
    runs = () if layouts is None else (len(layouts),)
    rngs = [np.random.default_rng(seed) for seed in seeds]

    def draws() -> Array:
        one = np.stack([rng.random((scenario.n_users, 2)) for rng in rngs])
        return np.broadcast_to(one, (*runs, *one.shape))

    start = draws().copy()
    for run, own in enumerate(layouts or ()):
        if own is not None:
            start[run] = own
    state = world.initial(scenario, start)
    yield state, None
    for _ in range(scenario.mission.max_steps):
        state, outcome = world.step(scenario, state, act(state), draws(), rewards)
        yield state, outcome


def roll_out(
    scenario: Scenario,
    act: Act,
    seeds: Sequence[int],
    layouts: Sequence[Array | None] | None = None,
    rewards: Rewards | None = None,
) -> Missions:
    """Flies every mission to its end; arguments as in `flight`, results `[S]` or `[R, S]`."""
    steps = flight(scenario, act, seeds, layouts, rewards)
    final, _ = next(steps)
    over = final.step < 0
    landed, arrival = over, np.full(over.shape, np.nan)
    rate_sum, paid = np.zeros(over.shape), np.zeros(over.shape)
    for state, outcome in steps:
        assert outcome is not None, "every step but the start has one"
        final = select(over, final, state)
        docked = mission.at_dock(final.cell, scenario.dock_cell)
        arrival = np.where(docked, np.where(np.isnan(arrival), final.step, arrival), np.nan)
        rate_sum += np.where(over, 0.0, outcome.link.sum_rate_bps)
        paid += np.where(over, 0.0, outcome.reward)
        landed = landed | (outcome.landed & ~over)
        over = over | outcome.terminated | outcome.truncated
        if over.all():
            break
    return Missions(
        users_collected=np.sum(final.collected, axis=-1),
        landed=landed,
        steps=final.step,
        arrival_step=np.where(landed, arrival, np.nan),
        sum_rate_bps=rate_sum / final.step,
        data_bits=np.sum(final.data_bits, axis=-1),
        reward=final.total_reward,
        episode_return=paid,
    )
