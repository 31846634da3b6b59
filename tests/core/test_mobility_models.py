"""Static users, random waypoints and Gauss-Markov users: their statistics, their limits, their errors."""

import math
import tomllib
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.doc_commands import blocks
from uav_dc_ros import scenarios
from uav_dc_ros.core import mobility, world
from uav_dc_ros.core.mobility import WalkingUsers
from uav_dc_ros.core.scenario import from_values
from uav_dc_ros.env.gym_env import DataCollectionEnv
from uav_dc_ros.env.vector_env import DataCollectionVectorEnv
from uav_dc_ros.errors import ScenarioError

WAYPOINT = {"model": "random_waypoint", "v_min_mps": 1.0, "v_max_mps": 4.0, "pause_s": 0.0}
MARKOV = {"model": "gauss_markov", "alpha": 0.8, "mean_speed_mps": 2.0}
MODELS = [{"model": "static"}, WAYPOINT, WAYPOINT | {"waypoints": "start_disc", "pause_s": 40.0}, MARKOV]


def with_mobility(users=10, step_s=15.0, max_steps=60, **mobility):
    values = msgspec.to_builtins(scenarios.load("five_clusters_hover"))
    del values["users"]["v_max_mps"]
    values["users"] |= {"mobility": mobility, "users_per_cluster": users}
    values["mission"] |= {"step_s": step_s, "max_steps": max_steps}
    return from_values(values, "test")


def track(scenario, n_steps, seed=0, make=np.asarray):
    """Positions `[T + 1, U, 2]` and motions of one mission."""
    rng = np.random.default_rng(seed)
    draws = make(rng.random(scenario.draws_shape))
    users_m, motion = mobility.begin(scenario, draws)
    found = [(users_m, motion)]
    for _ in range(n_steps):
        users_m, motion = mobility.move(scenario, users_m, motion, make(rng.random(scenario.draws_shape)))
        found.append((users_m, motion))
    positions, motions = zip(*found, strict=True)
    return np.stack([np.asarray(one) for one in positions]), motions


def test_static_users_stay(array):
    positions, motions = track(with_mobility(model="static"), 5, make=array)
    assert {np.shape(one) for one in motions} == {(50, 0)}
    np.testing.assert_array_equal(positions, np.broadcast_to(positions[0], positions.shape))


@pytest.mark.parametrize("alpha", [0.0, 0.5, 0.9])
def test_gauss_markov_is_stationary_from_the_start(alpha):
    """Normal components of velocity with correlation alpha^n over n steps, and a Rayleigh speed."""
    scenario = with_mobility(users=400, step_s=0.5, **MARKOV | {"alpha": alpha})  # far from the border
    positions, motions = track(scenario, 60)
    velocity = np.stack([np.asarray(one) for one in motions])
    sigma = 2.0 / math.sqrt(math.pi / 2.0)
    n_users = scenario.n_users
    for step in (0, 1, 60):
        speed = np.hypot(*velocity[step].T)
        # Four standard deviations each; that of a Rayleigh variable is 0.655 sigma.
        assert abs(speed.mean() - 2.0) < 4 * 0.655 * sigma / math.sqrt(n_users)
        for share in (0.5, 0.9):  # quantiles of the Rayleigh distribution
            quantile = sigma * math.sqrt(-2.0 * math.log(1.0 - share))
            assert abs(np.mean(speed < quantile) - share) < 4 * math.sqrt(share * (1 - share) / n_users)
    flat = velocity.reshape(61, -1)
    for lag in (1, 3):
        assert abs((flat[:-lag] * flat[lag:]).mean() / sigma**2 - alpha**lag) < 0.02
    np.testing.assert_allclose(np.diff(positions, axis=0), 0.5 * velocity[1:], atol=1e-9)


def test_alpha_one_is_a_straight_line_and_the_border_a_mirror():
    scenario = with_mobility(users=20, **MARKOV | {"alpha": 1.0, "mean_speed_mps": 12.0})
    positions, motions = track(scenario, 60)
    first = np.asarray(motions[0])
    low, high = (np.asarray(one) for one in scenario.grid.area_m)
    assert (positions >= low).all()
    assert (positions <= high).all()
    # The unfolded line, folded by hand: a triangle wave.
    straight = positions[0] + first * 15.0 * np.arange(61)[:, None, None]
    size = high - low
    wave = low + np.abs((straight - low + size) % (2 * size) - size)
    np.testing.assert_allclose(positions, wave, atol=1e-6)
    np.testing.assert_allclose(np.abs(np.asarray(motions[-1])), np.abs(first), rtol=1e-12)
    assert (np.asarray(motions[-1]) != first).mean() > 0.2, "many have been reflected"


def test_gauss_markov_users_fill_the_field_evenly():
    """Reflection keeps the uniform distribution of positions (Nain, Towsley, Liu and Liu, INFOCOM 2005)."""
    scenario = with_mobility(users=400, **MARKOV | {"alpha": 0.9, "mean_speed_mps": 10.0})
    low, high = (np.asarray(one) for one in scenario.grid.area_m)
    positions, _ = track(scenario, 300)
    share = (positions[150::30] - low) / (high - low)
    counts = np.histogram2d(*share.reshape(-1, 2).T, bins=4, range=[[0, 1], [0, 1]])[0]
    expected = counts.sum() / 16
    np.testing.assert_allclose(counts, expected, atol=5 * math.sqrt(expected))


