"""The world as a whole: against plain arithmetic, in both libraries, in every batch shape."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from uav_dc_ros.core import grid, world
from uav_dc_ros.core.reward import Rewards

BATCHES = [(), (3,), (2, 3)]


def fields(value):
    """Name and array of every field of a State or an Outcome, the link's included."""
    for field in dataclasses.fields(value):
        inner = getattr(value, field.name)
        if dataclasses.is_dataclass(inner):
            yield from fields(inner)
        else:
            yield field.name, inner


def flight(scenario, batch, seed):
    """Draws `[T + 1, *batch, U, 2]` and actions `[T, *batch]` of a wandering mission towards the dock."""
    rng = np.random.default_rng(seed)
    steps = scenario.mission.max_steps
    draws = rng.random((steps + 1, *batch, scenario.n_users, 2))
    actions = rng.choice(7, (steps, *batch), p=[0.06, 0.34, 0.34, 0.06, 0.05, 0.1, 0.05])
    return draws, actions


def fly(scenario, draws, actions):
    """Every (state, outcome) of a mission."""
    state = world.initial(scenario, draws[0])
    for now, action in zip(draws[1:], actions, strict=True):
        state, outcome = world.step(scenario, state, action, now)
        yield state, outcome


@pytest.fixture(scope="module", params=["all", "associated", "none"])
def any_world(request, three, changed):
    """The three readings of interference; an odd number of users, so that no vector loop comes out even."""
    return changed(three, radio={"interference": request.param}, users={"users_per_cluster": 7})


def by_hand(scenario, draws, actions):
    """One mission in plain Python, user by user, written from the specification and not from the code."""
    s = scenario
    cell = [0, 0, 2]
    spot = [
        (
            cx + s.users.cluster_radius_m * math.sqrt(d0) * math.cos(2 * math.pi * d1),
            cy + s.users.cluster_radius_m * math.sqrt(d0) * math.sin(2 * math.pi * d1),
        )
        for (cx, cy), (d0, d1) in zip(
            [c for c in s.users.cluster_centres_m for _ in range(s.users.users_per_cluster)],
            draws[0],
            strict=True,
        )
    ]
    data, done, before, totals = [0.0] * len(spot), [False] * len(spot), 0.0, []
    signs = [(-1, 0, 0), (1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1), (0, 0, 0)]
    for now, action in zip(draws[1:], actions, strict=True):
        target = [c + d for c, d in zip(cell, signs[action], strict=True)]
        if all(0 <= i < n for i, n in zip(target, (11, 11, 3), strict=True)):
            cell = target
        uav = (100.0 * cell[0], 100.0 * cell[1], 100.0 + 50.0 * cell[2])
        walked = [s.users.v_max_mps * s.mission.step_s * d0 for d0, _ in now]
        spot = [
            (x + w * math.cos(2 * math.pi * d1), y + w * math.sin(2 * math.pi * d1))
            for (x, y), w, (_, d1) in zip(spot, walked, now, strict=True)
        ]
        far = [math.dist(uav, (x, y, 0.0)) for x, y in spot]
        served = [d <= s.mission.d_cons_m and not c for d, c in zip(far, done, strict=True)]
        power = [5.0 * 1e-5 / d**2 for d in far]
        reading = s.radio.interference
        if reading == "associated":
            power = [p if on else 0.0 for p, on in zip(power, served, strict=True)]
        others = [
            0.0 if reading == "none" else math.fsum(p for j, p in enumerate(power) if j != i)
            for i in range(len(power))
        ]
        rate = [1e6 * math.log1p(p / (o + 1e-14)) / math.log(2) for p, o in zip(power, others, strict=True)]
        data = [b + r * 15.0 if on else b for b, r, on in zip(data, rate, served, strict=True)]
        done = [c or b >= s.mission.r_min_bits for c, b in zip(done, data, strict=True)]
        away = math.dist(cell[:2], (10, 10))
        counted = (
            data
            if s.reward.data == "so_far"
            else [r * 15.0 for r, on in zip(rate, served, strict=True) if on]
        )
        total = s.reward.beta * math.fsum(counted) / len(
            data
        ) / s.reward.data_scale_bits + s.reward.zeta * math.exp(-away)
        totals.append(total)
        of_mission = total if s.reward.data == "so_far" else math.fsum(totals) / len(totals)
        yield cell, spot, rate, served, data, done, total, total - before, of_mission
        before = total


