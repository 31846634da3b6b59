"""Lines of sight among buildings, against shapely; and what a building does to each channel."""

import msgspec
import numpy as np
import pytest
import shapely
import torch

from tests.core.test_obstacles import LOSS, TOWER, box, star
from tests.support.worlds import changed
from uav_dc_ros import scenarios
from uav_dc_ros.core import channel, radio, world
from uav_dc_ros.core.obstacles import Buildings, Obstacle
from uav_dc_ros.core.scenario import from_values
from uav_dc_ros.errors import ScenarioError

CARRIER = {"carrier_hz": 2e9, "line_of_sight": "mean_gain"}
COMMON = {"bandwidth_hz": 1e6, "tx_power_w": 5.0, "noise_power_dbm": -110.0, "interference": "none"}


def town(rng, n, size_m=500.0):
    """Buildings anywhere in a square, some of them on stilts."""
    return tuple(
        Obstacle(
            polygon_m=star(rng, int(rng.integers(3, 9)), rng.random(2) * size_m, 60.0),
            base_m=float(rng.choice([0.0, 20.0])),
            height_m=float(25.0 + 150.0 * rng.random()),
        )
        for _ in range(n)
    )


def plain_cut(obstacles, uav_m, user_m):
    """As `Buildings.cut` of one link, by shapely."""
    for one in obstacles:
        first, last = one.base_m / uav_m[2], min(one.top_m / uav_m[2], 1.0)
        a, b = (user_m + share * (uav_m[:2] - user_m) for share in (first, last))
        part = shapely.Point(a) if (a == b).all() else shapely.LineString([a, b])
        if first <= 1.0 and part.intersects(shapely.Polygon(one.polygon_m)):
            return True
    return False


def test_thousands_of_links_are_cut_where_a_geometry_library_has_it_so():
    rng = np.random.default_rng(0)
    found = []
    for _ in range(60):
        obstacles = town(rng, 6)
        uav_m, users_m = rng.random(3) * [500, 500, 200], rng.random((50, 2)) * 500
        users_m[0] = uav_m[:2]  # right below the UAV
        ours = Buildings(obstacles).cut(uav_m, users_m)
        np.testing.assert_array_equal(ours, [plain_cut(obstacles, uav_m, user_m) for user_m in users_m])
        found += ours.tolist()
    assert 600 < sum(found) < 1500
    assert len(found) == 3000


def test_batches_of_both_libraries_are_cut_as_single_links():
    rng = np.random.default_rng(1)
    buildings = Buildings((*town(rng, 30), Obstacle(kind="no_fly", polygon_m=((0, 0), (500, 0), (0, 500)))))
    assert len(buildings) == 30
    uav_m, users_m = rng.random((40, 3)) * [500, 500, 200], rng.random((40, 60, 2)) * 500
    whole = buildings.cut(uav_m, users_m)
    single = [
        [bool(buildings.cut(u, one[None])[0]) for one in row] for u, row in zip(uav_m, users_m, strict=True)
    ]
    np.testing.assert_array_equal(whole, single)
    ours = buildings.cut(torch.from_numpy(uav_m), torch.from_numpy(users_m))
    np.testing.assert_array_equal(ours.numpy(), whole)
    assert 0.2 < whole.mean() < 0.9


def test_cases_that_are_known_without_a_library(array):
    house = Buildings((Obstacle(polygon_m=((10, 0), (20, 0), (20, 10), (10, 10)), height_m=30.0),))

    def cut(uav_m, *users_m):
        return np.asarray(
            house.cut(array(np.asarray(uav_m, float)), array(np.asarray(users_m, float)))
        ).tolist()

    assert cut((40, 5, 60), (0, 5), (30, 5), (15, 5), (-40, 5)) == [True, False, True, False]
    assert cut((15, 5, 60), (15, 5)) == [True]  # above a user in the house
    assert cut((15, 12, 60), (15, 12), (15, 5)) == [False, True]  # beside it
    assert cut((40, 5, 0), (0, 5), (30, 5)) == [True, False]  # on the ground
    assert cut((40, 5, -1), (0, 5), (30, 5)) == [True, False]  # below it, by its own estimate


MODELS = [
    {"model": "free_space", "ref_gain_db": -50.0, "path_loss_exponent": 2.0, **COMMON, **LOSS},
    {"model": "air_to_ground", "environment": "urban", **CARRIER, **COMMON},
    {"model": "tr_36_777", "environment": "uma_av", **CARRIER, **COMMON},
]


@pytest.mark.parametrize("values", MODELS, ids=lambda values: values["model"])
def test_a_cut_link_has_the_gain_without_line_of_sight_and_others_keep_theirs(values, array):
    plain = msgspec.to_builtins(scenarios.load("five_clusters_hover")) | {"radio": values}
    scenario, free = (from_values(plain | {"obstacles": one}, "test") for one in ([TOWER], []))
    uav_m, users_m = array(np.array([600.0, 400.0, 150.0])), array(np.array([[200.0, 400.0], [700.0, 400.0]]))
    distance_m = radio.distance(uav_m, users_m)
    collected = array(np.zeros(2, bool))
    with_tower, without = (world.measure(one, uav_m, users_m, collected).sinr for one in (scenario, free))
    assert float(with_tower[1]) == float(without[1])
    lost = float(with_tower[0] / without[0])
    if values["model"] == "free_space":
        assert lost == pytest.approx(0.01, rel=1e-12)
        return
    sight = (
        channel.air_to_ground_sight if values["model"] == "air_to_ground" else channel.aerial_vehicle_sight
    )(scenario.radio, uav_m[2:3], radio.ground_distance(uav_m, users_m), distance_m)
    gain = channel.mean_gain(sight, "mean_gain")
    assert lost == pytest.approx(float(10.0 ** (-sight.nlos_db[0] / 10.0) / gain[0]), rel=1e-12)
    assert lost < 0.5


def test_free_space_needs_a_loss_for_buildings_only():
    with pytest.raises(
        ScenarioError, match=r"missing key radio\.obstruction_loss_db; expected the loss of a"
    ):
        changed("five_clusters_hover", obstacles=[TOWER])
    changed("five_clusters_hover", obstacles=[box(300, 300, 400, 400)])
    assert (
        changed("five_clusters_hover").fingerprint == changed("five_clusters_hover", obstacles=[]).fingerprint
    )
