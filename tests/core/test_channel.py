"""The channel models against their sources: written a second time here, and numbers of the sources."""

import math
import re
import tomllib
from pathlib import Path

import msgspec
import numpy as np
import pytest
import torch

from tests.core.test_world import fields, flight, fly
from uav_dc_ros import scenarios
from uav_dc_ros.core import channel, world
from uav_dc_ros.core.channel import AerialVehicle, AirToGround
from uav_dc_ros.core.scenario import from_values
from uav_dc_ros.errors import ScenarioError

COMMON = {"bandwidth_hz": 1e6, "tx_power_w": 0.1, "noise_power_dbm": -110.0, "interference": "all"}
AIR = COMMON | {"carrier_hz": 2e9, "line_of_sight": "mean_loss_db"}
MODELS = [
    *(("air_to_ground", name) for name in ("suburban", "urban", "dense_urban", "high_rise")),
    *(("tr_36_777", name) for name in ("rma_av", "uma_av", "umi_av")),
]
FORMULA = {"rtol": 1e-9, "atol": 0.0}  # of a gain: a source with a formula


def settings(model, environment, **values):
    kind = {"air_to_ground": AirToGround, "tr_36_777": AerialVehicle}[model]
    return kind(**AIR | {"environment": environment} | values)


def gain_db(values, height_m, ground_m):
    """The model's gain towards one user, dB."""
    uav_m, users_m = np.array([0.0, 0.0, height_m]), np.array([[ground_m, 0.0]])
    gain = channel.path_gain(values, uav_m, users_m, np.hypot(height_m, users_m[:, 0]))
    return 10.0 * math.log10(gain[0])


def sight(values, height_m, ground_m):
    """Probability of line of sight, and the losses with and without it, of one user."""
    height = np.array([height_m])
    make = channel.air_to_ground_sight if isinstance(values, AirToGround) else channel.aerial_vehicle_sight
    return [float(one[0]) for one in make(values, height, np.array([ground_m]), np.hypot(height, ground_m))]


# Al-Hourani, Kandeepan, Lardner 2014.


# Table I: C_ij of the polynomials in alpha beta (i) and gamma (j), and ITU-R P.1410's alpha, beta, gamma.
C_A = [
    [9.34e-1, 2.30e-1, -2.25e-3, 1.86e-5],
    [1.97e-2, 2.44e-3, 6.58e-6],
    [-1.24e-4, -3.34e-6],
    [2.73e-7],
]
C_B = [
    [1.17, -7.56e-2, 1.98e-3, -1.78e-5],
    [-5.79e-3, 1.81e-4, -1.65e-6],
    [1.73e-5, -2.02e-7],
    [-2.00e-8],
]
CITIES = {
    "suburban": (0.1, 750.0, 8.0),
    "urban": (0.3, 500.0, 15.0),
    "dense_urban": (0.5, 300.0, 20.0),
    "high_rise": (0.5, 300.0, 50.0),
}


@pytest.mark.parametrize("city", CITIES)
def test_a_and_b_are_those_of_the_letter_s_polynomials(city):
    alpha, beta, gamma = CITIES[city]
    for table, rounded in zip((C_A, C_B), channel.ENVIRONMENTS[city][:2], strict=True):
        value = sum(
            c * (alpha * beta) ** i * gamma**j for i, row in enumerate(table) for j, c in enumerate(row)
        )
        assert value == pytest.approx(rounded, abs=0.0051)


@pytest.mark.parametrize(
    ("city", "elevation_deg"),
    [("suburban", 20.34), ("urban", 42.44), ("dense_urban", 54.62), ("high_rise", 75.52)],
)
def test_the_elevation_of_the_widest_coverage_is_the_letter_s(city, elevation_deg):
    """At the edge of the widest coverage the loss at that radius has its minimum over the altitude."""
    heights_m = 1000.0 * np.tan(np.radians(np.arange(5.0, 89.0, 0.02)))
    uavs_m = np.stack([np.zeros_like(heights_m), np.zeros_like(heights_m), heights_m], axis=-1)
    users_m, distance_m = np.array([[1000.0, 0.0]]), np.hypot(heights_m, 1000.0)[:, None]
    gain = channel.path_gain(settings("air_to_ground", city), uavs_m, users_m, distance_m)
    found_deg = math.degrees(math.atan2(heights_m[gain[:, 0].argmax()], 1000.0))
    assert found_deg == pytest.approx(elevation_deg, abs=0.1)  # a and b are rounded


