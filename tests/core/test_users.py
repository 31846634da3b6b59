"""Listed users, unequal clusters, data volumes and priorities: layout, observation, reward and errors."""

import msgspec
import numpy as np
import pytest

from uav_dc_ros import scenarios
from uav_dc_ros.agents import policy as policies
from uav_dc_ros.core import mobility, observations, world
from uav_dc_ros.core.scenario import from_values
from uav_dc_ros.errors import PolicyError, ScenarioError
from uav_dc_ros.experiments.evaluate.rollout import roll_out
from uav_dc_ros.planners import PLANNERS

VALUES = msgspec.to_builtins(scenarios.load("five_clusters_hover"))
# In the order of a file; by cluster: b (0, 3), alone (1), a (2, 4, 5), alone (6).
LISTED = [
    {"x_m": 300.0, "y_m": 800.0, "name": "gate", "cluster": "b"},
    {"x_m": 800.0, "y_m": 200.0, "name": "pump", "priority": 3.0},
    {"x_m": 500.0, "y_m": 500.0, "name": "mast", "cluster": "a", "radius_m": 20.0},
    {"x_m": 320.0, "y_m": 840.0, "name": "yard", "cluster": "b", "data_bits": 2e6},
    {"x_m": 560.0, "y_m": 500.0, "name": "barn", "cluster": "a"},
    {"x_m": 500.0, "y_m": 530.0, "name": "silo", "cluster": "a", "radius_m": 10.0, "data_bits": 9e6},
    {"x_m": 900.0, "y_m": 900.0, "name": "well"},
]
ORDER = [0, 3, 1, 2, 4, 5, 6]
SIZES = [2, 1, 3, 1]


def field(users=LISTED, **tables):
    return from_values(VALUES | {"users": {"user": users, "v_max_mps": 1.0}} | tables, "test")


def by_cluster(per_user):
    """Mean of each cluster, by hand."""
    parts = np.split(np.asarray(per_user, np.float64), np.cumsum(SIZES)[:-1], axis=-1)
    return np.stack([part.mean(axis=-1) for part in parts], axis=-1)


def test_users_are_ordered_by_cluster_and_start_in_their_discs(array):
    scenario = field()
    assert (scenario.n_users, scenario.n_clusters) == (7, 4)
    assert scenario.user_cluster.tolist() == [0, 0, 1, 2, 2, 2, 3]
    assert scenario.users.names == tuple(LISTED[i]["name"] for i in ORDER)
    at = [(LISTED[i]["x_m"], LISTED[i]["y_m"]) for i in ORDER]
    assert scenario.user_centres_m == tuple(at)
    np.testing.assert_allclose(scenario.cluster_centres_m, by_cluster(np.transpose(at)).T)
    draws = array(np.random.default_rng(1).random((300, *scenario.draws_shape)))
    start, _ = mobility.begin(scenario, draws)
    away = np.hypot(*np.moveaxis(np.asarray(start) - at, -1, 0))
    radii = [LISTED[i].get("radius_m", 0.0) for i in ORDER]
    np.testing.assert_allclose(away.max(axis=0), radii, rtol=0.01)
    discs = scenario.users.clusters
    for user, cluster in enumerate(scenario.user_cluster):
        reach = np.hypot(*np.subtract(at[user], discs[cluster].centre_m)) + radii[user]
        assert reach <= discs[cluster].radius_m * (1 + 1e-12)
    assert discs[1].radius_m == 0.0


def test_clusters_of_unequal_size():
    sizes = [1, 12, 5, 5, 2]
    scenario = from_values(VALUES | {"users": VALUES["users"] | {"users_per_cluster": sizes}}, "test")
    assert scenario.n_users == 25
    assert np.bincount(scenario.user_cluster).tolist() == sizes
    equal = from_values(VALUES | {"users": VALUES["users"] | {"users_per_cluster": [10] * 5}}, "test")
    draws = np.random.default_rng(2).random((4, 50, 2))
    one, other = (world.initial(s, draws) for s in (equal, scenarios.load("five_clusters_hover")))
    np.testing.assert_array_equal(one.users_m, other.users_m)
    assert equal.fingerprint != scenario.fingerprint


