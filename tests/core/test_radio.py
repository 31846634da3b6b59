"""The radio against numbers that were computed elsewhere, and against 50-digit arithmetic."""

import json
from decimal import Decimal, localcontext
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from uav_dc_ros.core import radio

CASES = json.loads((Path(__file__).parent.parent / "data" / "radio_cases.json").read_text("utf-8"))["cases"]
EXACT = {"rtol": 1e-12, "atol": 0.0}
PROPERTY = settings(derandomize=True, deadline=None, max_examples=150)


def lead(values, shape):
    """`values` once for every index of the leading dimensions `shape`."""
    plain = np.asarray(values, dtype=np.float64)
    return np.broadcast_to(plain, (*shape, *plain.shape))


@pytest.mark.parametrize("shape", [(), (4,), (2, 3)], ids=str)
@pytest.mark.parametrize("case", CASES, ids=lambda case: case["name"])
def test_reference_cases(case, shape, array):
    uav_m, users_m = array(lead(case["uav_m"], shape)), array(lead(case["users_m"], shape))
    distance_m = radio.distance(uav_m, users_m)
    gain = radio.path_gain(distance_m, case["ref_gain"])
    np.testing.assert_allclose(distance_m, lead(case["distance_m"], shape), **EXACT)
    np.testing.assert_allclose(gain, lead(case["gain"], shape), **EXACT)
    for interference in ("all", "associated", "none"):
        sinr = radio.sinr(
            gain, case["tx_power_w"], case["noise_power_w"], interference, distance_m <= case["d_cons_m"]
        )
        rate_bps = radio.rate_bps(sinr, case["bandwidth_hz"])
        np.testing.assert_allclose(sinr, lead(case[f"sinr_{interference}"], shape), **EXACT)
        np.testing.assert_allclose(rate_bps, lead(case[f"rate_bps_{interference}"], shape), **EXACT)
        for result in (gain, sinr, rate_bps):
            assert type(result) is type(uav_m)
            assert result.dtype == uav_m.dtype


@pytest.mark.parametrize("whole", [np.asarray, torch.tensor], ids=["numpy", "torch"])
@pytest.mark.parametrize("case", CASES, ids=lambda case: case["name"])
def test_whole_metres_lose_no_digits(case, whole):
    distance_m = radio.distance(whole(case["uav_m"]), whole(case["users_m"]))
    np.testing.assert_allclose(distance_m, case["distance_m"], **EXACT)


def test_positions_of_the_uav_broadcast_over_one_set_of_users(array):
    rng = np.random.default_rng(1)
    users_m = rng.uniform(0.0, 1000.0, (7, 2))
    uav_m = rng.uniform(50.0, 1000.0, (2, 3, 3))
    together = radio.distance(array(uav_m), array(users_m))
    assert tuple(together.shape) == (2, 3, 7)
    for index in np.ndindex(2, 3):
        alone = radio.distance(array(uav_m[index]), array(users_m))
        np.testing.assert_array_equal(together[index], alone)
        by_hand = [np.linalg.norm(uav_m[index] - [x, y, 0.0]) for x, y in users_m]
        np.testing.assert_allclose(alone, by_hand, **EXACT)


def test_users_of_each_world_are_seen_from_its_own_uav(array):
    uav_m = array([[0.0, 0.0, 100.0], [30.0, 40.0, 120.0]])
    users_m = array([[[0.0, 0.0], [300.0, 400.0]], [[0.0, 0.0], [30.0, 40.0]]])
    expected = [[100.0, np.hypot(500.0, 100.0)], [130.0, 120.0]]
    np.testing.assert_allclose(radio.distance(uav_m, users_m), expected, **EXACT)


def in_many_digits(uav_m, users_m, *, exponent, ref_gain, power_w, noise_w, bandwidth_hz, served=None):
    """SINR and rate of every user by the paper's formulas, 50 digits; `served` transmit (default all)."""
    with localcontext() as context:
        context.prec = 50
        x, y, z = map(Decimal, uav_m)
        received = []
        for user_x, user_y in users_m:
            distance = ((x - Decimal(user_x)) ** 2 + (y - Decimal(user_y)) ** 2 + z**2).sqrt()
            received.append(Decimal(power_w) * Decimal(ref_gain) * distance ** -Decimal(exponent))
        if served is not None:
            received = [p if s else Decimal(0) for p, s in zip(received, served, strict=True)]
        sinr = [
            own / (sum((p for j, p in enumerate(received) if j != i), Decimal(0)) + Decimal(noise_w))
            for i, own in enumerate(received)
        ]
        rate = [Decimal(bandwidth_hz) * (1 + s).ln() / Decimal(2).ln() for s in sinr]
        return [float(s) for s in sinr], [float(r) for r in rate]


@st.composite
def fields(draw):
    """A UAV above the origin and users from right below it to ten thousand altitudes away."""
    altitude_m = draw(st.floats(1.0, 500.0))
    ratios = draw(st.lists(st.floats(0.0, 4.0), min_size=1, max_size=12))
    turns = draw(st.lists(st.floats(0.0, 1.0), min_size=len(ratios), max_size=len(ratios)))
    users_m = [
        (altitude_m * 10.0**r * np.cos(2 * np.pi * t), altitude_m * 10.0**r * np.sin(2 * np.pi * t))
        for r, t in zip(ratios, turns, strict=True)
    ]
    served = draw(st.lists(st.booleans(), min_size=len(ratios), max_size=len(ratios)))
    return (0.0, 0.0, altitude_m), [(float(x), float(y)) for x, y in users_m], served


