"""The random parts of a channel: the generator's known answers, the statistics of the sources, and seeds."""

import math

import msgspec
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.core.test_channel import AIR, COMMON, RICIAN, with_radio
from tests.core.test_world import flight, fly
from uav_dc_ros import messages, payloads
from uav_dc_ros.core import channel, world
from uav_dc_ros.core.mobility import WalkingUsers
from uav_dc_ros.core.propagation import counter_random, stochastic
from uav_dc_ros.core.propagation.stochastic import Rayleigh, Realization, Rician, Shadowing
from uav_dc_ros.errors import MessageError, ScenarioError

FORMULA = {"rtol": 1e-9, "atol": 0.0}
FIELD = Shadowing(sigma_db=6.0, correlation_m=50.0)
N = 2000  # seeds: the standard error of a mean of unit variance is 0.022
SEEDS = counter_random.seed_of(np.random.default_rng(1).random((N, 1, 2)))
EVERYTHING = {
    "model": "tr_36_777",
    **AIR,
    "environment": "umi_av",
    "line_of_sight": "drawn",
    "shadowing": {"correlation_m": 50.0},
    "fading": RICIAN,
}


# The generator.


@pytest.mark.parametrize(
    ("counter", "key", "expected"),
    [  # threefry2x32 with 20 rounds in Random123's tests/kat_vectors
        ((0, 0), (0, 0), (0x6B200159, 0x99BA4EFE)),
        ((0xFFFFFFFF, 0xFFFFFFFF), (0xFFFFFFFF, 0xFFFFFFFF), (0x1CB996FC, 0xBB002BE7)),
        ((0x243F6A88, 0x85A308D3), (0x13198A2E, 0x03707344), (0xC4923A9C, 0x483DF7A0)),
    ],
)
def test_words_are_the_known_answers_of_threefry(counter, key, expected, array):
    seed = np.array(key[1] << 32 | key[0], np.uint64).astype(np.int64)
    first, second = counter_random.words(array(seed), array([counter[0]]), counter[1])
    assert (int(first[0]), int(second[0])) == expected


def test_uniform_numbers_are_the_same_in_both_libraries_and_precisions():
    for like in (np.zeros(0), np.zeros(0, np.float32), torch.zeros(0).double(), torch.zeros(0)):
        seeds = SEEDS[:20] if isinstance(like, np.ndarray) else torch.from_numpy(SEEDS[:20])
        numbers = counter_random.uniforms(seeds, 1000, 1, like)
        expected = counter_random.uniforms(SEEDS[:20], 1000, 1, np.zeros(0))
        for one, other in zip(numbers, expected, strict=True):
            assert one.dtype == like.dtype
            np.testing.assert_array_equal(np.asarray(one, np.float64), other)
            assert 0.0 < other.min() < other.max() < 1.0
            assert other.mean() == pytest.approx(0.5, abs=4 * 0.29 / 20_000**0.5)


def test_streams_counters_and_seeds_give_unrelated_numbers():
    pairs = [counter_random.words(SEEDS[:50], np.arange(100), stream) for stream in range(2)]
    assert len({*zip(*np.concatenate(pairs, axis=1).reshape(2, -1).tolist(), strict=True)}) == 10_000
    one = np.concatenate([counter_random.uniforms(SEEDS[:50], 100, i, np.zeros(0)) for i in range(2)])
    for shifted in (one[1:, :, :], one[:, 1:, :], one[:, :, 1:]):
        a = one[tuple(slice(0, n) for n in shifted.shape)]
        assert abs(np.corrcoef(a.ravel(), shifted.ravel())[0, 1]) < 4 / a.size**0.5


@given(st.lists(st.integers(0, 2**24 - 1), min_size=2, max_size=2))
def test_a_seed_is_that_of_both_precisions_and_json_holds_it(numbers):
    draws = np.array([[one / 2**24 for one in numbers], [0.3, 0.9]])
    seed = int(counter_random.seed_of(draws))
    assert seed == int(counter_random.seed_of(torch.from_numpy(draws.astype(np.float32))))
    assert seed == numbers[0] * 2**24 + numbers[1] < 2**53


