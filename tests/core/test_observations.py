"""What an agent sees. Its `mission` part may grow: held here are its promises, not its numbers."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uav_dc_ros.core import observations

KINDS = ("position", "mission", "map")


def encode(kind, scenario, array, *, cell, step=0, data_bits=0.0, collected=False):
    """An observation; a number for data or collected holds for every user."""
    shape = (*np.shape(cell)[:-1], scenario.n_users)
    return observations.encode(
        kind,
        scenario,
        cell=array(cell),
        step=array(np.broadcast_to(step, shape[:-1])),
        data_bits=array(np.broadcast_to(np.asarray(data_bits, dtype=np.float64), shape)),
        collected=array(np.broadcast_to(collected, shape)),
    )


@pytest.mark.parametrize(
    ("cell", "expected"),
    [
        ([0, 0, 0], [0.0, 0.0, 0.0]),
        ([10, 10, 2], [1.0, 1.0, 1.0]),
        ([10, 0, 0], [1.0, 0.0, 0.0]),
        ([3, 7, 1], [0.3, 0.7, 0.5]),
    ],
    ids=str,
)
def test_position_is_the_cell_scaled(three, array, cell, expected):
    seen = encode("position", three, array, cell=cell, step=7, data_bits=3e6, collected=True)
    np.testing.assert_allclose(seen, expected, rtol=1e-6)


def test_a_grid_with_one_layer_has_altitude_zero(three, changed, array):
    flat = changed(three, grid={"n_z": 1, "altitude_min_m": 200.0})
    np.testing.assert_allclose(encode("position", flat, array, cell=[5, 0, 0]), [0.5, 0.0, 0.0])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("batch", [(), (3,), (2, 3)], ids=str)
def test_shape_and_type(three, array, kind, batch):
    cells = np.random.default_rng(1).integers(0, three.grid.shape, (*batch, 3))
    seen = encode(kind, three, array, cell=cells)
    assert tuple(seen.shape) == (*batch, observations.size(kind, three))
    assert seen.dtype == array([0.0], np.float32).dtype
    # Each row is what its own mission alone would see.
    for index in np.ndindex(batch):
        np.testing.assert_array_equal(seen[index], encode(kind, three, array, cell=cells[index]))


@pytest.mark.parametrize("kind", ["mission", "map"])
def test_a_longer_encoding_begins_with_the_shorter_one(three, array, kind):
    shorter = KINDS[KINDS.index(kind) - 1]
    state = {"cell": [4, 2, 1], "step": 9, "data_bits": 2e6}
    seen, part = encode(kind, three, array, **state), encode(shorter, three, array, **state)
    assert seen.shape[-1] > part.shape[-1]
    np.testing.assert_array_equal(seen[: part.shape[-1]], part)


@settings(derandomize=True, deadline=None, max_examples=60)
@given(seed=st.integers(0, 10_000))
def test_mission_stays_between_zero_and_one(seed, three, array):
    rng = np.random.default_rng(seed)
    seen = encode(
        "mission",
        three,
        array,
        cell=rng.integers(0, three.grid.shape),
        step=rng.integers(0, three.mission.max_steps + 1),
        data_bits=rng.uniform(0.0, 5.0, three.n_users) * three.mission.r_min_bits,
        collected=rng.random(three.n_users) < 0.5,
    )
    seen = np.asarray(seen)
    assert np.all((seen >= 0.0) & (seen <= 1.0))


def test_mission_shows_the_remaining_steps(three, array):
    """One number runs from 1 to 0 over a mission in which nothing else happens."""
    limit = three.mission.max_steps
    steps = [0, limit // 3, limit]
    seen = np.asarray(encode("mission", three, array, cell=[[5, 5, 1]] * 3, step=steps))
    (moving,) = np.flatnonzero(np.ptp(seen, axis=0) > 0.0)
    assert moving >= 3
    np.testing.assert_allclose(seen[:, moving], 1.0 - np.array(steps) / limit, rtol=1e-6)


@pytest.mark.parametrize("what", ["data_bits", "collected"])
def test_mission_shows_how_far_each_cluster_has_come(three, array, what):
    """A cluster's progress moves numbers of its own, upwards; another cluster's moves others."""
    nothing = np.asarray(encode("mission", three, array, cell=[5, 5, 1]))
    moved = []
    for cluster in range(three.n_clusters):
        members = three.user_cluster == cluster
        one = members & (np.cumsum(members) == 1)
        value = 0.5 * three.mission.r_min_bits if what == "data_bits" else True
        seen_one = np.asarray(encode("mission", three, array, cell=[5, 5, 1], **{what: one * value}))
        seen_all = np.asarray(encode("mission", three, array, cell=[5, 5, 1], **{what: members * value}))
        changed = np.flatnonzero(seen_all != nothing)
        assert len(changed) > 0
        assert np.all(seen_all[changed] > seen_one[changed])
        assert np.all(seen_one[changed] > nothing[changed])
        moved.append(set(changed.tolist()))
    assert all(not a & b for i, a in enumerate(moved) for b in moved[:i])


def test_map_shows_the_way_to_each_cluster_and_to_the_dock(three, array):
    goals_m = [*three.users.cluster_centres_m, three.mission.dock_m]
    for cell in ([0, 0, 0], [10, 10, 2], [2, 3, 1], [5, 7, 0]):
        seen = np.asarray(encode("map", three, array, cell=cell))
        # East and north, as a share of the grid: 1000 m, whatever the altitude.
        expected = [(x - 100.0 * cell[0], y - 100.0 * cell[1]) for x, y in goals_m]
        np.testing.assert_allclose(
            seen[-2 * len(goals_m) :], np.ravel(expected) / 1000.0, rtol=1e-6, atol=1e-7
        )


def test_map_of_a_grid_that_is_not_square(three, changed, array):
    scenario = changed(three, grid={"n_y": 21, "cell_m": 50.0, "n_x": 41})
    seen = np.asarray(encode("map", scenario, array, cell=[4, 2, 0]))
    # From (200, 100): the dock at (1000, 1000) is 800 of 2000 m east and 900 of 1000 m north.
    np.testing.assert_allclose(seen[-2:], [0.4, 0.9], rtol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_float32_data_and_float64_data_look_the_same(three, array, kind):
    """A population in single precision trains what a node flies in double."""
    data = np.linspace(0.0, 2.0 * three.mission.r_min_bits, three.n_users)
    both = [
        np.asarray(
            observations.encode(
                kind,
                three,
                cell=array([1, 2, 0]),
                step=array(5),
                data_bits=array(data, dtype),
                collected=array(data >= three.mission.r_min_bits),
            )
        )
        for dtype in (np.float32, np.float64)
    ]
    assert both[0].dtype == np.float32
    np.testing.assert_allclose(both[0], both[1], rtol=1e-6, atol=1e-7)