@PROPERTY
@given(field=fields(), exponent=st.sampled_from([2.0, 2.7, 4.0]), noise_dbm=st.floats(-200.0, 30.0))
def test_every_digit_against_decimal_arithmetic(field, exponent, noise_dbm, array):
    uav_m, users_m, served = field
    noise_w = 10.0 ** (noise_dbm / 10.0) * 1e-3
    values = {"exponent": exponent, "ref_gain": 1e-5, "power_w": 5.0, "noise_w": noise_w, "bandwidth_hz": 1e6}
    gain = radio.path_gain(radio.distance(array(uav_m), array(users_m)), 1e-5, exponent)
    for interference, who in (("all", None), ("associated", served)):
        expected_sinr, expected_rate = in_many_digits(uav_m, users_m, served=who, **values)
        sinr = radio.sinr(gain, 5.0, noise_w, interference, array(served))
        np.testing.assert_allclose(sinr, expected_sinr, **EXACT)
        np.testing.assert_allclose(radio.rate_bps(sinr, 1e6), expected_rate, **EXACT)
    alone = [in_many_digits(uav_m, [user], **values)[0][0] for user in users_m]
    np.testing.assert_allclose(radio.sinr(gain, 5.0, noise_w, "none"), alone, **EXACT)


def test_a_strong_neighbour_does_not_eat_the_digits_of_the_rest(array):
    # The total less one's own share would leave the near user eight digits of its interference.
    users_m = [(0.0, 0.0), (1e6, 0.0), (0.0, 1e6)]
    values = {"exponent": 2.0, "ref_gain": 1e-5, "power_w": 5.0, "noise_w": 1e-25, "bandwidth_hz": 1e6}
    gain = radio.path_gain(radio.distance(array([0.0, 0.0, 100.0]), array(users_m)), 1e-5)
    expected, _ = in_many_digits((0.0, 0.0, 100.0), users_m, **values)
    np.testing.assert_allclose(radio.sinr(gain, 5.0, 1e-25), expected, **EXACT)


@PROPERTY
@given(field=fields(), seed=st.integers(0, 1000))
def test_the_order_of_users_does_not_matter(field, seed, array):
    uav_m, users_m, served = field
    order = np.random.default_rng(seed).permutation(len(users_m))
    gain = np.asarray(radio.path_gain(radio.distance(array(uav_m), array(users_m)), 1e-5))
    served = np.asarray(served)
    for interference in ("all", "associated", "none"):
        straight = np.asarray(radio.sinr(array(gain), 5.0, 1e-14, interference, array(served)))
        mixed = radio.sinr(array(gain[order]), 5.0, 1e-14, interference, array(served[order]))
        np.testing.assert_allclose(mixed, straight[order], **EXACT)


def test_power_may_differ_between_users(array):
    gain, power_w = array([1e-9, 2e-9, 4e-9]), array([4.0, 1.0, 0.5])
    received = np.array([4e-9, 2e-9, 2e-9])
    expected = received / (received.sum() - received + 1e-9)
    np.testing.assert_allclose(radio.sinr(gain, power_w, 1e-9), expected, rtol=1e-12)


def test_a_whisper_far_below_the_noise_still_has_a_rate(array):
    # log2(1 + 1e-18) is 0 in floating point; the rate is 1e-18 / ln 2.
    np.testing.assert_allclose(radio.rate_bps(array([1e-18, 0.0]), 1e6), [1e-12 / np.log(2.0), 0.0], **EXACT)


def test_interference_must_be_known(array):
    with pytest.raises(ValueError, match=r"'everyone'; expected one of all, associated, none"):
        radio.sinr(array([1e-9]), 5.0, 1e-14, "everyone")


def test_associated_needs_to_know_who_is_served(array):
    with pytest.raises(ValueError, match=r"needs `served`.*got None"):
        radio.sinr(array([1e-9]), 5.0, 1e-14, "associated")


@pytest.mark.parametrize("interference", ["all", "associated", "none"])
def test_float32_stays_float32(interference):
    gain = torch.tensor([1e-9, 2e-9], dtype=torch.float32)
    sinr = radio.sinr(gain, 5.0, 1e-14, interference, gain > 0.0)
    assert radio.rate_bps(sinr, 1e6).dtype == torch.float32
    plain = radio.sinr(gain.numpy(), 5.0, 1e-14, interference, gain.numpy() > 0.0)
    assert radio.rate_bps(plain, 1e6).dtype == np.float32


def test_the_reach_on_the_ground_is_where_the_distance_is_the_greatest_one():
    reach_m = radio.ground_reach_m(250.0, 150.0)
    assert reach_m == pytest.approx(200.0)
    uav_m, users_m = np.array([10.0, 20.0, 150.0]), np.array([[10.0 + reach_m, 20.0]])
    np.testing.assert_allclose(radio.distance(uav_m, users_m), [250.0], **EXACT)
    assert radio.ground_reach_m(250.0, 250.0) == 0.0
    assert radio.ground_reach_m(250.0, 300.0) == 0.0