# Shadowing.


def test_the_waves_have_the_spectrum_of_an_exponential_correlation():
    """The mean of cos(k d) over wave vectors is the correlation at d, in every direction (Bochner)."""
    waves = stochastic.waves(FIELD, SEEDS, np.zeros(0))
    frequencies = np.moveaxis(waves, 1, 0).reshape(6, -1)
    error = 4 / (2 * frequencies.shape[1]) ** 0.5
    rng = np.random.default_rng(3)
    for part, n in ((frequencies[:2], 2), (frequencies[2:5], 3)):
        for distance_m in (0.0, 5.0, 20.0, 50.0, 150.0):
            way = rng.normal(size=n)
            way *= distance_m / np.linalg.norm(way)
            correlation = np.cos(2.0 * np.pi * (way @ part)).mean()
            assert correlation == pytest.approx(math.exp(-distance_m / 50.0), abs=error)


def test_the_field_is_the_sum_of_its_waves_and_constant_over_a_mission(array):
    waves = stochastic.waves(FIELD, array(SEEDS[:3]), array(0.0))
    uav_m, users_m = np.array([300.0, 80.0, 120.0]), np.array([[0.0, 0.0], [731.25, -40.5]])
    found = np.asarray(stochastic.shadowing(waves, array(uav_m), array(users_m)))
    for i, (kx, ky, qx, qy, qz, phase) in enumerate(np.asarray(waves)):
        for j, (x, y) in enumerate(users_m):
            turns = kx * x + ky * y + qx * uav_m[0] + qy * uav_m[1] + qz * uav_m[2] + phase
            expected = sum(math.cos(2.0 * math.pi * one) for one in turns) * math.sqrt(2 / 64)
            assert found[i, j] == pytest.approx(expected, rel=1e-9, abs=1e-11)
    assert stochastic.WAVES == 64
    again = stochastic.shadowing(waves, array(uav_m), array(users_m[1:]))
    np.testing.assert_array_equal(np.asarray(again), found[:, 1:])


def test_links_are_normal_and_correlated_as_gudmundson_has_it():
    """Over the seeds: mean 0, variance 1, and the product of exponentials where both ends have moved."""
    waves = stochastic.waves(FIELD, SEEDS, np.zeros(0))
    users_m = np.array([[200.0, 300.0], [210.0, 300.0], [200.0, 350.0], [400.0, 300.0]])
    here = stochastic.shadowing(waves, np.array([100.0, 0.0, 100.0]), users_m)
    assert abs(here.mean(axis=0)).max() < 4 / N**0.5
    assert abs(here.var(axis=0) - 1.0).max() < 4 * (2 / N) ** 0.5
    away_m = np.hypot(*(users_m - users_m[0]).T)
    for uav_m, moved_m in (([100.0, 0.0, 100.0], 0.0), ([130.0, 0.0, 60.0], 50.0)):
        there = stochastic.shadowing(waves, np.array(uav_m), users_m)
        correlation = (there * here[:, :1]).mean(axis=0)
        expected = np.exp(-(away_m + moved_m) / 50.0)
        assert abs(correlation - expected).max() < 4 * (2 / N) ** 0.5
    tails = [np.mean(abs(here) > sigmas) for sigmas in (1.0, 2.0)]
    assert tails == pytest.approx([0.317, 0.0455], abs=0.02)


