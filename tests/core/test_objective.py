"""The objective of a mission."""

import math

import numpy as np
import pytest

from uav_dc_ros.core.objective import DEFAULT_WEIGHT, check_weight, objective
from uav_dc_ros.errors import UavDcError


def test_a_mission_that_lands_has_both_shares_and_any_other_has_nothing(array):
    found = objective(
        array([50.0, 25.0, 25.0, 0.0, 50.0]),
        array([20.0, 20.0, 40.0, 40.0, math.nan]),
        array([True, True, True, True, False]),
        n_users=50,
        max_steps=40,
        weight=0.8,
    )
    np.testing.assert_allclose(found, [0.9, 0.5, 0.4, 0.0, 0.0], rtol=1e-12)


def test_at_its_ends_the_weight_counts_one_share_only(array):
    both = array([10.0, 10.0, 5.0]), array([8.0, 4.0, 4.0]), array([True, True, True])
    np.testing.assert_allclose(objective(*both, n_users=10, max_steps=8, weight=1.0), [1.0, 1.0, 0.5])
    np.testing.assert_allclose(objective(*both, n_users=10, max_steps=8, weight=0.0), [0.0, 0.5, 0.5])


def test_by_default_a_tenth_of_the_users_is_worth_the_whole_time(array):
    found = objective(array([9.0, 10.0]), array([0.0, 20.0]), array([True, True]), n_users=10, max_steps=20)
    np.testing.assert_allclose(found[0], found[1])
    assert math.isclose(DEFAULT_WEIGHT, 10 / 11)


@pytest.mark.parametrize("weight", [-0.01, 1.01, math.nan, math.inf])
def test_a_weight_is_between_0_and_1(weight):
    with pytest.raises(UavDcError, match=r"^--objective \S+; expected a weight between 0 .* and 1"):
        check_weight(weight, "--objective")