def test_random_waypoint_speed_over_time_and_over_legs():
    """Uniform over legs; over time its density is 1 / v, with mean (v_max - v_min) / ln(v_max / v_min)."""
    scenario = with_mobility(users=100, step_s=5.0, max_steps=1000, **WAYPOINT)
    _, motions = track(scenario, 900)
    speed = np.stack([np.asarray(one)[:, 2] for one in motions[1:]])
    legs = speed[1:][np.diff(speed, axis=0) != 0.0]
    assert len(legs) > 1500
    assert speed.min() >= 1.0
    assert speed.max() <= 4.0
    assert abs(speed[0].mean() - 2.5) < 4 * 0.87 / math.sqrt(scenario.n_users)
    over_time = speed[300:]
    assert over_time.mean() == pytest.approx(3.0 / math.log(4.0), rel=0.02)
    assert np.mean(over_time < 2.0) == pytest.approx(0.5, abs=0.03)  # ln 2 / ln 4
    assert over_time[:300].mean() == pytest.approx(over_time[300:].mean(), rel=0.03), "it does not decay"


@pytest.mark.parametrize("where", ["field", "start_disc"])
def test_waypoints_are_uniform(where):
    scenario = with_mobility(users=200, step_s=200.0, **WAYPOINT | {"waypoints": where, "v_min_mps": 3.0})
    _, motions = track(scenario, 40)
    waypoints = np.stack([one[:, :2] for one in motions[1:]])
    fresh = waypoints[1:][(np.diff(waypoints, axis=0) != 0.0).any(axis=-1)]
    if where == "field":
        (west, south), (east, north) = scenario.grid.area_m
        share = (fresh - [west, south]) / [east - west, north - south]
        assert share.min() >= 0.0
        assert share.max() <= 1.0
        np.testing.assert_allclose(share.mean(axis=0), 0.5, atol=4 * 0.289 / math.sqrt(len(fresh)))
        np.testing.assert_allclose((share < 0.25).mean(axis=0), 0.25, atol=0.03)
    else:
        away = np.hypot(*(waypoints - np.asarray(scenario.user_centres_m)).reshape(-1, 2).T)
        assert away.max() <= 120.0 * (1 + 1e-12)
        assert abs((away < 60.0).mean() - 0.25) < 0.02


def by_hand(at, legs, wait, left):
    """Position after `left` seconds on legs (waypoint, speed) with a pause after each."""
    for (waypoint, speed), pause in zip(legs, (wait, math.inf), strict=True):
        lasts = math.dist(at, waypoint) / speed
        if left < lasts:
            return tuple(a + left / lasts * (w - a) for a, w in zip(at, waypoint, strict=True))
        at, left = waypoint, left - lasts - pause
        if left <= 0.0:
            return at
    raise AssertionError("the second pause has no end within the step")


@settings(derandomize=True, deadline=None, max_examples=60)
@given(
    x=st.floats(0, 900), y=st.floats(0, 900), wait=st.floats(0, 20), speed=st.floats(1, 60),
    draws=st.tuples(*[st.floats(0, 1, exclude_max=True)] * 3),
)  # fmt: skip
def test_a_step_is_the_continuous_motion(x, y, wait, speed, draws):
    scenario = with_mobility(users=1, **WAYPOINT | {"v_max_mps": 60.0, "pause_s": 10.0})
    at, waypoint = (500.0, 400.0), (x, y)
    users_m = np.tile(at, (5, 1))
    motion = np.tile([x, y, speed, wait], (5, 1))
    after, remembered = mobility.move(scenario, users_m, motion, np.tile(draws, (5, 1)))
    fresh = tuple(-50.0 + 1100.0 * one for one in draws[:2])
    legs = [(waypoint, speed), (fresh, 1.0 + 59.0 * draws[2])]
    np.testing.assert_allclose(after[0], by_hand(at, legs, wait, 15.0), atol=1e-9)
    assert (remembered[:, 3] >= 0.0).all()
    assert (remembered[:, 3] <= max(wait, 10.0)).all()


def test_a_pause_lasts_its_time():
    scenario = with_mobility(users=1, **WAYPOINT | {"pause_s": 40.0})
    users_m, motion = np.tile([100.0, 100.0], (5, 1)), np.tile([110.0, 100.0, 2.0, 40.0], (5, 1))
    draws = np.tile([0.5, 0.5, 0.0], (5, 1))  # to (500, 500) at 1 m/s
    found = []
    for _ in range(4):
        users_m, motion = mobility.move(scenario, users_m, motion, draws)
        found.append((*users_m[0], motion[0, 3]))
    # It arrives after 5 s of the first step, and leaves after 45 s in all.
    np.testing.assert_allclose(found[:3], [(110, 100, 30), (110, 100, 15), (110, 100, 0)])
    gone = 15.0 / math.hypot(390, 400)
    np.testing.assert_allclose(found[3], (110 + 390 * gone, 100 + 400 * gone, 40.0))