def test_sigma_is_table_b_3_s_or_the_scenario_s():
    """TR 36.777, Table B-3: sigma with and without line of sight."""
    h = np.array([60.0])
    rows = {
        "rma_av": (4.2 * math.exp(-0.0046 * 60.0), 6.0),
        "uma_av": (4.64 * math.exp(-0.0066 * 60.0), 6.0),
        "umi_av": (max(5.0 * math.exp(-0.01 * 60.0), 2.0), 8.0),
    }
    for environment, expected in rows.items():
        radio = channel.AerialVehicle(**AIR, environment=environment, shadowing=Shadowing(correlation_m=50.0))
        found = channel.shadowing_sigmas_db(radio, h)
        np.testing.assert_allclose([float(np.squeeze(one)) for one in found], expected, **FORMULA)
        own = msgspec.structs.replace(radio, shadowing=FIELD)
        assert channel.shadowing_sigmas_db(own, h) == (6.0, 6.0)
    high = channel.AerialVehicle(**AIR, environment="umi_av", shadowing=Shadowing(correlation_m=50.0))
    assert channel.shadowing_sigmas_db(high, np.array([200.0]))[0] == 2.0


# Fading.


@pytest.mark.parametrize("k_db", [None, -50.0, 0.0, 6.0, 15.0])
def test_fading_has_the_moments_of_a_rician_power(k_db, array):
    """Mean 1; variance (1 + 2 K) / (1 + K)^2; of K = 0 an exponential distribution."""
    settings = Rayleigh() if k_db is None else Rician(k_db=k_db)
    power = np.asarray(stochastic.fading(settings, array(SEEDS), array(np.zeros((N, 20)))))
    assert power.min() >= 0.0
    k = 0.0 if k_db is None else 10.0 ** (k_db / 10.0)
    variance = (1.0 + 2.0 * k) / (1.0 + k) ** 2
    assert power.mean() == pytest.approx(1.0, abs=4 * (variance / power.size) ** 0.5)
    assert power.var() == pytest.approx(variance, rel=0.06)
    if k < 1e-4:
        shares = [np.mean(power > level) for level in (0.1, 1.0, 3.0)]
        assert shares == pytest.approx([math.exp(-0.1), math.exp(-1.0), math.exp(-3.0)], abs=0.01)


def test_a_drawn_link_is_one_of_both_and_without_line_of_sight_it_fades_as_rayleigh(three):
    radio = with_radio(three, **EVERYTHING | {"shadowing": None, "fading": None}).radio
    uav_m, users_m = np.array([0.0, 0.0, 60.0]), np.array([[500.0, 0.0], [100.0, 0.0]])
    distance_m = np.hypot(60.0, users_m[:, 0])
    drawn = Realization(np.zeros(0), SEEDS)
    many_m = np.broadcast_to(users_m, (N, 2, 2))
    gain = channel.path_gain(radio, uav_m, many_m, distance_m, drawn)
    sight = channel.aerial_vehicle_sight(radio, uav_m[2:], users_m[:, 0], distance_m)
    los = abs(10.0 * np.log10(gain) + sight.los_db) < 1e-9
    nlos = abs(10.0 * np.log10(gain) + sight.nlos_db) < 1e-9
    assert (los ^ nlos).all()
    share, error = los.mean(axis=0), 4 * (sight.probability * (1 - sight.probability) / N) ** 0.5
    assert (abs(share - sight.probability) <= error).all()
    faded = channel.path_gain(
        msgspec.structs.replace(radio, fading=Rician(k_db=20.0)), uav_m, many_m, distance_m, drawn
    )
    power = faded / gain
    assert power[los].var() == pytest.approx(201 / 101**2, rel=0.1)
    assert power[nlos].var() == pytest.approx(1.0, rel=0.25)
    without = channel.path_gain(radio, uav_m, users_m, distance_m)
    mean = msgspec.structs.replace(radio, line_of_sight="mean_gain")
    np.testing.assert_array_equal(without, channel.path_gain(mean, uav_m, users_m, distance_m))