def letter_db(city, carrier_hz, height_m, ground_m):
    """The letter's closed form of the mean loss: A P(theta) + 10 log10(h^2 + r^2) + B."""
    a, b, los, nlos = {
        "suburban": (4.88, 0.43, 0.1, 21),
        "urban": (9.61, 0.16, 1, 20),
        "dense_urban": (12.08, 0.11, 1.6, 23),
        "high_rise": (27.23, 0.08, 2.3, 34),
    }[city]
    theta = math.degrees(math.atan2(height_m, ground_m))
    constant = 20 * math.log10(carrier_hz) + 20 * math.log10(4 * math.pi / 299792458) + nlos
    mean = (los - nlos) / (1 + a * math.exp(-b * (theta - a)))
    return mean + 10 * math.log10(height_m**2 + ground_m**2) + constant


# 3GPP TR 36.777, tables B-1 and B-2.


def report(environment, fc, h, d2d):
    """Probability and losses in the report's own rows; fc in GHz."""
    d3d, lg = math.hypot(h, d2d), math.log10
    if environment == "rma_av":
        sure, p1, d1 = h > 40, max(15021 * lg(h) - 16053, 1000), max(1350.8 * lg(h) - 1602, 18)
        los = max(23.9 - 1.8 * lg(h), 20) * lg(d3d) + 20 * lg(40 * math.pi * fc / 3)
        nlos = max(los, -12 + (35 - 5.3 * lg(h)) * lg(d3d) + 20 * lg(40 * math.pi * fc / 3))
    elif environment == "uma_av":
        sure, p1, d1 = h > 100, 4300 * lg(h) - 3800, max(460 * lg(h) - 700, 18)
        los = 28 + 22 * lg(d3d) + 20 * lg(fc)
        nlos = -17.5 + (46 - 7 * lg(h)) * lg(d3d) + 20 * lg(40 * math.pi * fc / 3)
    else:
        sure, p1, d1 = False, 233.98 * lg(h) - 0.95, max(294.05 * lg(h) - 432.94, 18)
        free = 20 * lg(d3d) + 20 * lg(40 * math.pi * fc / 3)
        los = max(free, 30.9 + (22.25 - 0.5 * lg(h)) * lg(d3d) + 20 * lg(fc))
        nlos = max(los, 32.4 + (43.2 - 7.6 * lg(h)) * lg(d3d) + 20 * lg(fc))
    if sure or d2d <= d1:
        return 1.0, los, nlos
    return d1 / d2d + math.exp(-d2d / p1) * (1 - d1 / d2d), los, nlos


@pytest.mark.parametrize(
    ("environment", "height_m", "ground_m", "expected"),
    [  # with bc, 20 digits
        ("uma_av", 60.0, 800.0, (0.83989078718, 97.91537630298, 118.41044838177)),
        ("umi_av", 60.0, 800.0, (0.24159561827, 98.95930384081, 124.63803438621)),
        ("rma_av", 30.0, 2000.0, (0.77650752095, 108.58118785906, 116.15683501902)),
    ],
)
def test_values_of_the_report_s_rows_at_2_ghz(environment, height_m, ground_m, expected):
    assert sight(settings("tr_36_777", environment), height_m, ground_m) == pytest.approx(expected, abs=2e-11)


@pytest.mark.parametrize(
    ("environment", "height_m"), [("uma_av", 100.1), ("uma_av", 300.0), ("rma_av", 40.1)]
)
def test_high_up_line_of_sight_is_certain(environment, height_m):
    assert sight(settings("tr_36_777", environment), height_m, 3900.0)[0] == 1.0