@pytest.mark.parametrize("data", ["so_far", "step"])
def test_step_is_the_composition_that_the_specification_describes(any_world, changed, data):
    scenario = changed(any_world, reward={"form": "immediate", "beta": 2.0, "zeta": 3.0, "data": data})
    draws, actions = flight(scenario, (), seed=4)
    visited = 0
    for (state, outcome), hand in zip(
        fly(scenario, draws, [np.asarray(a) for a in actions]), by_hand(scenario, draws, actions), strict=True
    ):
        cell, spot, rate, served, data, done, total, reward, of_mission = hand
        np.testing.assert_array_equal(state.cell, cell)
        np.testing.assert_allclose(state.users_m, spot, rtol=1e-12, atol=1e-9)
        np.testing.assert_allclose(outcome.link.rate_bps, rate, rtol=1e-12)
        np.testing.assert_array_equal(outcome.link.served, served)
        np.testing.assert_allclose(
            outcome.link.sum_rate_bps, sum(r for r, on in zip(rate, served, strict=True) if on), rtol=1e-12
        )
        np.testing.assert_allclose(state.data_bits, data, rtol=1e-12)
        np.testing.assert_array_equal(state.collected, done)
        np.testing.assert_allclose(state.total_reward, total, rtol=1e-12)
        np.testing.assert_allclose(state.mission_reward, of_mission, rtol=1e-12)
        np.testing.assert_allclose(outcome.reward, reward, rtol=1e-9, atol=1e-12)
        visited += sum(served)
    assert visited > 10, "the flight should have met users, or this compares nothing"
    assert state.step == scenario.mission.max_steps


@pytest.mark.parametrize("n", [1, 3, 33])
@pytest.mark.parametrize("layout", ["own", "slice"])
def test_a_batch_equals_its_single_worlds_to_the_last_bit(any_world, n, layout):
    draws, actions = flight(any_world, (n,), seed=n)
    # A slice of a longer record of draws lies scattered in memory. (Only the order of axes must be the
    # usual one: numpy adds up a transposed array in another order, and then the last bit may differ.)
    together = draws if layout == "own" else np.stack([draws, draws], axis=2)[:, :, 0]
    batch = list(fly(any_world, together, actions))
    for i in range(0, n, 8) if n > 8 else range(n):
        for (state, outcome), (one, alone) in zip(
            batch, fly(any_world, draws[:, i], [np.asarray(a) for a in actions[:, i]]), strict=True
        ):
            for (name, many), (_, single) in zip(
                [*fields(state), *fields(outcome)], [*fields(one), *fields(alone)], strict=True
            ):
                np.testing.assert_array_equal(many[i], single, err_msg=name, strict=True)


def test_torch_equals_numpy(any_world):
    draws, actions = flight(any_world, (5,), seed=8)
    in_numpy = fly(any_world, draws, actions)
    in_torch = fly(any_world, torch.from_numpy(draws), torch.from_numpy(actions))
    for (state, outcome), (state_t, outcome_t) in zip(in_numpy, in_torch, strict=True):
        for (name, a), (_, b) in zip(
            [*fields(state), *fields(outcome)], [*fields(state_t), *fields(outcome_t)], strict=True
        ):
            assert isinstance(b, torch.Tensor), name
            b = b.numpy()
            assert a.dtype == b.dtype, name
            if a.dtype.kind == "f":
                # Positions and rewards pass through zero: there, a nanometre and 1e-12 of a reward.
                atol = {"users_m": 1e-9, "reward": 1e-12}.get(name, 0.0)
                np.testing.assert_allclose(b, a, rtol=1e-12, atol=atol, err_msg=name)
            else:
                np.testing.assert_array_equal(b, a, err_msg=name)


