"""The observation `entities`: what it shows is so in the world, and its moves always land."""

import dataclasses
import itertools
import re

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.conftest import ROOT
from tests.support.worlds import changed, tiny
from uav_dc_ros import scenarios
from uav_dc_ros.core import entities, observations, world
from uav_dc_ros.core.entities import encoding
from uav_dc_ros.core.entities.encoding import CLUSTER, CLUSTER_NAMES, GLOBAL, LOSS, WORTH, allowed
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.world import initial, observe, step
from uav_dc_ros.experiments.train.generalist import layouts

layout = st.integers(0, 10_000).map(layouts.draw)


def flown(scenario, n=6, seed=0, weight=None, choose=None):
    """Missions of random allowed moves, step by step: state, observation, outcome of the next step."""
    rng = np.random.default_rng(seed)
    state = initial(scenario, rng.random((n, *scenario.draws_shape)))
    over = np.zeros(n, bool)
    while not over.all():
        seen = observe("entities", scenario, state, weight)
        mask = allowed(seen)
        action = (rng.random(mask.shape) * mask).argmax(axis=-1)
        after, outcome = step(scenario, state, action, rng.random((n, *scenario.draws_shape)))
        yield state, seen, outcome, over
        over = over | outcome.terminated | outcome.truncated
        state = world.select(over, state, after)


@settings(max_examples=12)
@given(layout)
def test_every_mission_of_allowed_moves_lands(scenario):
    landed = np.zeros(6, bool)
    for _, seen, outcome, over in flown(scenario):
        assert seen.dtype == np.float32
        low, high = entities.bounds(scenario)
        assert ((seen >= low) & (seen <= high)).all()
        landed |= outcome.landed & ~over
    assert landed.all()


@pytest.mark.parametrize("name", ["five_clusters_hover", "farm", "town"])
def test_one_mission_and_another_library_see_the_same(name):
    scenario = scenarios.load(name)
    for state, seen, _, _ in itertools.islice(flown(scenario, 3), 0, 9, 4):
        np.testing.assert_array_equal(observe("entities", scenario, state, 10 / 11), seen)
        one = {
            key: getattr(state, key)[1]
            for key in ("cell", "step", "data_bits", "collected", "delivered_bits", "energy_used_j")
        }
        np.testing.assert_array_equal(observations.encode("entities", scenario, **one), seen[1])
        in_torch = {key: torch.from_numpy(np.asarray(value)) for key, value in one.items()}
        found = observations.encode("entities", scenario, **in_torch)
        np.testing.assert_allclose(found.numpy(), seen[1], atol=1e-5)


def test_other_units_look_alike():
    scenario = scenarios.load("five_clusters_hover")
    values = {"radio": {"noise_power_dbm": -300.0}}
    one = changed("five_clusters_hover", **values)
    wide = changed(  # ten times as wide and as slow, with more data in a wider band
        "five_clusters_hover",
        grid={"cell_m": 1000.0, "altitude_min_m": 1000.0, "altitude_step_m": 500.0},
        users={
            "cluster_centres_m": [(10 * x, 10 * y) for x, y in scenario.users.cluster_centres_m],
            "cluster_radius_m": 1200.0,
        },
        mission={
            "start_m": (0.0, 0.0, 2000.0),
            "dock_m": (10000.0, 10000.0),
            "step_s": 150.0,
            "d_cons_m": 2500.0,
            "r_min_bits": 6e8,
        },
        radio={**values["radio"], "bandwidth_hz": 1e7},
    )
    draws = np.random.default_rng(0).random((2, *one.draws_shape))
    seen = [observe("entities", each, initial(each, draws)) for each in (one, wide)]
    np.testing.assert_allclose(*seen, atol=1e-4)