@pytest.mark.parametrize("model", MODELS, ids=lambda one: one["model"])
def test_environments_nodes_and_batches_move_users_alike(model):
    """The single and the vector environment, `WalkingUsers` of the nodes, and torch."""
    scenario = with_mobility(**model)
    env, batch = DataCollectionEnv(scenario), DataCollectionVectorEnv(2, scenario)
    users = WalkingUsers(scenario, 7)
    _, info = env.reset(seed=7)
    _, infos = batch.reset(seed=7)
    for step in range(1, 12):
        np.testing.assert_array_equal(info["users_m"], users.positions_m)
        np.testing.assert_array_equal(infos["users_m"][0], users.positions_m)
        users.walk()
        *_, info = env.step(np.int64(6))
        *_, infos = batch.step(np.full(2, 6))
        assert users.step == step
    later = WalkingUsers(scenario, 7)
    later.walk(11)
    np.testing.assert_array_equal(later.positions_m, users.positions_m)


@pytest.mark.parametrize("model", MODELS, ids=lambda one: one["model"])
def test_torch_follows_numpy(model):
    torch = pytest.importorskip("torch")
    scenario = with_mobility(**model)
    expected, _ = track(scenario, 20)
    found, _ = track(scenario, 20, make=torch.from_numpy)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
    single, _ = track(scenario, 20, make=lambda draws: draws.astype(np.float32))
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, expected, rtol=0, atol=0.05)


def test_a_restarted_world_forgets_its_motion(array):
    scenario = with_mobility(users=2, **WAYPOINT)
    rng = np.random.default_rng(3)
    draws = [array(rng.random((2, *scenario.draws_shape))) for _ in range(3)]
    batch = world.BatchWorld(scenario, draws[0])
    batch.step(array([6, 6]), draws[1])
    kept = np.asarray(batch.state.motion)[0]
    batch.restart(array([False, True]), draws[2])
    fresh = world.initial(scenario, draws[2])
    np.testing.assert_array_equal(np.asarray(batch.state.motion)[0], kept)
    np.testing.assert_array_equal(np.asarray(batch.state.motion)[1], np.asarray(fresh.motion)[1])


def test_the_random_walk_has_one_fingerprint():
    values = msgspec.to_builtins(scenarios.load("five_clusters_hover"))
    values["users"]["mobility"] = {"model": "random_walk"}
    named = from_values(values, "test")
    assert named.fingerprint == scenarios.load("five_clusters_hover").fingerprint
    assert with_mobility(model="static").fingerprint != named.fingerprint
    assert with_mobility(**MARKOV).fingerprint != with_mobility(**MARKOV | {"alpha": 0.81}).fingerprint


@pytest.mark.parametrize(
    ("users", "message"),
    [
        ({"v_max_mps": None}, "missing key users.v_max_mps"),
        ({"mobility": "static"}, "users.mobility = 'static'; expected table, got str"),
        (
            {"mobility": {"model": "levy"}},
            "users.mobility.model = 'levy'; expected one of random_walk, static, random_waypoint, "
            "gauss_markov",
        ),
        (
            {"mobility": {"model": "static"}},
            "users.v_max_mps = 1; expected no such key with users.mobility.model = 'static': it is the speed "
            "of the random walk",
        ),
        (
            {"v_max_mps": None, "mobility": WAYPOINT | {"v_min_mps": 0.0}},
            "users.mobility.v_min_mps = 0.0; expected float > 0.0",
        ),
        (
            {"v_max_mps": None, "mobility": WAYPOINT | {"v_min_mps": 5.0}},
            "users.mobility.v_min_mps = 5; expected at most users.mobility.v_max_mps = 4",
        ),
        (
            {"v_max_mps": None, "mobility": MARKOV | {"alpha": 1.1}},
            "users.mobility.alpha = 1.1; expected float <= 1.0",
        ),
        (
            {"v_max_mps": None, "mobility": MARKOV | {"alfa": 1.0}},
            "unknown key users.mobility.alfa = 1.0; did you mean 'alpha'?",
        ),
        (
            {"v_max_mps": None, "mobility": {"model": "gauss_markov", "alpha": 0.5}},
            "missing key users.mobility.mean_speed_mps",
        ),
    ],
)
def test_errors(users, message):
    values = msgspec.to_builtins(scenarios.load("five_clusters_hover"))
    values["users"] = {key: v for key, v in (values["users"] | users).items() if v is not None}
    with pytest.raises(ScenarioError) as caught:
        from_values(values, "mine.toml")
    assert str(caught.value) == f"mine.toml: {message}"


def test_the_example_of_the_page_is_a_scenario():
    page = Path(__file__).parents[2] / "docs" / "users.md"
    tables = (tomllib.loads(one) for one in blocks(page.read_text("utf-8"), "toml"))
    (example,) = (one for one in tables if "cluster_centres_m" in one["users"])
    scenario = from_values(msgspec.to_builtins(scenarios.load("three_clusters_hover")) | example, "users.md")
    assert scenario.users.mobility.waypoints == "start_disc"
