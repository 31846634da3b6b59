"""Pictures of missions."""

import numpy as np
import pytest
from gymnasium.error import ResetNeeded

from tests.support.worlds import changed, tiny
from uav_dc_ros.env.gym_env import DataCollectionEnv


def test_a_picture_follows_the_mission():
    env = DataCollectionEnv("five_clusters_hover", render_mode="rgb_array")
    env.reset(seed=0)
    start = env.render()
    assert start.dtype == np.uint8
    assert start.ndim == 3
    assert start.shape[2] == 3
    np.testing.assert_array_equal(start, env.render())
    env.step(1)
    assert not np.array_equal(start, env.render())


def test_obstacles_are_in_the_picture():
    zone = {"kind": "no_fly", "polygon_m": [[600.0, 300.0], [700.0, 300.0], [700.0, 500.0], [600.0, 500.0]]}
    pictures = []
    for obstacles in ([], [zone]):
        env = DataCollectionEnv(changed("five_clusters_hover", obstacles=obstacles), render_mode="rgb_array")
        env.reset(seed=0)
        pictures.append(env.render().astype(int))
    rows, columns = np.nonzero(np.abs(pictures[0] - pictures[1]).sum(axis=-1))
    height, width = np.ptp(rows), np.ptp(columns)
    assert height == pytest.approx(2 * width, rel=0.05)  # the zone, and nothing else


@pytest.mark.parametrize(("n_x", "n_y"), [(9, 9), (13, 10), (20, 6), (8, 12)])
def test_a_field_of_any_shape_leaves_no_blank_bands(n_x, n_y):
    env = DataCollectionEnv(tiny(grid={"n_x": n_x, "n_y": n_y}), render_mode="rgb_array")
    env.reset(seed=0)
    picture = env.render()
    blank = (picture == picture[0, 0]).all(axis=(1, 2))
    edges = np.flatnonzero(np.diff(np.concatenate(([False], blank, [False])).astype(int)))
    assert np.max(edges[1::2] - edges[::2]) < 0.06 * picture.shape[1], "rows, of its width"


def test_the_last_picture_can_still_be_made_when_the_mission_is_over():
    env = DataCollectionEnv(tiny(mission={"max_steps": 4}), render_mode="rgb_array")
    env.reset(seed=0)
    for action in (1, 1, 2, 2):
        env.step(action)
    assert env.render().any()


def test_there_is_no_picture_before_a_mission():
    with pytest.raises(ResetNeeded):
        DataCollectionEnv(tiny(), render_mode="rgb_array").render()


def test_without_a_render_mode_there_is_a_warning():
    env = DataCollectionEnv(tiny())
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="rgb_array"):
        assert env.render() is None