@pytest.mark.parametrize("line_of_sight", ["mean_loss_db", "mean_gain", "drawn"])
def test_the_gain_of_everything_at_once(three, line_of_sight):
    """PL + sigma X of each case, the mean or one of them, times the fading: worked out by hand."""
    radio = with_radio(three, **EVERYTHING | {"line_of_sight": line_of_sight}).radio
    uav_m, users_m = np.array([40.0, 10.0, 80.0]), np.array([[500.0, 0.0], [100.0, 90.0], [44.0, 10.0]])
    ground_m = np.hypot(*(users_m - uav_m[:2]).T)
    waves, seed = stochastic.waves(radio.shadowing, SEEDS[5], np.zeros(0)), SEEDS[9]
    p, los, nlos = channel.aerial_vehicle_sight(radio, uav_m[2:], ground_m, np.hypot(80.0, ground_m))
    x = stochastic.shadowing(waves, uav_m, users_m)
    los, nlos = los + max(5 * math.exp(-0.8), 2.0) * x, nlos + 8.0 * x
    sighted = stochastic.has_line_of_sight(p, seed)
    db = {"mean_loss_db": p * los + (1 - p) * nlos, "drawn": np.where(sighted, los, nlos)}
    mean = p * 10 ** (-los / 10) + (1 - p) * 10 ** (-nlos / 10)
    power = stochastic.fading(radio.fading, seed, p, sighted if line_of_sight == "drawn" else None)
    expected = (mean if line_of_sight == "mean_gain" else 10 ** (-db[line_of_sight] / 10)) * power
    found = channel.path_gain(radio, uav_m, users_m, np.hypot(80.0, ground_m), Realization(waves, seed))
    np.testing.assert_allclose(found, expected, **FORMULA)


# Worlds.


@pytest.fixture(scope="module")
def random_world(three):
    return with_radio(three, **EVERYTHING)


def test_each_world_has_its_own_channel_and_a_new_one_with_each_mission(random_world):
    draws, _ = flight(random_world, (3,), seed=4)
    worlds = world.BatchWorld(random_world, draws[0])
    first = worlds.state.waves
    assert len({one.tobytes() for one in first}) == 3
    worlds.step(np.zeros(3, int), draws[1])
    np.testing.assert_array_equal(worlds.state.waves, first)
    worlds.restart(np.array([False, True, False]), draws[2])
    changed = [not np.array_equal(a, b) for a, b in zip(worlds.state.waves, first, strict=True)]
    assert changed == [False, True, False]


def test_users_of_a_mission_are_where_they_are_without_a_random_channel(random_world, three):
    draws, actions = flight(three, (), seed=6)
    states = zip(fly(random_world, draws, actions), fly(three, draws, actions), strict=True)
    for (one, _), (other, _) in states:
        np.testing.assert_array_equal(one.users_m, other.users_m)


def test_a_fixed_start_keeps_its_shadowing_but_not_its_fading(random_world):
    """As in a training run with an environment of its own."""
    draws, _ = flight(random_world, (), seed=7)
    state = world.initial(random_world, draws[0])
    _, one = world.step(random_world, state, np.array(6), draws[1])
    _, other = world.step(random_world, state, np.array(6), draws[2])
    assert not np.isclose(one.link.sinr, other.link.sinr, rtol=0.01).all()
    np.testing.assert_array_equal(world.initial(random_world, draws[0]).waves, state.waves)


# Payloads.


def test_payloads_hold_the_seeds_of_the_environment_s_channel(random_world):
    users, rng = WalkingUsers(random_world, 3), np.random.default_rng(3)
    draws = rng.random((5, random_world.n_users, 2))
    state, link, collected = world.initial(random_world, draws[0]), None, None
    for step in range(4):
        at = {"mission": 0, "step": step, "time_ns": 0}
        sent = payloads.users(random_world, users.positions_m, seeds=users.seeds, **at)
        received = messages.decode(messages.encode(sent), messages.Users)
        drawn = payloads.realization(received, random_world)
        np.testing.assert_array_equal(drawn.waves, state.waves)
        ahead = users.next_seeds
        users.walk()
        assert users.seeds == ahead
        assert users.seeds.shadowing == sent.shadowing_seed
        assert users.seeds.link != sent.link_seed
        uav_m = random_world.grid.centre_m(state.cell, like=state.users_m)
        if link is not None:
            again = world.measure(random_world, uav_m, state.users_m, collected, drawn=drawn)
            np.testing.assert_array_equal(again.sinr, link.sinr)
        collected = state.collected
        state, outcome = world.step(random_world, state, np.array(1), draws[step + 1])
        link = outcome.link


