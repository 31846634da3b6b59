"""The scenarios that come with the package: the paper's values, and a reason for each of the others."""

import re
import tomllib
from importlib.resources import files

import numpy as np
import pytest

from tests.conftest import ROOT
from uav_dc_ros import scenarios
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.scenario import parse
from uav_dc_ros.experiments.paper.worlds.choose import choose
from uav_dc_ros.experiments.paper.worlds.verdicts import Multiverse

CHOSEN = ("five_clusters", "three_clusters")  # the world of the paper's sweep, chosen by a rule
HOVER = ("five_clusters_hover", "three_clusters_hover")
SHIPPED = tuple(sorted((*CHOSEN, *HOVER)))
OWN = ("farm", "town")  # worlds beyond the paper

# What the paper gives (its table of simulation parameters, and its text): no comment needed.
PAPERS_OWN = {
    "name",
    "start_m",
    "bandwidth_hz",
    "noise_power_dbm",
    "ref_gain_db",
    "path_loss_exponent",
    "users_per_cluster",
}
# Two keys that one comment explains together; the second stands right below the first.
SHARED = {"n_y": "n_x", "zeta": "beta", "environment": "model"}


def text_of(name):
    return (files(scenarios) / f"{name}.toml").read_text("utf-8")


def test_names():
    assert scenarios.names() == sorted((*SHIPPED, *OWN))


@pytest.mark.parametrize("name", SHIPPED)
def test_the_papers_table_is_in_every_scenario(name):
    scenario = scenarios.load(name)
    assert scenario.name == name
    assert scenario.radio.bandwidth_hz == 1e6
    assert scenario.radio.noise_power_dbm == -110.0
    assert scenario.radio.ref_gain_db == -50.0
    assert scenario.radio.path_loss_exponent == 2.0
    assert scenario.mission.start_m == (0.0, 0.0, 200.0)
    assert scenario.users.users_per_cluster == 10
    assert scenario.radio.noise_power_w == pytest.approx(1e-14, rel=1e-14)
    assert scenario.radio.ref_gain == pytest.approx(1e-5, rel=1e-14)


@pytest.mark.parametrize(
    ("name", "clusters", "users"), [(name, *((3, 30) if "three" in name else (5, 50))) for name in SHIPPED]
)
def test_the_two_settings_of_the_paper(name, clusters, users):
    scenario = scenarios.load(name)
    assert (scenario.n_clusters, scenario.n_users) == (clusters, users)
    assert np.shape(scenario.user_centres_m) == (users, 2)
    np.testing.assert_array_equal(np.bincount(scenario.user_cluster), [10] * clusters)
    centres = np.asarray(scenario.users.cluster_centres_m)
    np.testing.assert_array_equal(scenario.user_centres_m, centres[scenario.user_cluster])


@pytest.mark.parametrize("name", SHIPPED)
def test_a_mission_can_be_flown(name):
    """From the start past every cluster to the dock within the limit, and each centre can be served."""
    scenario = scenarios.load(name)
    grid, limits = scenario.grid, scenario.mission
    reach_m = np.hypot(scenario.users.cluster_radius_m, grid.altitude_min_m)
    assert reach_m <= limits.d_cons_m, "from above its centre a whole cluster is in range"
    width_m, depth_m = (grid.n_x - 1) * grid.cell_m, (grid.n_y - 1) * grid.cell_m
    for x_m, y_m in scenario.users.cluster_centres_m:
        if name in HOVER:
            assert grid.cell_at((x_m, y_m, grid.altitude_min_m)) is not None, "a hover right above the centre"
        assert scenario.users.cluster_radius_m <= min(x_m, width_m - x_m, y_m, depth_m - y_m)
    away = np.abs(np.subtract(scenario.start_cell[:2], scenario.dock_cell)).sum()
    assert 0 < away <= limits.max_steps


@pytest.mark.parametrize("name", [*SHIPPED, *OWN])
def test_every_value_is_the_papers_or_has_its_reason_above_it(name):
    above, seen, depth, of_a_list = "", [], 0, False
    papers_own = PAPERS_OWN if name in SHIPPED else {"name"}
    for line in text_of(name).splitlines():
        if line.startswith("["):
            of_a_list = line.startswith("[[")  # users and obstacles: their names say what they are
        key = re.match(r"(\w+) *=", line)
        if key and depth == 0 and not of_a_list:
            seen.append(key[1])
            if key[1] in SHARED:
                assert above.startswith(SHARED[key[1]]), f"{key[1]} stands below {SHARED[key[1]]}"
            elif key[1] not in papers_own:
                assert re.match(r"# *\w", above), f"{key[1]}: nothing above it says why"
        depth += line.count("[") - line.count("]") if not line.startswith("#") else 0
        above = line
    fields = [
        key
        for table in ("grid", "users", "mission", "radio", "reward")
        for key in keys_of(name, table)
        if (table, key) != ("users", "user")
    ]
    assert seen == ["name", *fields], "every key was looked at"


def keys_of(name, table):
    return tomllib.loads(text_of(name))[table]


@pytest.mark.parametrize("name", CHOSEN)
def test_the_default_worlds_are_those_that_the_rule_chose(name):
    kept = ROOT / "docs" / "paper"
    chosen = choose(Multiverse.load(kept))
    assert scenarios.load(name) == chosen.scenario(name)
    assert parse((kept / f"chosen_{name}.toml").read_text("utf-8"), name) == chosen.scenario(name)


@pytest.mark.parametrize("name", SHIPPED)
def test_every_number_has_its_unit_in_the_key(name):
    """Keys without a unit are counts, ratios, names and powers of ten by their meaning."""
    bare = {"n_x", "n_y", "n_z", "users_per_cluster", "max_steps", "path_loss_exponent", "beta", "zeta"}
    words = {"episode_end", "interference", "r_plus", "form", "data"}
    for table in ("grid", "users", "mission", "radio", "reward"):
        for key in keys_of(name, table):
            value = getattr(getattr(scenarios.load(name), table), key)
            if isinstance(value, str):
                assert key in words
            elif key not in bare:
                assert re.search(r"_(m|mps|s|bits|hz|w|dbm|db)$", key), key


def test_the_town_has_buildings_that_close_cells_and_cut_links():
    town = scenarios.load("town")
    assert town.buildings is not None
    assert not np.all(town.moves.valid(np.array([[x, y, 0] for x in range(11) for y in range(11)])))
    assert {one.kind for one in town.obstacles} == {"building", "no_fly"}
    # From the cell over the station a user behind its hall is cut, one in front of it is not.
    cut = town.buildings.cut(np.array([160.0, 640.0, 40.0]), np.array([[150.0, 480.0], [150.0, 650.0]]))
    assert cut.tolist() == [True, False]


def test_the_farm_has_scattered_sensors_and_zones_that_are_flown_around_and_over():
    farm = scenarios.load("farm")
    assert (farm.n_users, farm.n_clusters) == (16, 16)
    assert {user.priority for users in farm.users.listed for user in users} == {1.0, 3.0}
    west_of_yard, west_of_line = (
        [bool(farm.moves.valid(np.array([*cell, layer]))[Action.RIGHT]) for layer in (0, 1)]
        for cell in ((6, 5), (3, 5))
    )
    assert west_of_yard == [False, False]
    assert west_of_line == [False, True]