@pytest.mark.parametrize("library", ["numpy", "torch"])
def test_float32_is_close_and_never_nan(any_world, library):
    draws, actions = flight(any_world, (6,), seed=9)
    single = draws.astype(np.float32)
    # The same world exactly, in double: what differs is the arithmetic alone.
    exact = list(fly(any_world, single.astype(np.float64), actions))
    if library == "torch":
        loose = list(fly(any_world, torch.from_numpy(single), torch.from_numpy(actions)))
    else:
        loose = list(fly(any_world, single, actions))
    for (state, outcome), (state32, outcome32) in zip(exact, loose, strict=True):
        for name, value in [*fields(state32), *fields(outcome32)]:
            value = np.asarray(value)
            assert value.dtype.kind != "f" or value.dtype == np.float32, name
            assert np.all(np.isfinite(value)), name
        np.testing.assert_array_equal(np.asarray(state32.cell), state.cell)
        np.testing.assert_allclose(np.asarray(state32.users_m), state.users_m, rtol=1e-5, atol=1e-2)
        if any_world.radio.interference != "associated":
            np.testing.assert_allclose(np.asarray(outcome32.link.rate_bps), outcome.link.rate_bps, rtol=1e-3)
    np.testing.assert_allclose(
        np.asarray(loose[-1][0].data_bits).sum(), exact[-1][0].data_bits.sum(), rtol=1e-2
    )


@pytest.mark.parametrize(
    ("episode_end", "at_dock", "last_step", "terminated", "truncated", "landed"),
    [
        ("on_arrival", False, False, False, False, False),
        ("on_arrival", True, False, True, False, True),
        ("on_arrival", False, True, False, True, False),
        ("on_arrival", True, True, True, False, True),
        ("at_time_limit", False, False, False, False, False),
        ("at_time_limit", True, False, False, False, False),
        ("at_time_limit", False, True, True, False, False),
        ("at_time_limit", True, True, True, False, True),
    ],
)
def test_when_a_mission_ends(
    three, changed, array, episode_end, at_dock, last_step, terminated, truncated, landed
):
    scenario = changed(three, mission={"episode_end": episode_end})
    limit = scenario.mission.max_steps
    # One cell short of the dock, or of the cell beside it; then one move to the right.
    cell = [9, 10, 1] if at_dock else [9, 9, 1]
    state = dataclasses.replace(
        world.initial(scenario, array(np.full((scenario.n_users, 2), 0.5))),
        cell=array(cell),
        step=array(limit - 1 if last_step else limit - 2),
    )
    _, outcome = world.step(
        scenario, state, array(int(grid.Action.RIGHT)), array(np.zeros((scenario.n_users, 2)))
    )
    assert (bool(outcome.terminated), bool(outcome.truncated), bool(outcome.landed)) == (
        terminated,
        truncated,
        landed,
    )


def test_ends_tell_the_worlds_of_a_batch_apart(three, changed, array):
    limit = three.mission.max_steps
    step = array([1, limit, limit, 1])
    cell = array([[10, 10, 0], [10, 10, 2], [10, 9, 0], [0, 0, 0]])
    for episode_end, expected in {
        "on_arrival": ([1, 1, 0, 0], [0, 0, 1, 0], [1, 1, 0, 0]),
        "at_time_limit": ([0, 1, 1, 0], [0, 0, 0, 0], [0, 1, 0, 0]),
    }.items():
        scenario = changed(three, mission={"episode_end": episode_end})
        for got, want in zip(
            world.end_of_mission(scenario, step, cell, array(np.zeros(4))), expected, strict=True
        ):
            np.testing.assert_array_equal(got, np.array(want, dtype=bool))