@pytest.mark.parametrize("kind", ["mission", "map"])
def test_the_observation_holds_the_means_of_unequal_clusters(kind, array):
    """Each user counts in its own cluster, whatever the sizes of the others; data relative to its volume."""
    scenario = field()
    rng = np.random.default_rng(3)
    data = rng.uniform(0.0, 1e7, (5, 7))
    volume = np.array([LISTED[i].get("data_bits", 6e6) for i in ORDER])
    collected = data >= volume
    inputs = {
        "cell": np.tile([1, 2, 0], (5, 1)),
        "step": np.arange(5),
        "data_bits": data,
        "collected": collected,
    }
    found = observations.encode(kind, scenario, **{name: array(values) for name, values in inputs.items()})
    one = observations.encode(kind, scenario, **{name: array(values[3]) for name, values in inputs.items()})
    np.testing.assert_array_equal(one, found[3])
    found = np.asarray(found)
    assert found.shape == (5, observations.size(kind, scenario))
    np.testing.assert_allclose(found[:, 4:8], by_cluster(collected), rtol=1e-6)
    np.testing.assert_allclose(found[:, 8:12], by_cluster(np.minimum(data / volume, 1.0)), rtol=1e-6)


def test_each_user_is_collected_at_its_own_volume_and_weighs_by_its_priority(array):
    scenario = field(reward=VALUES["reward"] | {"form": "episode", "data": "so_far"})
    rng = np.random.default_rng(4)
    actions = [5, 5, 1, 1, 1, 2, 2, 2, 2, 2, 2, 2, 6, 6]
    draws = rng.random((len(actions) + 1, *scenario.draws_shape))
    state = world.initial(scenario, array(draws[0]))
    volume = np.array([LISTED[i].get("data_bits", 6e6) for i in ORDER])
    priority = np.array([LISTED[i].get("priority", 1.0) for i in ORDER])
    before = np.zeros(7)
    for action, now in zip(actions, draws[1:], strict=True):
        state, outcome = world.step(scenario, state, array(np.asarray(action)), array(now))
        data = np.asarray(state.data_bits)
        np.testing.assert_array_equal(state.collected, data >= volume)
        served = np.asarray(outcome.link.served)
        assert not served[before >= volume].any()
        mean = (priority * data).sum() / priority.sum() / scenario.reward.data_scale_bits
        away = np.hypot(*(np.asarray(state.cell)[:2] - np.asarray(scenario.dock_cell)))
        np.testing.assert_allclose(outcome.reward, mean + np.exp(-away), rtol=1e-12)
        before = data
    assert (data >= volume).any()
    assert (data < volume).any()


def test_equal_priorities_of_any_size_are_the_papers_mean():
    plain = field([{key: v for key, v in one.items() if key != "priority"} for one in LISTED])
    alike = field([one | {"priority": 7.0} for one in LISTED])
    assert plain.users.weights is None
    assert alike.users.weights is None
    assert plain.fingerprint != alike.fingerprint, "the file differs"


def test_planners_fly_to_single_users():
    scenario = field()
    missions = roll_out(scenario, PLANNERS["tour"](scenario), range(3))
    assert missions.landed.all()
    assert missions.users_collected.mean() > 5


def test_order_names_and_values_are_in_the_fingerprint():
    prints = {field().fingerprint, field(LISTED[::-1]).fingerprint}
    others = {"name": "hut", "cluster": "a", "radius_m": 1.0, "data_bits": 1e6, "priority": 2.0, "x_m": 901.0}
    for key, value in others.items():
        prints.add(field([*LISTED[:-1], LISTED[-1] | {key: value}]).fingerprint)
    assert len(prints) == 8
    assert from_values(msgspec.to_builtins(field()), "again").fingerprint == field().fingerprint


STILL = {"user": [{"x_m": 300.0, "y_m": 300.0}], "mobility": {"model": "static"}}
WALK = {"mobility": None, "v_max_mps": 0.0}
WAYPOINTS = {"model": "random_waypoint", "v_min_mps": 1.0, "v_max_mps": 2.0, "pause_s": 0.0}