@settings(max_examples=10)
@given(layout, st.integers(0, 1000))
def test_the_shortest_tour_is_that_of_every_order(scenario, seed):
    tables = scenario.entity_tables
    n = len(tables.first)
    rng = np.random.default_rng(seed)
    stops = [i for i in range(n) if rng.random() < 0.5][:6] or [0]
    number = sum(1 << i for i in stops)
    legs = np.full((n, n + 1), np.nan)
    for i, j in itertools.product(range(n), repeat=2):
        legs[i, j] = tables.tours[(1 << i) | (1 << j), i] - tables.tours[1 << j, j] if i != j else 0.0
    for i in range(n):
        legs[i, n] = tables.tours[1 << i, i]
    for first in stops:
        rest = [i for i in stops if i != first]
        ways = [
            sum(legs[a, b] for a, b in itertools.pairwise((first, *order, n)))
            for order in itertools.permutations(rest)
        ]
        assert tables.tours[number, first] == min(ways)


def worth_of_plans(scenario, row, left, data, weight):
    """J from now on of every plan after a step to a cell, by the definition, with users as expected."""
    tables, n = scenario.entity_tables, scenario.n_clusters
    per_user = weight / scenario.n_users
    price = max((1 - weight) / scenario.mission.max_steps, 0.01 * per_user)
    data = data + tables.of_cell[row, n + 1 : 2 * n + 1][tables.cluster_of]
    is_open = data < 1.0 - 1e-4
    for n_stops in range(n + 1):
        for stops in itertools.permutations(range(n), n_stops):
            way = [row, *tables.places[list(stops)]]
            moves = sum(tables.of_cell[at, to] for at, to in zip(way, [*stops, n], strict=True))
            users = hovers = 0.0
            for stop in stops:
                needs = np.sort(
                    (1 - data)[is_open & (tables.cluster_of == stop)] / max(tables.best[stop], 0.01)
                )
                gains = per_user * np.arange(1, len(needs) + 1) - price * needs
                if len(needs) and gains.max() > 0:
                    users, hovers = users + gains.argmax() + 1, hovers + needs[gains.argmax()]
            if 1 + moves <= left:
                part = min(1.0, (left - 1 - moves) / max(hovers, 1e-3))
                n_users = (~is_open).sum() + part**2 * users
                yield per_user * n_users - price * min(1 + moves + hovers, left)


def test_the_plan_is_the_best_of_all_orders_of_all_sets():
    rng, n, weight = np.random.default_rng(0), 4, 0.7
    drawn = [one for one in map(layouts.draw, range(30)) if one.n_clusters <= 4 and one.energy is None]
    for scenario in drawn[:5]:
        tables, r_min_bits = scenario.entity_tables, scenario.user_r_min_bits(np.ones(1))
        begun = initial(scenario, rng.random((n, *scenario.draws_shape)))
        rows = rng.choice(np.flatnonzero(tables.of_cell[:, scenario.n_clusters] < 1000), n)
        data = rng.random((n, scenario.n_users)) * 0.9
        expected = tables.of_cell[rows][:, scenario.n_clusters + 1 : 2 * scenario.n_clusters + 1]
        state = dataclasses.replace(
            begun,
            cell=np.stack(np.unravel_index(rows, scenario.grid.shape), axis=-1),
            step=rng.integers(0, scenario.mission.max_steps - 2, n),
            data_bits=data * r_min_bits,
            delivered_bits=expected[:, tables.cluster_of] * r_min_bits,  # as expected
        )
        seen = observe("entities", scenario, state, weight)
        for i in range(n):
            left = scenario.mission.max_steps - int(state.step[i])
            worth = {
                action: max(worth_of_plans(scenario, tables.after[rows[i], action], left, data[i], weight))
                for action in np.flatnonzero(allowed(seen[i]))
                if tables.of_cell[tables.after[rows[i], action], scenario.n_clusters] <= left - 1
            }
            if not worth:
                continue  # too late for a landing
            assert seen[i, WORTH] == pytest.approx(max(worth.values()), abs=1e-3)
            for action, one in worth.items():
                assert seen[i, LOSS + action] == pytest.approx(max(worth.values()) - one, abs=1e-3)


