"""The reward, its data in two readings, its two shapes of R_plus, and the form that telescopes."""

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


def test_the_data_that_counts(array):
    """Of two users in two worlds, by name and world by world."""
    delivered, collected = array([[1e6, 0.0], [2e6, 3e6]]), array([[4e6, 5e6], [2e6, 7e6]])
    np.testing.assert_array_equal(reward.counted_data(delivered, collected, "step"), delivered)
    np.testing.assert_array_equal(reward.counted_data(delivered, collected, "so_far"), collected)
    counted = reward.counted_data(delivered, collected, array([True, False]))
    np.testing.assert_array_equal(counted, [[1e6, 0.0], [2e6, 7e6]])
    assert counted.dtype == collected.dtype


def test_a_mission_s_reward_by_hand(array):
    """Of three steps: r^t at the end, or its mean."""
    totals = array([[3.0, 3.0], [1.0, 1.0], [5.0, 5.5]])
    expected = {
        "so_far": [[3.0, 3.0], [1.0, 1.0], [5.0, 5.5]],
        "step": [[3.0, 3.0], [2.0, 2.0], [3.0, 9.5 / 3]],
    }
    for data, of_mission in expected.items():
        found = array([0.0, 0.0])
        for n, (total, now) in enumerate(zip(totals, of_mission, strict=True), 1):
            found = reward.mission_reward(found, total, n, data)
            np.testing.assert_allclose(found, now, rtol=1e-15)
    mixed = reward.mission_reward(totals[0], totals[1], 2, array([True, False]))
    np.testing.assert_array_equal(mixed, [2.0, 1.0])
    assert reward.MISSION_REWARD.keys() == reward.DATA.keys() == expected.keys()


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


@pytest.mark.parametrize("data", ["so_far", "step"])
@pytest.mark.parametrize("r_plus", ["binary", "exponential"])
def test_immediate_rewards_sum_to_the_episode_reward(three, changed, array, r_plus, data):
    """Over a mission, at every step: the sum of r1 so far, r2, and r^t are one number.

    With the data of the step every bit counts once in the sum of r2.
    """
    scenarios = {
        form: changed(three, reward={"form": form, "r_plus": r_plus, "beta": 2.0, "zeta": 1.5, "data": data})
        for form in ("immediate", "episode")
    }
    rng = np.random.default_rng(2)
    first = rng.random((4, three.n_users, 2))
    states = {form: world.initial(scenario, array(first)) for form, scenario in scenarios.items()}
    so_far, by_place, episode_return = np.zeros(4), np.zeros(4), np.zeros(4)
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
        episode_return += rewards["episode"]
        without_data = array(np.zeros((4, 1)))
        by_place += np.asarray(world.total_reward(scenarios["episode"], states["episode"].cell, without_data))
        np.testing.assert_array_equal(states["immediate"].total_reward, states["episode"].total_reward)
    if data == "step":
        collected = np.asarray(states["episode"].data_bits).mean(axis=-1) / three.reward.data_scale_bits
        np.testing.assert_allclose(episode_return, 2.0 * collected + by_place, rtol=1e-12)
    assert (so_far if data == "so_far" else episode_return).max() > 0.5
    assert has_fallen, "a step away from the dock should have cost something"
