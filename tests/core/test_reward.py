"""The reward, its two shapes of R_plus, and the form that telescopes."""

import numpy as np
import pytest

from uav_dc_ros.core import reward, world
from uav_dc_ros.core.grid import Action


def test_binary_pays_at_the_dock_only(array):
    np.testing.assert_array_equal(reward.r_plus(array([0.0, 1.0, 0.5, 14.1]), "binary"), [1.0, 0.0, 0.0, 0.0])


def test_exponential_is_in_cells(array):
    cells = [0.0, 1.0, 2.0, np.sqrt(2.0), 14.0]
    expected = [1.0, 0.36787944117144233, 0.1353352832366127, 0.2431167344342142, 8.315287191035679e-07]
    np.testing.assert_allclose(reward.r_plus(array(cells), "exponential"), expected, rtol=1e-14)


def test_the_paper_s_reward_by_hand(array):
    # beta / (M K) sum(data) / scale + zeta R_plus = 2 * (0.5 + 1 + 0 + 0.5) / 4 + 3 * 0.25
    data_bits = array([[3e6, 6e6, 0.0, 3e6]])
    np.testing.assert_allclose(reward.total(data_bits, array([0.25]), 2.0, 3.0, 6e6), [1.75], rtol=1e-15)


def test_each_world_may_have_its_own_weights(array):
    data_bits = array([[6e6, 6e6], [6e6, 0.0], [0.0, 0.0]])
    total = reward.total(
        data_bits, array([1.0, 0.5, 1.0]), array([1.0, 2.0, 4.0]), array([4.0, 2.0, 1.0]), 6e6
    )
    np.testing.assert_allclose(total, [1.0 + 4.0, 1.0 + 1.0, 1.0], rtol=1e-15)


def test_forms(array):
    total, before = array([2.0, 1.0]), array([0.5, 1.5])
    np.testing.assert_array_equal(reward.step_reward(total, before, "immediate"), [1.5, -0.5])
    np.testing.assert_array_equal(reward.step_reward(total, before, "episode"), [2.0, 1.0])


def test_each_world_may_have_its_own_shape_and_form(array):
    """As with the names, world by world, and with the dtype of the numbers."""
    for dtype in (np.float32, np.float64):
        cells = array([0.0, 0.0, 2.0, 2.0, 0.5], dtype)
        exponential = array([True, False, True, False, False])
        found = reward.r_plus(cells, exponential)
        assert found.dtype == cells.dtype
        for i, shape in enumerate(["exponential", "binary", "exponential", "binary", "binary"]):
            assert found[i] == reward.r_plus(cells, shape)[i]
        total, before = array([2.0, 1.0, 3.0], dtype), array([0.5, 1.5, 3.0], dtype)
        earned = reward.step_reward(total, before, array([True, False, True]))
        assert earned.dtype == total.dtype
        np.testing.assert_array_equal(earned, [2.0, -0.5, 3.0])


@pytest.mark.parametrize("r_plus", ["binary", "exponential"])
def test_immediate_rewards_sum_to_the_episode_reward(three, changed, array, r_plus):
    """Over a mission, at every step: the sum of r1 so far, r2, and r^t are one number."""
    scenarios = {
        form: changed(three, reward={"form": form, "r_plus": r_plus, "beta": 2.0, "zeta": 1.5})
        for form in ("immediate", "episode")
    }
    rng = np.random.default_rng(2)
    first = rng.random((4, three.n_users, 2))
    states = {form: world.initial(scenario, array(first)) for form, scenario in scenarios.items()}
    so_far = np.zeros(4)
    has_fallen = False
    for _ in range(three.mission.max_steps):
        draws = rng.random(first.shape)
        # Mostly towards the dock, so that data and R_plus both come in.
        actions = rng.choice(
            [Action.RIGHT, Action.FORWARD, Action.LEFT, Action.DOWNWARD], 4, p=[0.4, 0.4, 0.1, 0.1]
        )
        rewards = {}
        for form, scenario in scenarios.items():
            states[form], outcome = world.step(scenario, states[form], array(actions), array(draws))
            rewards[form] = np.asarray(outcome.reward)
        so_far = so_far + rewards["immediate"]
        has_fallen |= bool((rewards["immediate"] < 0.0).any())
        np.testing.assert_allclose(so_far, rewards["episode"], rtol=1e-12, atol=1e-12)
        np.testing.assert_array_equal(rewards["episode"], states["episode"].total_reward)
        np.testing.assert_array_equal(states["immediate"].total_reward, states["episode"].total_reward)
    assert so_far.max() > 0.5
    assert has_fallen, "a step away from the dock should have cost something"
