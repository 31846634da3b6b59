"""Seven moves in ENU, the borders, and metres to cells and back."""

import itertools

import numpy as np
import pytest

from uav_dc_ros.core.grid import ACTION_LABELS, Action, Grid

GRID = Grid(n_x=5, n_y=4, n_z=3, cell_m=100.0, altitude_min_m=100.0, altitude_step_m=50.0)
# East, north and up, as the paper's and the messages' words have it.
SIGNS = {
    "left": (-1, 0, 0),
    "right": (1, 0, 0),
    "forward": (0, 1, 0),
    "backward": (0, -1, 0),
    "upward": (0, 0, 1),
    "downward": (0, 0, -1),
    "hover": (0, 0, 0),
}


def test_seven_actions_in_the_papers_order():
    assert tuple(SIGNS) == ACTION_LABELS
    assert [int(action) for action in Action] == list(range(7))
    assert [action.label for action in Action] == list(SIGNS)


@pytest.mark.parametrize("action", Action, ids=lambda action: action.label)
def test_a_move_in_the_open(action, array):
    after = GRID.move(array([2, 2, 1]), array(int(action)))
    np.testing.assert_array_equal(after, np.array([2, 2, 1]) + SIGNS[action.label])


def test_every_cell_and_every_action_stays_on_the_grid(array):
    cells = np.array(list(itertools.product(range(5), range(4), range(3))))
    for action in Action:
        after = np.asarray(GRID.move(array(cells), array(np.full(len(cells), int(action)))))
        target = cells + SIGNS[action.label]
        inside = np.all((target >= 0) & (target < GRID.shape), axis=1)
        # Off the grid means: stays where it was, in all three directions.
        np.testing.assert_array_equal(after, np.where(inside[:, None], target, cells))
        if action is not Action.HOVER:
            assert 0 < inside.sum() < len(cells)


def test_each_uav_of_a_batch_makes_its_own_move(array):
    cells = np.array([[[0, 0, 0], [4, 3, 2], [2, 2, 1]], [[2, 0, 1], [0, 3, 0], [1, 1, 2]]])
    actions = np.array([[1, 3, 6], [3, 2, 5]])
    expected = [[[1, 0, 0], [4, 2, 2], [2, 2, 1]], [[2, 0, 1], [0, 3, 0], [1, 1, 1]]]
    after = GRID.move(array(cells), array(actions))
    np.testing.assert_array_equal(after, expected)
    assert after.dtype == array(cells).dtype


def test_a_grid_of_one_cell_leaves_nowhere_to_go(array):
    grid = Grid(n_x=1, n_y=1, n_z=1, cell_m=1.0, altitude_min_m=1.0, altitude_step_m=1.0)
    for action in Action:
        np.testing.assert_array_equal(grid.move(array([0, 0, 0]), array(int(action))), [0, 0, 0])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_centres_golden_values(array, dtype):
    cells = array([[0, 0, 0], [4, 3, 2], [1, 2, 1]])
    centres = GRID.centre_m(cells, like=array([0.0], dtype))
    np.testing.assert_array_equal(centres, [[0, 0, 100], [400, 300, 200], [100, 200, 150]])
    assert centres.dtype == array([0.0], dtype).dtype


def test_metres_to_cells_and_back(array):
    for cell in itertools.product(range(5), range(4), range(3)):
        x_m, y_m, z_m = (float(v) for v in GRID.centre_m(array(cell), like=array([0.0])))
        assert GRID.cell_at((x_m, y_m, z_m)) == cell


def test_metres_to_cells_with_a_spacing_that_is_no_binary_fraction():
    grid = Grid(n_x=50, n_y=50, n_z=20, cell_m=0.1, altitude_min_m=0.3, altitude_step_m=0.7)
    for i, j, k in itertools.product((0, 3, 7, 49), (1, 29), (0, 3, 19)):
        assert grid.cell_at((i * 0.1, j * 0.1, 0.3 + k * 0.7)) == (i, j, k)


@pytest.mark.parametrize(
    "position_m",
    [
        (50.0, 0.0, 100.0),
        (0.0, 0.01, 100.0),
        (0.0, 0.0, 149.0),
        (-100.0, 0.0, 100.0),
        (500.0, 0.0, 100.0),
        (0.0, 400.0, 100.0),
        (0.0, 0.0, 50.0),
        (0.0, 0.0, 250.0),
    ],
    ids=str,
)
def test_no_cell_has_its_centre_there(position_m):
    assert GRID.cell_at(position_m) is None


def test_a_vanishing_spacing_has_no_cell_and_no_overflow():
    grid = Grid(n_x=5, n_y=5, n_z=5, cell_m=5e-324, altitude_min_m=1.0, altitude_step_m=1.0)
    assert grid.cell_at((1000.0, 0.0, 1.0)) is None