@pytest.mark.parametrize("batch", BATCHES, ids=str)
def test_nothing_is_changed_in_place(three, batch):
    draws, actions = flight(three, batch, seed=1)
    state = world.initial(three, draws[0])
    for now, action in zip(draws[1:8], actions, strict=False):
        action = np.asarray(action)
        inputs = [array for _, array in fields(state)] + [np.asarray(action), now]
        copies = [np.array(value) for value in inputs]
        for value in inputs:
            if isinstance(value, np.ndarray):
                value.setflags(write=False)
        after, _ = world.step(three, state, action, now)
        for value, copy in zip(inputs, copies, strict=True):
            np.testing.assert_array_equal(value, copy)
        state = after


def test_nothing_is_changed_in_place_in_torch(three):
    draws, actions = flight(three, (3,), seed=1)
    draws, actions = torch.from_numpy(draws), torch.from_numpy(actions)
    state = world.initial(three, draws[0])
    for now, action in zip(draws[1:8], actions, strict=False):
        inputs = [*(value for _, value in fields(state)), action, now]
        copies = [value.clone() for value in inputs]
        state, _ = world.step(three, state, action, now)
        assert all(torch.equal(value, copy) for value, copy in zip(inputs, copies, strict=True))


def test_states_are_frozen(three, array):
    state = world.initial(three, array(np.zeros((three.n_users, 2))))
    with pytest.raises(dataclasses.FrozenInstanceError):
        state.step = 3


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("batch", BATCHES, ids=str)
def test_shapes_and_types(three, array, batch, dtype):
    draws, actions = flight(three, batch, seed=2)
    users = three.n_users
    state = world.initial(three, array(draws[0], dtype))
    real = array([0.0], dtype).dtype
    whole, truth = array([0]).dtype, array([True]).dtype
    of_state = {
        "step": ((), whole),
        "cell": ((3,), whole),
        "users_m": ((users, 2), real),
        "data_bits": ((users,), real),
        "collected": ((users,), truth),
        "delivered_bits": ((users,), real),
        "total_reward": ((), real),
        "mission_reward": ((), real),
        "energy_used_j": ((), real),
        "motion": ((users, 0), real),
        "waves": ((1, 0), real),
    }
    of_outcome = {
        "reward": ((), real),
        "terminated": ((), truth),
        "truncated": ((), truth),
        "landed": ((), truth),
        "sinr": ((users,), real),
        "rate_bps": ((users,), real),
        "served": ((users,), truth),
        "sum_rate_bps": ((), real),
    }

    def check(value, contract):
        found = dict(fields(value))
        assert list(found) == list(contract)
        for name, (tail, kind) in contract.items():
            assert tuple(found[name].shape) == (*batch, *tail), name
            assert found[name].dtype == kind, name

    check(state, of_state)
    for now, action in zip(draws[1:4], actions, strict=False):
        state, outcome = world.step(three, state, array(action), array(now, dtype))
        check(state, of_state)
        check(outcome, of_outcome)


# Numbers that float32 holds exactly.
REWARD_SETTINGS = [
    {"data": data, "beta": beta, "zeta": zeta, "r_plus": r_plus, "form": form, "data_scale_bits": scale_bits}
    for data, beta, zeta, r_plus, form, scale_bits in [
        ("so_far", 1.0, 4.0, "binary", "immediate", 6e6),
        ("step", 2.5, 0.0, "exponential", "episode", 1e6),
        ("so_far", 0.0, 0.5, "exponential", "immediate", 2e6),
        ("step", 0.5, 2.0, "binary", "episode", 6e6),
    ]
]


def reward_settings(array, dtype, shape=(-1,)):
    """`REWARD_SETTINGS` as arrays of the core."""

    def column(name, kind):
        return array(np.array([one[name] for one in REWARD_SETTINGS]).reshape(shape), kind)

    return Rewards(
        beta=column("beta", dtype),
        zeta=column("zeta", dtype),
        data_scale_bits=column("data_scale_bits", dtype),
        r_plus=array(np.array([one["r_plus"] == "exponential" for one in REWARD_SETTINGS]).reshape(shape)),
        form=array(np.array([one["form"] == "episode" for one in REWARD_SETTINGS]).reshape(shape)),
        data=array(np.array([one["data"] == "step" for one in REWARD_SETTINGS]).reshape(shape)),
    )