@pytest.mark.parametrize(("environment", "limits_m"), [("uma_av", (22.5, 300.0)), ("rma_av", (10.0, 300.0))])
def test_a_height_beyond_the_tables_counts_as_their_limit(environment, limits_m):
    """That of a real vehicle off its cell; only the distance is the real one."""
    values = settings("tr_36_777", environment)
    for limit_m, height_m in zip(limits_m, (limits_m[0] - 3.0, 310.0), strict=True):
        height, ground = np.array([height_m]), np.array([700.0])
        distance = np.hypot(limit_m, ground)
        for one, other in zip(
            channel.aerial_vehicle_sight(values, height, ground, distance),
            channel.aerial_vehicle_sight(values, np.array([limit_m]), ground, distance),
            strict=True,
        ):
            np.testing.assert_array_equal(one, other)


# Both.


@pytest.mark.parametrize("line_of_sight", ["mean_loss_db", "mean_gain"])
@pytest.mark.parametrize(("model", "environment"), MODELS)
def test_every_gain_against_the_source_s_formula(model, environment, line_of_sight, array):
    """From right above a user to 3.9 km away, over the heights of the model and two carriers."""
    rng = np.random.default_rng(2)
    low_m = channel.AERIAL[environment].min_height_m if model == "tr_36_777" else 5.0
    heights_m = [low_m + 0.1, 30.0, 39.9, 40.1, 99.0, 101.0, 300.0]
    ground_m = np.array([0.0, 1e-6, 0.5, 5.0, 17.9, 18.1, 60.0, 250.0, 1000.0, 3900.0])
    angle = rng.uniform(0.0, 2.0 * np.pi, ground_m.shape)
    users_m = np.stack([ground_m * np.cos(angle), ground_m * np.sin(angle)], axis=-1)
    uavs_m = np.array([[0.0, 0.0, height_m] for height_m in heights_m])
    distance_m = np.hypot(uavs_m[:, 2:], ground_m)
    for carrier_hz in (0.7e9, 5.8e9):
        values = settings(model, environment, carrier_hz=carrier_hz, line_of_sight=line_of_sight)
        expected = np.empty(distance_m.shape)
        for (i, height_m), (j, away_m) in (
            (i, j) for i in enumerate(heights_m) for j in enumerate(ground_m.tolist())
        ):
            if model == "air_to_ground":
                los, nlos = (sight(values, height_m, away_m)[k] for k in (1, 2))
                theta = math.degrees(math.atan2(height_m, away_m))
                a, b = channel.ENVIRONMENTS[environment][:2]
                p = 1.0 / (1.0 + a * math.exp(-b * (theta - a)))
                mean_db = letter_db(environment, carrier_hz, height_m, away_m)
            else:
                p, los, nlos = report(environment, carrier_hz / 1e9, height_m, away_m)
                mean_db = p * los + (1.0 - p) * nlos
            mean = p * 10.0 ** (-los / 10.0) + (1.0 - p) * 10.0 ** (-nlos / 10.0)
            expected[i, j] = mean if line_of_sight == "mean_gain" else 10.0 ** (-mean_db / 10.0)
        gain = channel.path_gain(values, array(uavs_m), array(users_m), array(distance_m))
        np.testing.assert_allclose(gain, expected, **FORMULA)


def test_the_two_means_differ_as_a_mean_of_logarithms_does():
    """The mean gain is never below the gain of the mean loss; a certain line of sight makes them equal."""
    for model, environment in MODELS:
        means = [
            gain_db(settings(model, environment, line_of_sight=one), 60.0, 500.0)
            for one in ("mean_gain", "mean_loss_db")
        ]
        assert means[0] >= means[1]
    certain = [
        gain_db(settings("tr_36_777", "uma_av", line_of_sight=one), 200.0, 500.0)
        for one in ("mean_gain", "mean_loss_db")
    ]
    assert certain[0] == pytest.approx(certain[1], rel=1e-12)


def test_the_manual_s_table_is_the_code_s():
    text = (Path(__file__).parents[2] / "docs" / "channels.md").read_text("utf-8")
    rows = re.findall(r"^\| `(\w+)` \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \|$", text, re.MULTILINE)
    assert {name: tuple(map(float, numbers)) for name, *numbers in rows} == channel.ENVIRONMENTS
    blocks = re.findall(r"```toml\n(.*?)```", text, re.DOTALL)
    example = "".join(block for block in blocks if "gain_map" not in block)
    values = msgspec.to_builtins(scenarios.load("three_clusters_hover"))
    scenario = from_values(values | tomllib.loads(example), "docs")
    assert channel.title(scenario.radio) == "air_to_ground, urban, 2 GHz, shadowing, rician fading"
    assert channel.title(scenarios.load("three_clusters_hover").radio) == "free_space"