def test_a_user_that_delivers_nothing_over_its_cluster_is_not_waited_for():
    scenario = scenarios.load("five_clusters_hover")
    state = initial(scenario, np.random.default_rng(0).random((2, *scenario.draws_shape)))
    tables, r_min_bits = scenario.entity_tables, scenario.user_r_min_bits(np.ones(1))
    first = np.flatnonzero(tables.cluster_of == 2)
    collected = np.ones((2, scenario.n_users), bool)
    collected[:, first[0]] = False
    delivered = np.zeros((2, scenario.n_users))
    delivered[0, first[0]] = tables.best[2] * r_min_bits  # as expected in the first mission only
    state = dataclasses.replace(
        state,
        cell=np.tile(np.stack(np.unravel_index(tables.places[2], scenario.grid.shape)), (2, 1)),
        step=np.full(2, 10),
        collected=collected,
        delivered_bits=delivered,
    )
    seen = observe("entities", scenario, state)
    planned = seen[:, GLOBAL + CLUSTER_NAMES.index("planned") :: CLUSTER]
    np.testing.assert_array_equal(planned, [[0, 0, 1, 0, 0], [0, 0, 0, 0, 0]])
    assert seen[0, LOSS + Action.HOVER] == 0.0 < seen[1, LOSS + Action.HOVER]


def test_obstacles_and_moves_count():
    scenario = scenarios.load("town")
    grid = scenario.grid
    ways = scenario.entity_tables.of_cell[:, scenario.n_clusters].reshape(grid.shape)
    steps = scenario.moves.steps_to(scenario.dock_cell)
    np.testing.assert_array_equal(ways[steps >= 0], steps[steps >= 0])
    open_field = scenarios.load("five_clusters")
    ways = open_field.entity_tables.of_cell[:, 5].reshape(open_field.grid.shape)
    cells = np.moveaxis(np.indices(open_field.grid.shape), 0, -1)
    np.testing.assert_array_equal(ways, abs(cells[..., :2] - open_field.dock_cell).sum(axis=-1))


def test_progress_is_what_the_world_delivers():
    scenario = changed("five_clusters_hover", users={"v_max_mps": 0.0})
    rng = np.random.default_rng(0)
    state = initial(scenario, rng.random((400, *scenario.draws_shape)))
    cell = np.asarray((5, 5, 0))  # over the third cluster
    state = world.select(np.ones(400, bool), state, state)
    state.cell[:] = cell
    seen = observe("entities", scenario, state)[0, GLOBAL:].reshape(-1, CLUSTER)
    after, _ = step(scenario, state, np.full(400, Action.HOVER), rng.random((400, *scenario.draws_shape)))
    share = observations.cluster_means(scenario, after.data_bits / scenario.mission.r_min_bits).mean(axis=0)
    hover = CLUSTER_NAMES.index("progress_a") + Action.HOVER
    np.testing.assert_allclose(seen[:, hover], share, atol=0.02)
    assert seen[2, hover] > 0.2


def test_a_field_that_is_too_large_has_no_such_observation():
    assert entities.problem(tiny()) is None
    wide = tiny(grid={"n_x": 41})
    expected = "the observation 'entities' in scenario 'tiny' with a grid of 41 x 3 x 1 cells"
    assert expected in (entities.problem(wide) or "")
    crowd = [{"x_m": 100.0, "y_m": 100.0} for _ in range(101)]
    gone = dict.fromkeys(("cluster_centres_m", "users_per_cluster", "cluster_radius_m"))
    many = tiny(users={"user": crowd, **gone})
    assert "with 101 clusters; expected at most 100" in (entities.problem(many) or "")


def test_names_count_the_numbers_and_are_explained():
    explained = set(re.findall(r"`(\w+)`", (ROOT / "docs" / "generalist.md").read_text("utf-8")))
    assert {*encoding.GLOBAL_NAMES, *CLUSTER_NAMES} <= explained
    assert len(CLUSTER_NAMES) - 1 + len(Action) == encoding.CLUSTER
    scenario = scenarios.load("farm")
    assert entities.size(scenario) == GLOBAL + CLUSTER * 16
