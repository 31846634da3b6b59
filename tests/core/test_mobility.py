"""Users start uniformly by area, and never walk faster than they may."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from uav_dc_ros.core import mobility

DRAW = st.floats(0.0, 1.0, exclude_max=True)
TURNS = [0.0, 0.25, 0.5, 0.75]
COMPASS = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])


def test_users_start_uniformly_by_area(array):
    n = 40_000
    centre = np.array([300.0, -50.0])
    draws = np.random.default_rng(7).random((n, 2))
    away = np.asarray(mobility.scatter(array(np.tile(centre, (n, 1))), 120.0, array(draws))) - centre
    radius = np.hypot(away[:, 0], away[:, 1])
    assert radius.max() <= 120.0 * (1 + 1e-12)
    # A standard deviation is 0.0022; uniform radii would give 0.5, 0.25 and 0.9.
    for share in (0.5, 0.25, 0.9):
        assert abs(np.mean(radius < share * 120.0) - share**2) < 0.01
    for sign_x in (-1, 1):
        for sign_y in (-1, 1):
            quadrant = (away[:, 0] * sign_x > 0) & (away[:, 1] * sign_y > 0)
            assert abs(np.mean(quadrant) - 0.25) < 0.01
            assert abs(np.mean(radius[quadrant] < 60.0) - 0.25) < 0.02


def test_scatter_golden_values(array):
    centres_m = array(np.tile([10.0, 20.0], (4, 1)))
    draws = array([[0.25, turn] for turn in TURNS])
    expected = np.array([10.0, 20.0]) + 50.0 * COMPASS
    np.testing.assert_allclose(mobility.scatter(centres_m, 100.0, draws), expected, atol=1e-12)


def test_scatter_places_each_user_around_its_own_centre(array):
    centres_m = np.array([[0.0, 0.0], [1000.0, 500.0]])
    draws = np.random.default_rng(3).random((3, 5, 2, 2))
    placed = np.asarray(mobility.scatter(array(centres_m), 10.0, array(draws)))
    assert placed.shape == (3, 5, 2, 2)
    assert np.all(np.hypot(*np.moveaxis(placed - centres_m, -1, 0)) <= 10.0 * (1 + 1e-12))


def test_walk_golden_values(array):
    users_m = array(np.tile([10.0, 20.0], (4, 1)))
    draws = array([[0.5, turn] for turn in TURNS])
    # Half of 2 m/s for 15 s is 15 m.
    expected = np.array([10.0, 20.0]) + 15.0 * COMPASS
    np.testing.assert_allclose(mobility.walk(users_m, 2.0, 15.0, draws), expected, atol=1e-12)


@settings(derandomize=True, deadline=None, max_examples=200)
@given(speed=DRAW, turn=DRAW, v_max_mps=st.floats(0.0, 50.0), step_s=st.floats(0.1, 100.0))
def test_nobody_is_faster_than_v_max(speed, turn, v_max_mps, step_s, array):
    before = array([[3.0, -4.0]])
    after = mobility.walk(before, v_max_mps, step_s, array([[speed, turn]]))
    moved_m = float(np.hypot(*np.asarray(after - before)[0]))
    assert moved_m <= v_max_mps * step_s * (1 + 1e-12) + 1e-12
    np.testing.assert_allclose(moved_m, v_max_mps * step_s * speed, atol=1e-9)


def test_speed_is_uniform_and_every_direction_as_likely(array):
    n = 40_000
    draws = np.random.default_rng(11).random((n, 2))
    moved = np.asarray(mobility.walk(array(np.zeros((n, 2))), 2.0, 3.0, array(draws)))
    speed = np.hypot(moved[:, 0], moved[:, 1]) / 3.0
    for share in (0.25, 0.5, 0.75):
        assert abs(np.mean(speed < share * 2.0) - share) < 0.01
    # The mean of the displacement is zero; one axis has a standard deviation of 6 / sqrt(6 n).
    assert np.all(np.abs(moved.mean(axis=0)) < 4 * 6.0 / np.sqrt(6 * n))


def test_v_max_zero_stands_still(array):
    users_m = np.random.default_rng(5).random((4, 2))
    draws = np.random.default_rng(6).random((4, 2))
    np.testing.assert_array_equal(mobility.walk(array(users_m), 0.0, 15.0, array(draws)), users_m)