# The world with them.


def with_radio(scenario, **radio):
    """The scenario with another uplink."""
    values = msgspec.to_builtins(scenario)
    return from_values(values | {"radio": COMMON | radio}, "test")


RICIAN = {"model": "rician", "k_db": 6.0}
WORLDS = [
    {"model": "air_to_ground", "environment": "urban"},
    {"model": "tr_36_777", "environment": "umi_av"},
    {
        "model": "tr_36_777",
        "environment": "uma_av",
        "line_of_sight": "drawn",
        "fading": RICIAN,
        "shadowing": {"correlation_m": 40.0},
    },
    {
        "model": "free_space",
        "ref_gain_db": -50.0,
        "path_loss_exponent": 2.0,
        "shadowing": {"sigma_db": 6.0, "correlation_m": 40.0},
        "fading": {"model": "rayleigh"},
    },
]


@pytest.fixture(scope="module", params=WORLDS, ids=["air_to_ground", "tr_36_777", "random", "random_free"])
def any_model(request, three, changed):
    """An odd number of users, so that no vector loop comes out even."""
    scenario = changed(three, users={"users_per_cluster": 7})
    own = {} if request.param["model"] == "free_space" else {"carrier_hz": 2e9, "line_of_sight": "mean_gain"}
    return with_radio(scenario, **own | request.param)


@pytest.mark.parametrize("n", [1, 3, 33])
def test_a_batch_equals_its_single_worlds_to_the_last_bit(any_model, n):
    draws, actions = flight(any_model, (n,), seed=n)
    draws, actions = draws[:21], actions[:20]
    batch = list(fly(any_model, draws, actions))
    for i in range(0, n, 16):
        alone = fly(any_model, draws[:, i], [np.asarray(one) for one in actions[:, i]])
        for (state, outcome), (one, single) in zip(batch, alone, strict=True):
            for (name, many), (_, value) in zip(
                [*fields(state), *fields(outcome)], [*fields(one), *fields(single)], strict=True
            ):
                np.testing.assert_array_equal(many[i], value, err_msg=name, strict=True)


def test_torch_equals_numpy(any_model):
    draws, actions = flight(any_model, (5,), seed=8)
    in_torch = fly(any_model, torch.from_numpy(draws[:11]), torch.from_numpy(actions[:10]))
    for (_, one), (_, other) in zip(fly(any_model, draws[:11], actions[:10]), in_torch, strict=True):
        for (name, a), (_, b) in zip(fields(one.link), fields(other.link), strict=True):
            np.testing.assert_allclose(b.numpy(), a, rtol=1e-12, err_msg=name)


@pytest.mark.parametrize("library", ["numpy", "torch"])
def test_float32_stays_float32_and_is_close(any_model, library):
    draws, actions = flight(any_model, (4,), seed=9)
    single = draws[:11].astype(np.float32)
    exact = fly(any_model, single.astype(np.float64), actions[:10])
    loose = single if library == "numpy" else torch.from_numpy(single)
    moves = actions if library == "numpy" else torch.from_numpy(actions)
    for (_, a), (_, b) in zip(exact, fly(any_model, loose, moves[:10]), strict=True):
        rate_bps = np.asarray(b.link.rate_bps)
        assert rate_bps.dtype == np.float32
        # The shortest waves of a field of shadowing turn many times between two float32 positions.
        tolerance = 2e-2 if any_model.radio.shadowing else 2e-3
        np.testing.assert_allclose(rate_bps, a.link.rate_bps, rtol=tolerance)


def test_it_follows_the_device_of_the_draws(any_model):
    """The meta device holds shapes and no values: a constant left on the CPU would clash with it."""
    draws = torch.rand((4, any_model.n_users, 2), device="meta")
    state = world.initial(any_model, draws)
    _, outcome = world.step(any_model, state, torch.zeros(4, dtype=torch.int64, device="meta"), draws)
    assert outcome.link.rate_bps.device.type == "meta"


