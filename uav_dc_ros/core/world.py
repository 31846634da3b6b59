"""The whole world as a value and two functions: `initial` and `step`.

Within a step, in this order: the UAV moves, the users walk, then rates hold for the whole step and data is
collected. The ROS nodes compose the same functions, split over processes.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from typing import TypeAlias

import numpy as np

from uav_dc_ros.core import channel, energy, mission, mobility, observations, radio, reward
from uav_dc_ros.core.arrays import Array, array_namespace, constant
from uav_dc_ros.core.observations import Observation
from uav_dc_ros.core.propagation import stochastic
from uav_dc_ros.core.propagation.counter_random import seed_of
from uav_dc_ros.core.propagation.stochastic import Realization
from uav_dc_ros.core.reward import Rewards
from uav_dc_ros.core.scenario import Scenario


@dataclass(frozen=True, kw_only=True)
class Link:
    """The channel in one step. `U` is the number of users."""

    sinr: Array  # linear, `[..., U]`
    rate_bps: Array  # achievable rate of each user, bit/s, `[..., U]`
    served: Array  # P(m, k), bool `[..., U]`
    sum_rate_bps: Array  # sum of the rates of the served users, bit/s, `[...]`


@dataclass(frozen=True, kw_only=True)
class State:
    """A world between two steps."""

    step: Array  # steps flown, integers `[...]`
    cell: Array  # the UAV's cell, integers `[..., 3]`
    users_m: Array  # users' positions, metres, `[..., U, 2]`
    data_bits: Array  # data collected from each user, bit, `[..., U]`
    collected: Array  # bool `[..., U]`
    delivered_bits: Array  # data that each user delivered in the last step, bit, `[..., U]`; 0 at the start
    total_reward: Array  # r^t (eq. 7), `[...]`
    mission_reward: Array  # reward of the mission so far, see `reward.mission_reward`, `[...]`
    energy_used_j: Array  # energy of the steps flown, joules, `[...]`; 0 in a scenario without `energy`
    motion: Array  # what the users' mobility remembers, see `mobility.move`, `[..., U, 0 to 4]`
    waves: Array  # of the mission's shadowing, see `stochastic.waves`; without shadowing `[..., 1, 0]`


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """The result of a step, each `[...]`."""

    reward: Array  # the agent's reward
    terminated: Array  # the mission is over
    truncated: Array  # the mission was cut off (`on_arrival`: out of steps before the dock)
    landed: Array  # the mission is over and the UAV is over the dock
    link: Link  # the channel during the step


# An action (its value) for each world, integers `[...]`, from their state `[...]`.
Act: TypeAlias = Callable[[State], Array]
# Of each run: the draws of its users' start, `[U, D]`, or None for those of the mission's seed.
Layouts: TypeAlias = Sequence[Array | None]


def initial(scenario: Scenario, draws: Array) -> State:
    """The world before the first step, from uniform draws `[..., U, D]`, whose library and dtype it takes.

    U and D, 2 for the paper's users, are `scenario.draws_shape`.
    """
    xp = array_namespace(draws)
    zeros = xp.zeros_like(draws[..., 0])
    zero = xp.sum(zeros, axis=-1)
    step = xp.astype(zero, xp.int64)
    users_m, motion = mobility.begin(scenario, draws)
    shadowing, waves = scenario.radio.shadowing, zeros[..., None, :0]
    if shadowing is not None:
        waves = stochastic.waves(shadowing, seed_of(draws), zeros)
    return State(
        step=step,
        cell=step[..., None] + constant(scenario.start_cell, step),
        users_m=users_m,
        data_bits=zeros,
        collected=zeros > 0.0,
        delivered_bits=zeros,
        total_reward=zero,
        mission_reward=zero,
        energy_used_j=zero,
        motion=motion,
        waves=waves,
    )


def measure(
    scenario: Scenario,
    uav_m: Array,
    users_m: Array,
    collected: Array,
    transmitting: Array | None = None,
    drawn: Realization | None = None,
) -> Link:
    """The channel with the UAV at `uav_m` `[..., 3]` and the users at `users_m` `[..., U, 2]`, metres.

    `transmitting`: the users that send, bool `[..., U]`; None: all. `drawn`: by a channel that is random;
    without it, see `channel.path_gain`.
    """
    served, gain = reception(scenario, uav_m, users_m, collected, drawn)
    if transmitting is not None:
        served, gain = served & transmitting, gain * transmitting
    return link_over(scenario, served, gain)


def reception(
    scenario: Scenario, uav_m: Array, users_m: Array, collected: Array, drawn: Realization | None = None
) -> tuple[Array, Array]:
    """Who is served, bool, and the channel power gain, linear, `[..., U]`; arguments as in `measure`."""
    values = scenario.radio
    distance_m = radio.distance(uav_m, users_m)
    served = mission.served(distance_m, collected, scenario.mission.d_cons_m)
    cut = None if scenario.buildings is None else scenario.buildings.cut(uav_m, users_m)
    return served, channel.path_gain(values, uav_m, users_m, distance_m, drawn, cut)


def link_over(scenario: Scenario, served: Array, gain: Array) -> Link:
    """The channel of users of which some are served, bool, with their power gains, linear, `[..., U]`."""
    values = scenario.radio
    sinr = radio.sinr(gain, values.tx_power_w, values.noise_power_w, values.interference, served)
    rate_bps = radio.rate_bps(sinr, values.bandwidth_hz)
    return Link(sinr=sinr, rate_bps=rate_bps, served=served, sum_rate_bps=mission.sum_rate(served, rate_bps))


def collect(scenario: Scenario, link: Link, data_bits: Array, collected: Array) -> tuple[Array, Array]:
    """`data_bits` and `collected` after a step over `link`, `[..., U]`."""
    delivered_bits = mission.delivered(link.served, link.rate_bps, scenario.mission.step_s)
    return mission.collect(data_bits, collected, delivered_bits, scenario.user_r_min_bits(data_bits))


def counted_data(scenario: Scenario, served: Array, rate_bps: Array, data_bits: Array) -> Array:
    """R of each user in r^t (eq. 7), bit, of a step that ends with `data_bits`, all `[..., U]`."""
    delivered_bits = mission.delivered(served, rate_bps, scenario.mission.step_s)
    return reward.counted_data(delivered_bits, data_bits, scenario.reward.data)


def total_reward(
    scenario: Scenario, cell: Array, counted_bits: Array, rewards: Rewards | None = None
) -> Array:
    """r^t (eq. 7), `[...]`, of a UAV in `cell` `[..., 3]`; `counted_bits` is R of each user, `[..., U]`."""
    values = rewards or scenario.reward
    distance = mission.dock_distance_cells(cell, scenario.dock_cell, like=counted_bits)
    r_plus, weights = reward.r_plus(distance, values.r_plus), scenario.user_weights(counted_bits)
    return reward.total(counted_bits, r_plus, values.beta, values.zeta, values.data_scale_bits, weights)


def dock_distance_m(scenario: Scenario, cell: Array, like: Array) -> Array:
    """Horizontal distance from `cell` `[..., 3]` to the dock, metres, `[...]`, with the dtype of `like`."""
    return mission.dock_distance_cells(cell, scenario.dock_cell, like) * scenario.grid.cell_m


def energy_after(scenario: Scenario, before_j: Array, cell: Array, after: Array) -> Array:
    """Energy used after a step from a cell to the next, both `[..., 3]`, joules, `[...]`.

    `before_j` `[...]` is that before the step; it is also the result in a scenario without `energy`.
    """
    if scenario.energy is None:
        return before_j
    return before_j + energy.of_step(scenario.step_energies_j, cell, after, like=before_j)


def end_of_mission(
    scenario: Scenario, step: Array, cell: Array, energy_used_j: Array
) -> tuple[Array, Array, Array]:
    """Whether the mission has terminated, was truncated, and has landed, bool `[...]` each.

    Under `at_time_limit` the last step is a termination: the value of a state behind it is zero, not unknown.

    Where the battery may end a mission (`energy.ends`), the mission also terminates when the battery is
    spent: the rest does not last for the step that needs least or, over the dock, for a hover. A UAV has not
    landed if its battery was empty before the end of its last step.
    """
    docked = mission.at_dock(cell, scenario.dock_cell)
    out_of_steps = step >= scenario.mission.max_steps
    at_time_limit = scenario.mission.episode_end == "at_time_limit"
    if scenario.energy is None or scenario.energy.ends == "steps":
        if at_time_limit:
            return out_of_steps, out_of_steps & ~out_of_steps, out_of_steps & docked
        return docked, out_of_steps & ~docked, docked
    left_j = scenario.energy.battery_j - energy_used_j
    spent = (left_j < min(scenario.step_energies_j)) | (docked & (left_j < scenario.step_energies_j.hover))
    docked = docked & (left_j >= 0.0)
    if at_time_limit:
        over = out_of_steps | spent
        return over, over & ~over, over & docked
    return docked | spent, out_of_steps & ~docked & ~spent, docked


def step(
    scenario: Scenario,
    state: State,
    action: Array,
    draws: Array,
    rewards: Rewards | None = None,
    transmitting: Array | None = None,
) -> tuple[State, Outcome]:
    """The world after one step, and the step's outcome.

    `action` is the value of a `grid.Action`, integers `[...]`; `draws` are uniform in [0, 1), `[..., U, D]`;
    `rewards` are those of each world, `[...]`, by default the scenario's; `transmitting` is as in `measure`.
    """
    cell = move(scenario, state.cell, action)
    users_m, motion = mobility.move(scenario, state.users_m, state.motion, draws)
    uav_m = scenario.grid.centre_m(cell, like=users_m)
    drawn = Realization(state.waves, seed_of(draws)) if scenario.radio.is_random else None
    link = measure(scenario, uav_m, users_m, state.collected, transmitting, drawn)
    delivered_bits = mission.delivered(link.served, link.rate_bps, scenario.mission.step_s)
    r_min_bits = scenario.user_r_min_bits(delivered_bits)
    data_bits, collected = mission.collect(state.data_bits, state.collected, delivered_bits, r_min_bits)
    values = rewards or scenario.reward
    counted_bits = reward.counted_data(delivered_bits, data_bits, values.data)
    total = total_reward(scenario, cell, counted_bits, rewards)
    n_steps = state.step + 1
    n_rewards = array_namespace(total).astype(n_steps, total.dtype)
    used_j = energy_after(scenario, state.energy_used_j, state.cell, cell)
    terminated, truncated, landed = end_of_mission(scenario, n_steps, cell, used_j)
    after = State(
        step=n_steps,
        cell=cell,
        users_m=users_m,
        data_bits=data_bits,
        collected=collected,
        delivered_bits=delivered_bits,
        total_reward=total,
        mission_reward=reward.mission_reward(state.mission_reward, total, n_rewards, values.data),
        energy_used_j=used_j,
        motion=motion,
        waves=state.waves,
    )
    agent_reward = reward.step_reward(total, state.total_reward, values.form)
    return after, Outcome(
        reward=agent_reward, terminated=terminated, truncated=truncated, landed=landed, link=link
    )


def observe(
    kind: Observation, scenario: Scenario, state: State, weight: Array | float | None = None
) -> Array:
    """The observation of a state, float32 `[..., D]`; `weight` as in `observations.encode`."""
    return observations.encode(
        kind,
        scenario,
        cell=state.cell,
        step=state.step,
        data_bits=state.data_bits,
        collected=state.collected,
        delivered_bits=state.delivered_bits,
        energy_used_j=state.energy_used_j,
        weight=weight,
    )


def move(scenario: Scenario, cell: Array, action: Array) -> Array:
    """The cell `[..., 3]` after an `Action` (its value, `[...]`).

    A move off the grid or into an obstacle has no effect.
    """
    after = scenario.grid.move(cell, action)
    return after if scenario.moves is None else scenario.moves.apply(cell, action, after)


def action_mask(scenario: Scenario, cell: Array) -> Array | None:
    """The actions that have an effect in cells `[..., 3]`, and hover, bool `[..., 7]`; None: no obstacles."""
    return None if scenario.moves is None else scenario.moves.valid(cell)


def select(where: Array, chosen: State, other: State) -> State:
    """`chosen` in the worlds where `where` (bool `[...]`) holds, `other` elsewhere."""
    xp = array_namespace(where)

    def pick(a: Array, b: Array) -> Array:
        return xp.where(xp.reshape(where, (*where.shape, *(1,) * (a.ndim - where.ndim))), a, b)

    return State(**{f.name: pick(getattr(chosen, f.name), getattr(other, f.name)) for f in fields(State)})


def rollout_steps(
    scenario: Scenario,
    act: Act,
    seeds: Sequence[int],
    layouts: Layouts = (),
    rewards: Rewards | None = None,
    transmitting: Array | None = None,
) -> Iterator[tuple[State, Outcome | None]]:
    """The S missions of `seeds` step by step: first their start, without an outcome, then every step.

    Seed s draws from `numpy.random.default_rng(s)`: `(U, D)` numbers for the start, then `(U, D)` for each
    step, see `Scenario.draws_shape`. The environment and the ROS nodes do the same: seed s is the same
    mission everywhere.

    With the `layouts` of R runs, each run flies all missions: `[R, S]`, otherwise `[S]`. `rewards` are the
    reward settings of each run, `[R, 1]`; default: the scenario's. `transmitting`: the users that send in
    each mission, bool `[S, U]`; None: all.
    """
    runs = (len(layouts),) if layouts else ()
    rngs = [np.random.default_rng(seed) for seed in seeds]

    def draws() -> Array:
        one = np.stack([rng.random(scenario.draws_shape) for rng in rngs])
        return np.broadcast_to(one, (*runs, *one.shape))

    start = draws().copy()
    for run, own in enumerate(layouts):
        if own is not None:
            start[run] = own
    state = initial(scenario, start)
    yield state, None
    for _ in range(scenario.mission.max_steps):
        state, outcome = step(scenario, state, act(state), draws(), rewards, transmitting)
        yield state, outcome


class BatchWorld:
    """Worlds `[N]` of one scenario that advance together and restart each by itself, on numpy or torch."""

    def __init__(self, scenario: Scenario, draws: Array, rewards: Rewards | None = None) -> None:
        """Worlds before their first step; arguments as in `initial` and `step`."""
        self.scenario, self._rewards = scenario, rewards
        self.state = initial(scenario, draws)  # of all worlds between two steps, `[N, ...]`

    def step(self, action: Array, draws: Array) -> Outcome:
        """One step of every world: integers `[N]`, and uniform draws `[N, U, D]`."""
        self.state, outcome = step(self.scenario, self.state, action, draws, self._rewards)
        return outcome

    def restart(self, where: Array, draws: Array) -> None:
        """Restart the worlds in `where` (bool `[N]`) from their part of `draws` `[N, U, D]`."""
        self.state = select(where, initial(self.scenario, draws), self.state)

    def observe(self, kind: Observation, weight: Array | float | None = None) -> Array:
        """The observation of each world, float32 `[N, D]`; `weight` as in `observations.encode`."""
        return observe(kind, self.scenario, self.state, weight)