@pytest.mark.parametrize(("batch", "dtype"), [((4,), np.float64), ((4, 3), np.float32)], ids=str)
def test_worlds_that_are_paid_in_different_ways_are_each_paid_as_alone(three, changed, array, batch, dtype):
    """Nothing but the pay differs; each is what a scenario with that reward gives, to the last bit."""
    draws, actions = flight(three, batch, seed=6)
    rewards = reward_settings(array, dtype, (4,) + (1,) * (len(batch) - 1))
    together = world.initial(three, array(draws[0], dtype))
    alone = [world.initial(three, array(draws[0, i], dtype)) for i in range(4)]
    scenarios = [changed(three, reward=own) for own in REWARD_SETTINGS]
    arrived = False
    for now, action in zip(draws[1:], actions, strict=True):
        together, outcome = world.step(three, together, array(action), array(now, dtype), rewards)
        assert outcome.reward.dtype == together.data_bits.dtype
        for i in range(4):
            alone[i], one = world.step(scenarios[i], alone[i], array(action[i]), array(now[i], dtype))
            for (name, many), (_, single) in zip(
                [*fields(together), *fields(outcome)], [*fields(alone[i]), *fields(one)], strict=True
            ):
                # Torch may add up a batch in another order than a world of its own.
                close = 0.0 if isinstance(single, np.ndarray) else 10.0 * np.finfo(dtype).eps
                np.testing.assert_allclose(many[i], single, rtol=close, atol=close, err_msg=name)
        arrived |= bool((together.cell[..., :2] == 10).any())
    assert arrived, "R_plus should have come in"


@pytest.mark.parametrize(
    "device",
    ["meta", pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU"))],
)
def test_everything_follows_the_device_of_the_draws(three, changed, device):
    """The meta device holds shapes and no values: a constant left on the CPU would clash with it."""
    scenario = changed(three, radio={"interference": "associated"})
    draws = torch.rand((4, scenario.n_users, 2), device=device)
    actions = torch.zeros(4, dtype=torch.int64, device=device)
    state = world.initial(scenario, draws)
    rewards = reward_settings(
        lambda values, dtype=None: torch.from_numpy(np.array(values, dtype)).to(device), np.float32
    )
    for how in (None, rewards):
        state, outcome = world.step(scenario, state, actions, draws, how)
        for name, value in [*fields(state), *fields(outcome)]:
            assert value.device.type == device, name


def test_a_mission_begins_at_its_start_with_nothing(three, array):
    draws = np.random.default_rng(3).random((2, three.n_users, 2))
    state = world.initial(three, array(draws))
    start_m = three.grid.centre_m(state.cell, like=state.users_m)
    np.testing.assert_array_equal(start_m, [[0.0, 0.0, 200.0]] * 2)
    for name in ("step", "data_bits", "collected", "total_reward", "mission_reward"):
        assert not np.asarray(getattr(state, name)).any(), name
    away = np.asarray(state.users_m) - three.user_centres_m
    assert np.hypot(away[..., 0], away[..., 1]).max() <= three.users.cluster_radius_m * (1 + 1e-12)


def test_users_move_before_the_channel_is_measured(three, changed):
    """The rate of a step is that of the positions it ends with: the UAV's and the users'."""
    scenario = changed(three, users={"v_max_mps": 20.0})
    draws, actions = flight(scenario, (), seed=5)
    state = world.initial(scenario, draws[0])
    after, outcome = world.step(scenario, state, np.asarray(actions[0]), draws[1])
    uav_m = scenario.grid.centre_m(after.cell, like=after.users_m)
    fresh = world.measure(scenario, uav_m, after.users_m, state.collected)
    stale = world.measure(scenario, uav_m, state.users_m, state.collected)
    np.testing.assert_array_equal(outcome.link.rate_bps, fresh.rate_bps)
    assert not np.allclose(outcome.link.rate_bps, stale.rate_bps, rtol=1e-3)