@pytest.mark.parametrize(
    ("radio", "seeds"),
    [
        ({"model": "free_space", "ref_gain_db": -50.0, "path_loss_exponent": 2.0}, set()),
        (EVERYTHING, {"shadowing_seed", "link_seed"}),
        (EVERYTHING | {"line_of_sight": "mean_gain", "fading": None}, {"shadowing_seed"}),
        (EVERYTHING | {"line_of_sight": "mean_gain", "shadowing": None}, {"link_seed"}),
        (EVERYTHING | {"fading": None, "shadowing": None}, {"link_seed"}),
    ],
    ids=["free_space", "all", "shadowing", "fading", "line_of_sight"],
)
def test_users_have_the_seeds_that_the_channel_needs_and_no_others(three, radio, seeds):
    scenario = with_radio(three, **{key: value for key, value in radio.items() if value is not None})
    crowd = WalkingUsers(scenario, 0)
    users = payloads.users(scenario, crowd.positions_m, mission=0, step=0, time_ns=0, seeds=crowd.seeds)
    payloads.check(users, scenario)
    for name in ("shadowing_seed", "link_seed"):
        assert (getattr(users, name) is not msgspec.UNSET) is (name in seeds)
        other = msgspec.structs.replace(users, **{name: msgspec.UNSET if name in seeds else 5})
        with pytest.raises(MessageError, match=f"{name}; expected {'one' if name in seeds else 'none'} in"):
            payloads.check(other, scenario)


# Scenarios.


def test_a_random_channel_is_in_the_fingerprint_and_the_title(three):
    prints = {
        with_radio(three, **EVERYTHING | other).fingerprint
        for other in (
            {},
            {"fading": {"model": "rayleigh"}},
            {"fading": RICIAN | {"k_db": 7.0}},
            {"shadowing": {"correlation_m": 51.0}},
            {"shadowing": {"correlation_m": 50.0, "sigma_db": 6.0}},
            {"line_of_sight": "mean_gain"},
        )
    }
    assert len(prints) == 6
    title = "tr_36_777, umi_av, 2 GHz, line of sight drawn, shadowing, rician fading"
    assert channel.title(with_radio(three, **EVERYTHING).radio) == title


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"shadowing": {}}, "missing key radio.shadowing.correlation_m"),
        ({"shadowing": {"correlation_m": 0.0}}, "radio.shadowing.correlation_m = 0.0; expected float > 0.0"),
        (
            {"shadowing": {"correlation_m": 9.0, "sigma_db": -1.0}},
            "radio.shadowing.sigma_db = -1.0; expected float >= 0.0",
        ),
        (
            {"shadowing": {"correlation_m": 9.0, "sigma": 3.0}},
            "unknown key radio.shadowing.sigma = 3.0; did you mean 'sigma_db'?",
        ),
        ({"fading": {"model": "rice"}}, "radio.fading.model = 'rice'; expected one of rayleigh, rician"),
        ({"fading": {"model": "rician"}}, "missing key radio.fading.k_db"),
        ({"fading": {"model": "rayleigh", "k_db": 3.0}}, "unknown key radio.fading.k_db = 3.0; expected one"),
        ({"fading": 3}, "radio.fading = 3; expected table, got int"),
        (
            {"model": "air_to_ground", "environment": "urban"},
            "missing key radio.shadowing.sigma_db: only radio.model = 'tr_36_777' has values of its own",
        ),
    ],
    ids=str,
)
def test_a_bad_value_is_one_line(three, changes, message):
    with pytest.raises(ScenarioError) as caught:
        with_radio(three, **EVERYTHING | changes)
    assert str(caught.value).startswith(f"test: {message}")
    assert COMMON.items() <= EVERYTHING.items()
