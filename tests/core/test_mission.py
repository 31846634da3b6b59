"""The state of a mission: range, collection, landing."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uav_dc_ros.core import mission

STEP_S, R_MIN_BITS, D_CONS_M = 15.0, 6e6, 250.0


def test_served_is_near_enough_and_not_collected(array):
    distance_m = array([100.0, 250.0, np.nextafter(250.0, 251.0), 100.0, 900.0])
    collected = array([False, False, False, True, True])
    served = mission.served(distance_m, collected, D_CONS_M)
    np.testing.assert_array_equal(served, [True, True, False, False, False])


def test_only_served_users_give_data(array):
    data, collected = mission.collect(
        array([0.0, 5.0, 7e6]),
        array([False, False, True]),
        mission.delivered(array([True, False, False]), array([1e5, 2e5, 3e5]), STEP_S),
        R_MIN_BITS,
    )
    np.testing.assert_array_equal(data, [1.5e6, 5.0, 7e6])
    np.testing.assert_array_equal(collected, [False, False, True])


def test_a_user_that_crosses_r_min_keeps_the_whole_step(array):
    data, collected = mission.collect(
        array([5.9e6]), array([False]), mission.delivered(array([True]), array([1e6]), STEP_S), R_MIN_BITS
    )
    np.testing.assert_array_equal(data, [5.9e6 + 15e6])
    np.testing.assert_array_equal(collected, [True])


def test_exactly_r_min_is_collected(array):
    almost = np.nextafter(R_MIN_BITS, 0.0)
    _, collected = mission.collect(
        array([R_MIN_BITS, almost]), array([False, False]), array([0.0, 0.0]), R_MIN_BITS
    )
    np.testing.assert_array_equal(collected, [True, False])


@settings(derandomize=True, deadline=None, max_examples=60)
@given(seed=st.integers(0, 10_000))
def test_nothing_is_ever_taken_back(seed, array):
    rng = np.random.default_rng(seed)
    data, collected = array(np.zeros(6)), array(np.zeros(6, dtype=bool))
    for _ in range(30):
        distance_m = array(rng.uniform(0.0, 500.0, 6))
        rate_bps = array(rng.uniform(0.0, 3e5, 6) * rng.integers(0, 2, 6))
        served = mission.served(distance_m, collected, D_CONS_M)
        delivered_bits = mission.delivered(served, rate_bps, STEP_S)
        more, now = mission.collect(data, collected, delivered_bits, R_MIN_BITS)
        gained = np.asarray(more - data)
        assert np.all(gained >= 0.0)
        assert np.all(np.asarray(now)[np.asarray(collected)])
        # Collected already, or out of range: not a bit more.
        idle = np.asarray(collected) | (np.asarray(distance_m) > D_CONS_M)
        assert np.all(gained[idle] == 0.0)
        np.testing.assert_array_equal(now, np.asarray(more) >= R_MIN_BITS)
        data, collected = more, now
    # So no user holds more than r_min and one step at the highest rate.
    assert np.all(np.asarray(data) < R_MIN_BITS + 3e5 * STEP_S)


def test_sum_rate_counts_served_users_only(array):
    rate_bps = array([[1.0, 2.0, 4.0], [8.0, 16.0, 32.0]])
    served = array([[True, False, True], [False, False, False]])
    np.testing.assert_array_equal(mission.sum_rate(served, rate_bps), [5.0, 0.0])


@pytest.mark.parametrize("layer", [0, 1, 2])
def test_the_dock_is_a_column_of_cells(layer, array):
    cells = array([[3, 4, layer], [3, 5, layer], [4, 4, layer], [4, 3, layer]])
    np.testing.assert_array_equal(mission.at_dock(cells, (3, 4)), [True, False, False, False])


def test_distance_to_the_dock_is_horizontal_and_in_cells(array):
    cells = array([[0, 0, 0], [0, 0, 2], [3, 4, 1], [6, 4, 0], [3, 0, 0]])
    distance = mission.dock_distance_cells(cells, (3, 4), like=array([0.0]))
    np.testing.assert_allclose(distance, [5.0, 5.0, 0.0, 3.0, 4.0], rtol=1e-15)
