"""Obstacles: geometry against shapely, the moves that they leave, ways around them, errors."""

import itertools
import math
from collections import deque

import gymnasium
import msgspec
import numpy as np
import pytest
import shapely
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.worlds import changed
from uav_dc_ros.core import observations, world
from uav_dc_ros.core.grid import MOVES, Action, Grid
from uav_dc_ros.core.obstacles import polygons
from uav_dc_ros.core.obstacles.mesh import triangles
from uav_dc_ros.core.obstacles.moves import UNREACHABLE, Moves
from uav_dc_ros.core.obstacles.prisms import Obstacle
from uav_dc_ros.env.vector_env import DataCollectionVectorEnv
from uav_dc_ros.errors import ScenarioError
from uav_dc_ros.experiments.evaluate.rollout import roll_out
from uav_dc_ros.planners import PLANNERS

TOWER = {"name": "tower", "polygon_m": [[350, 350], [450, 350], [450, 450], [350, 450]], "height_m": 170.0}
ZONE = {"kind": "no_fly", "polygon_m": [[600, -50], [720, -50], [700, 900], [640, 900]]}
LOSS = {"obstruction_loss_db": 20.0}  # of cut links in free space
FIELD = changed("five_clusters_hover", radio=LOSS, obstacles=[TOWER, ZONE])