@pytest.mark.parametrize(
    ("users", "radio", "is_random"),
    [
        ({}, {}, False),
        (WALK, {}, False),
        (WALK | {"v_max_mps": 1.0}, {}, True),
        ({"mobility": WAYPOINTS}, {}, True),
        ({"user": [{**STILL["user"][0], "radius_m": 5.0}]}, {}, True),
        ({}, {"fading": {"model": "rayleigh"}}, True),
        ({}, {"shadowing": {"sigma_db": 6.0, "correlation_m": 50.0}}, True),
    ],
)
def test_where_nothing_is_drawn_every_seed_gives_the_same_mission(users, radio, is_random):
    table = {key: value for key, value in (STILL | users).items() if value is not None}
    scenario = from_values(VALUES | {"users": table, "radio": VALUES["radio"] | radio}, "test")
    assert scenario.is_random is is_random
    missions = roll_out(scenario, PLANNERS["fixed_tour"](scenario), [1, 2])
    one, other = missions.data_bits
    assert bool(one != other) is is_random


def test_policies_fit_by_their_number_of_clusters():
    """A single user is a cluster."""
    made = policies.load("five_clusters_hover_dueling")
    with pytest.raises(PolicyError, match="the number of clusters is 4; expected 5"):
        made.check(field())
    made.check(field([*LISTED, {"x_m": 100.0, "y_m": 100.0}]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cluster_radius_m": 9.0}, "users.cluster_radius_m = 9.0; expected no such key beside users.user"),
        ({"user": []}, "missing key users.cluster_centres_m"),
        ({"file": "users.csv"}, "users.file = 'users.csv'; expected a scenario in a file"),
        ({"user": [{"x_m": 1.0}]}, "missing key users.user[0].y_m"),
        ({"user": [{"x_m": 1.0, "y_m": "2"}]}, "users.user[0].y_m = '2'; expected float, got str"),
        ({"user": [{"x_m": 1.0, "y_m": float("nan")}]}, "users.user[0].y_m = nan; expected a finite number"),
        (
            {"user": [{"x_m": 1.0, "y_m": 2.0, "radius_m": -1.0}]},
            "users.user[0].radius_m = -1.0; expected float >= 0.0",
        ),
        (
            {"user": [{"x_m": 1.0, "y_m": 2.0, "priority": 0}]},
            "users.user[0].priority = 0; expected float > 0.0",
        ),
        (
            {"user": [{"x_m": 1.0, "y_m": 2.0, "prioriy": 1}]},
            "unknown key users.user[0].prioriy = 1; did you mean 'priority'?",
        ),
        (
            {"user": [{"x_m": 1.0, "y_m": 2.0, "name": "a\n"}]},
            r"users.user[0].name = 'a\n'; expected printable characters",
        ),
        (
            {"user": [*LISTED, {"x_m": 1.0, "y_m": 2.0, "name": "pump"}]},
            "users.user[7].name = 'pump', as of users.user[1]; expected another one",
        ),
        (
            {"user": [{"x_m": 1050.1, "y_m": 2.0, "name": "hut"}]},
            "users.user[0] (hut) = [1050.1, 2.0]; expected a position over the grid: x -50 to 1050 and "
            "y -50 to 1050 m",
        ),
        (
            {"user": [{"x_m": i % 40, "y_m": i // 40} for i in range(1001)]},
            "users.user: 1001 clusters; expected at most 1000: give users of one place the same `cluster`",
        ),
    ],
)
def test_errors_of_listed_users(change, message):
    with pytest.raises(ScenarioError) as caught:
        from_values(VALUES | {"users": {"user": LISTED, "v_max_mps": 1.0} | change}, "mine.toml")
    assert str(caught.value).startswith(f"mine.toml: {message}")


@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        ([1, 2], "[1, 2]; expected a number, or 5: one for each of users.cluster_centres_m"),
        ([1, 2, 0, 4, 5], "users.users_per_cluster[2] = 0; expected int >= 1"),
        ("ten", "users.users_per_cluster = 'ten'; expected int | array, got str"),
    ],
)
def test_errors_of_sizes(sizes, message):
    with pytest.raises(ScenarioError) as caught:
        from_values(VALUES | {"users": VALUES["users"] | {"users_per_cluster": sizes}}, "mine.toml")
    assert message in str(caught.value)