def test_free_space_is_the_default_and_its_worlds_keep_their_fingerprints(three):
    assert with_radio(three, ref_gain_db=-50.0, path_loss_exponent=2.0, tx_power_w=5.0) == three
    explicit = {"model": "free_space", "ref_gain_db": -50.0, "path_loss_exponent": 2.0, "tx_power_w": 5.0}
    assert with_radio(three, **explicit) == three
    # Those of version 0.1.0, which bags and policies hold, under the names of then.
    five = scenarios.load("five_clusters_hover")
    assert msgspec.structs.replace(three, name="three_clusters").fingerprint == "32755934f6fa"
    assert msgspec.structs.replace(five, name="five_clusters").fingerprint == "fcb46aa8fbbf"


def test_every_value_of_a_model_is_in_the_fingerprint(three):
    radio = {"model": "air_to_ground", **AIR, "environment": "urban"}
    others = (
        {},
        {"environment": "suburban"},
        {"carrier_hz": 2.1e9},
        {"line_of_sight": "mean_gain"},
        {"model": "tr_36_777", "environment": "uma_av"},
        {"model": "tr_36_777", "environment": "umi_av"},
    )
    prints = {with_radio(three, **radio | other).fingerprint for other in others}
    assert len({*prints, three.fingerprint}) == 7


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"model": "two_ray"},
            "radio.model = 'two_ray'; expected one of free_space, air_to_ground, tr_36_777",
        ),
        ({"model": 3}, "radio.model = 3; expected str, got int"),
        (
            {"environment": "city"},
            "radio.environment = 'city'; expected one of suburban, urban, dense_urban, ",
        ),
        (
            {"ref_gain_db": -50.0},
            "unknown key radio.ref_gain_db = -50.0; expected one of model, bandwidth_hz, tx_power_w, "
            "noise_power_dbm, shadowing, fading, carrier_hz, environment, line_of_sight, interference",
        ),
        ({"model": "free_space"}, "unknown key radio.carrier_hz = 2000000000.0; expected one of model, "),
        ({"carrier_hz": 2.4}, "radio.carrier_hz = 2.4; expected float >= 100000000.0"),
        ({"line_of_sight": "mean"}, "radio.line_of_sight = 'mean'; expected one of mean_loss_db, mean_gain"),
        ({"model": "tr_36_777"}, "radio.environment = 'urban'; expected one of rma_av, uma_av, umi_av"),
    ],
    ids=str,
)
def test_a_bad_model_is_one_line(three, changes, message):
    with pytest.raises(ScenarioError) as caught:
        with_radio(three, **{"model": "air_to_ground", **AIR, "environment": "urban"} | changes)
    assert str(caught.value).startswith(f"test: {message}")


@pytest.mark.parametrize("key", ["carrier_hz", "environment", "line_of_sight"])
def test_a_model_lacks_a_value(three, key):
    radio = {"model": "tr_36_777", **AIR, "environment": "uma_av"}
    del radio[key]
    with pytest.raises(ScenarioError, match=f"^test: missing key radio.{key}$"):
        with_radio(three, **radio)


@pytest.mark.parametrize(
    ("grid", "environment", "message"),
    [
        (
            {"altitude_min_m": 22.5, "altitude_step_m": 177.5, "n_z": 2},
            "uma_av",
            "grid: altitudes 22.5 to 200 m",
        ),
        (
            {"altitude_step_m": 100.0, "n_z": 4},
            "rma_av",
            "grid: altitudes 100 to 400 m; expected above 10 and ",
        ),
        ({"n_x": 51}, "umi_av", r"users.cluster_centres_m[0] = [200.0, 300.0]: its disc reaches "),
    ],
)
def test_a_grid_beyond_the_report_s_tables_is_refused(three, changed, grid, environment, message):
    radio = {"model": "tr_36_777", **AIR, "environment": environment}
    with pytest.raises(ScenarioError) as caught:
        with_radio(changed(three, grid=grid), **radio)
    assert str(caught.value).startswith(f"test: {message}")
    assert f"radio.environment = '{environment}'" in str(caught.value)
    assert changed(with_radio(three, **radio), grid={"n_x": 12}).radio.environment == environment