def star(rng, n, centre, size):
    """A simple polygon: corners around a centre, some of it in and some out."""
    angles = (np.arange(n) + rng.random(n)) / n * 2 * math.pi
    radii = size * (0.2 + 0.8 * rng.random(n))
    corners = np.asarray(centre) + radii[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return tuple(map(tuple, corners.tolist()))


def plain_meets(obstacle, start, end, margin):
    """As `Obstacle.meets` of one path, by shapely."""
    low, high = obstacle.base_m - margin, obstacle.top_m + margin
    (*_, z0), (*_, z1) = start, end
    shares = [0.0, 1.0]
    if z0 != z1:
        shares = sorted(min(max((z - z0) / (z1 - z0), 0.0), 1.0) for z in (low, high))
    if not (min(z0, z1) < high and max(z0, z1) > low):
        return False
    points = [[a + share * (b - a) for a, b in zip(start[:2], end[:2], strict=True)] for share in shares]
    path = shapely.Point(points[0]) if points[0] == points[1] else shapely.LineString(points)
    area = shapely.Polygon(obstacle.polygon_m)
    return path.distance(area) < margin if margin else path.intersects(area)


def test_paths_among_prisms_are_those_of_a_geometry_library():
    rng = np.random.default_rng(0)
    found = 0
    for case in range(400):
        polygon = star(rng, int(rng.integers(3, 9)), rng.random(2) * 40, 45.0)
        base = float(rng.choice([0.0, 30.0 * rng.random()]))
        obstacle = Obstacle(polygon_m=polygon, base_m=base, height_m=base + 40.0 * rng.random() + 1.0)
        starts = rng.random((10, 3)) * [60, 60, 90]
        ends = rng.random((10, 3)) * [60, 60, 90]
        ends[:3, 2], ends[3:5, :2] = starts[:3, 2], starts[3:5, :2]  # level, and straight up or down
        margin = float(case % 2 * 10.0 * rng.random())
        ours = obstacle.meets(starts, ends, margin)
        theirs = [
            plain_meets(obstacle, *ways, margin) for ways in zip(starts.tolist(), ends.tolist(), strict=True)
        ]
        np.testing.assert_array_equal(ours, theirs)
        found += sum(theirs)
    assert 600 < found < 3400


def test_a_path_that_touches_meets_and_one_at_the_margin_does_not():
    cube = Obstacle(polygon_m=((0, 0), (10, 0), (10, 10), (0, 10)), height_m=10.0)
    along_wall, on_roof, past_corner = (
        ((0, 10, 5), (10, 10, 5)),
        ((5, 5, 10), (5, 9, 10)),
        ((-5, 5, 5), (5, -5, 5)),
    )
    for start, end in (along_wall, on_roof, past_corner):
        assert cube.meets(np.asarray(start, float), np.asarray(end, float), 0.0)
    above, beside = ((5.0, 5, 13), (5, 9, 13)), ((13.0, 0, 5), (13, 10, 5))
    for start, end in (above, beside):
        assert not cube.meets(np.asarray(start), np.asarray(end), 3.0)
        assert cube.meets(np.asarray(start), np.asarray(end), 3.1)


small = st.integers(0, 4)


@given(st.lists(st.tuples(small, small), min_size=3, max_size=7))
@settings(max_examples=300, deadline=None)
def test_a_polygon_is_valid_where_a_geometry_library_has_it_so(corners):
    repeats = any(a == b for a, b in itertools.pairwise([*corners, corners[0]]))
    valid = not repeats and shapely.Polygon(corners).is_valid and shapely.Polygon(corners).area > 0
    assert (polygons.problem(tuple(corners)) is None) is valid


def test_triangles_of_pictures_fill_the_polygon():
    rng = np.random.default_rng(3)
    for _ in range(60):
        polygon = star(rng, int(rng.integers(3, 20)), (0.0, 0.0), 50.0)[:: rng.choice([1, -1])]
        parts = [shapely.Polygon([polygon[i] for i in corners]) for corners in triangles(polygon)]
        area = shapely.Polygon(polygon)
        assert len(parts) == len(polygon) - 2
        assert sum(part.area for part in parts) == pytest.approx(area.area)
        assert shapely.union_all(parts).symmetric_difference(area).area < 1e-6 * area.area


def test_a_move_has_an_effect_where_its_path_is_free(array):
    """Cell by cell and move by move, against shapely."""
    rng = np.random.default_rng(1)
    grid = Grid(n_x=6, n_y=5, n_z=3, cell_m=20.0, altitude_min_m=15.0, altitude_step_m=10.0)
    obstacles = tuple(
        Obstacle(
            polygon_m=star(rng, 5, rng.random(2) * [100, 80], 25.0),
            base_m=float(rng.choice([0.0, 20.0])),
            height_m=float(rng.choice([22.0, 31.0])),
            clearance_m=float(rng.choice([0.0, 4.0])),
        )
        for _ in range(4)
    )
    moves = Moves(grid, obstacles)
    cells = np.asarray([*np.ndindex(grid.shape)])
    expected = np.ones((len(cells), len(Action)), bool)
    for i, cell in enumerate(cells):
        for action, offset in enumerate(MOVES[:-1]):
            to = cell + offset
            ends = [grid.centre_m(one, like=np.zeros(1)).tolist() for one in (cell, to)]
            inside = ((to >= 0) & (to < grid.shape)).all()
            expected[i, action] = inside and not any(plain_meets(o, *ends, o.clearance_m) for o in obstacles)
    np.testing.assert_array_equal(np.asarray(moves.valid(array(cells))), expected)
    assert 0.3 < expected.mean() < 0.8
    for action in Action:
        each = array(np.full(len(cells), int(action)))
        after = moves.apply(array(cells), each, grid.move(array(cells), each))
        target = np.where(expected[:, action, None], cells + MOVES[action], cells)
        np.testing.assert_array_equal(np.asarray(after), target)


def test_steps_from_are_those_of_a_plain_search():
    moves = FIELD.moves
    first = FIELD.start_cell
    steps, waiting = {first: 0}, deque([first])
    while waiting:
        cell = waiting.popleft()
        for action in Action:
            after = tuple(world.move(FIELD, np.asarray(cell), np.asarray(int(action))).tolist())
            if after not in steps:
                steps[after] = steps[cell] + 1
                waiting.append(after)
    ours = moves.steps_from(np.asarray([first]))
    expected = np.full(FIELD.grid.shape, UNREACHABLE)
    for cell, n in steps.items():
        expected[cell] = n
    np.testing.assert_array_equal(ours, expected)
    assert 0 < (~moves.free).sum() == (ours == UNREACHABLE).sum()


def test_the_environment_masks_moves_without_effect_and_never_enters_an_obstacle():
    env = DataCollectionVectorEnv(8, FIELD)
    _, info = env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(2 * FIELD.mission.max_steps):
        before, mask = info["cell"], info["action_mask"]
        assert mask.dtype == np.int8
        actions = rng.integers(7, size=8)
        *_, info = env.step(actions)
        moved = (info["cell"] != before).any(axis=-1)
        steps = info["step"] > 0  # a world that restarts ignores its action
        can_move = mask[np.arange(8), actions].astype(bool) & (actions != Action.HOVER)
        np.testing.assert_array_equal(moved[steps], can_move[steps])
        assert FIELD.moves.free[tuple(info["cell"].T)].all()
    single = gymnasium.make("uav_dc_ros/DataCollection-v0", scenario=FIELD)
    _, info = single.reset(seed=0)
    assert single.action_space.sample(info["action_mask"]) in np.flatnonzero(info["action_mask"])
    assert "action_mask" not in DataCollectionVectorEnv(1).reset(seed=0)[1]


def test_numpy_and_torch_fly_the_same_cells():
    rng = np.random.default_rng(2)
    draws, actions = rng.random((61, 16, 50, 2)), rng.integers(7, size=(60, 16))
    ours, theirs = world.BatchWorld(FIELD, draws[0]), world.BatchWorld(FIELD, torch.from_numpy(draws[0]))
    for action, walk in zip(actions, draws[1:], strict=True):
        ours.step(action, walk)
        theirs.step(torch.from_numpy(action), torch.from_numpy(walk))
        np.testing.assert_array_equal(ours.state.cell, theirs.state.cell)


@pytest.mark.parametrize("kind", ["position", "mission", "map"])
def test_an_observation_holds_its_cell(kind, array):
    cells = np.asarray([*np.ndindex(FIELD.grid.shape)])
    n, u = len(cells), FIELD.n_users
    values = {
        "step": np.zeros(n, np.int64),
        "data_bits": np.zeros((n, u)),
        "collected": np.zeros((n, u), bool),
    }
    arrays = {name: array(value) for name, value in ({"cell": cells} | values).items()}
    observation = observations.encode(kind, FIELD, **arrays)
    np.testing.assert_array_equal(np.asarray(observations.cell(FIELD, observation)), cells)


@pytest.mark.parametrize("planner", ["nearest", "tour"])
def test_planners_fly_around_and_land(planner):
    missions = roll_out(FIELD, PLANNERS[planner](FIELD), range(10))
    assert missions.landed.all()
    assert missions.users_collected.mean() > 0.9 * FIELD.n_users


def test_obstacles_are_part_of_the_world_and_survive_as_plain_values():
    free = changed("five_clusters_hover")
    assert FIELD.fingerprint != free.fingerprint
    assert "obstacles" not in msgspec.to_builtins(free)
    again = changed("five_clusters_hover", radio=LOSS, obstacles=msgspec.to_builtins(FIELD)["obstacles"])
    assert again == FIELD
    assert again.fingerprint == FIELD.fingerprint
    assert free.moves is None


def box(x0, y0, x1, y1, **values):
    """A no-fly zone, or with a height a building."""
    kind = {} if "height_m" in values or "kind" in values else {"kind": "no_fly"}
    return {"polygon_m": [[x0, y0], [x1, y0], [x1, y1], [x0, y1]], **kind, **values}


SQUARE = box(300, 300, 400, 400)["polygon_m"]
CROSSED = [SQUARE[i] for i in (0, 2, 1, 3)]
UNKNOWN = "unknown key obstacles[0].height = 3.0; did you mean 'height_m'?"
CROSSES = "obstacles[1]: polygon_m: the edge after corner 0 crosses that after corner 2; expected edges"
REPEATS = "obstacles[0]: polygon_m: corner 0 repeats the one before it; expected different corners"
FOLDED = "obstacles[0]: polygon_m: the edges at corner 1 lie on one another; expected a polygon with an"
OUTSIDE = (
    "obstacles[0] 'hill': its polygon lies outside the field; expected a part of it within x -50 to 1050"
)
START = "obstacles[0] 'pad': it is over mission.start_m = [0.0, 0.0, 200.0]; expected a free way for the take"
DOCK = "obstacles[0]: it is over mission.dock_m = [1000.0, 1000.0]; expected a free way for the landing from"
NO_WAY = "mission.dock_m = [1000.0, 1000.0]; expected a way between the obstacles to it from mission.start_m"


@pytest.mark.parametrize(
    ("obstacles", "message"),
    [
        ([{"polygon_m": SQUARE, "height": 3.0}], UNKNOWN),
        ([{"height_m": 3.0}], "missing key obstacles[0].polygon_m"),
        (
            [{"polygon_m": SQUARE}],
            "obstacles[0]: missing key height_m; expected the altitude of the building's",
        ),
        ([{"polygon_m": SQUARE, "height_m": 0.0}], "obstacles[0].height_m = 0.0; expected float > 0.0"),
        (
            [{"polygon_m": SQUARE[:2], "height_m": 9.0}],
            "obstacles[0].polygon_m = [[300, 300], [400, 300]]; exp",
        ),
        ([box(0, 0, 9, 9, kind="house")], "obstacles[0].kind = 'house'; expected one of building, no_fly"),
        (
            [box(0, 0, 9, 9, height_m=9.0, base_m=9.0)],
            "obstacles[0]: base_m = 9; expected less than height_m",
        ),
        ([TOWER, {"polygon_m": CROSSED, "height_m": 9.0}], CROSSES),
        ([{"polygon_m": [*SQUARE, SQUARE[0]], "height_m": 9.0}], REPEATS),
        ([{"polygon_m": [[0, 300], [100, 300], [50, 300]], "height_m": 9.0}], FOLDED),
        ([box(2000, 300, 2100, 400, height_m=9.0, name="hill")], OUTSIDE),
        ([box(-9, -9, 9, 9, height_m=3.0, name="pad")], START),
        ([box(300, 300, 400, 400, height_m=9.0, clearance_m=1000.0, name="pad")], START),
        ([box(980, 980, 1020, 1020)], DOCK),
        ([box(640, -90, 660, 1090)], NO_WAY),
        ([box(640, -90, 660, 990), box(740, 10, 760, 1090)], "mission.max_steps = 39; expected at least 40"),
    ],
)
def test_errors_name_the_obstacle_and_what_was_expected(obstacles, message):
    steps = {"max_steps": 39} if "max_steps" in message else {}
    with pytest.raises(ScenarioError) as caught:
        changed("five_clusters_hover", obstacles=obstacles, mission=steps, radio=LOSS)
    assert str(caught.value).startswith(f"test: {message}")
