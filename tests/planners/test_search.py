"""The planners `tour` and `search`: what they know, what they promise, and what they reach."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.worlds import changed, tiny
from uav_dc_ros import scenarios
from uav_dc_ros.core import mission, world
from uav_dc_ros.core.world import State, rollout_steps
from uav_dc_ros.errors import ParameterError
from uav_dc_ros.experiments.evaluate.rollout import roll_out
from uav_dc_ros.planners import PLANNERS
from uav_dc_ros.planners.cells import SIZE_MAX, Cells, Delivery
from uav_dc_ros.planners.cluster_tour import _order, _Tour

THREE = scenarios.load("three_clusters_hover")
GAUSS_MARKOV = {"model": "gauss_markov", "alpha": 0.8, "mean_speed_mps": 9.0}


@pytest.mark.parametrize("name", ["three_clusters_hover", "farm"])
def test_search_is_better_than_tour_and_tour_than_a_fixed_one(name):
    scenario = scenarios.load(name)
    fixed, tour, search = (
        roll_out(scenario, PLANNERS[planner](scenario), [0]).objective(scenario)
        for planner in ("fixed_tour", "tour", "search")
    )
    assert search[0] > tour[0] > fixed[0] - 0.01


def test_over_the_dock_with_nothing_to_gain_it_hovers():
    cells = [
        state.cell[0].tolist()
        for state, _ in rollout_steps(THREE, PLANNERS["search"](THREE), [0])
        if state.collected.all() and mission.at_dock(state.cell, THREE.dock_cell).all()
    ]
    assert len(cells) > 5
    assert cells == cells[:1] * len(cells)


@pytest.mark.parametrize("planner", ["tour", "search"])
def test_the_weight_chooses_between_users_and_time(planner):
    way = np.abs(np.subtract(THREE.start_cell[:2], THREE.dock_cell)).sum()
    time_only, users_too = (roll_out(THREE, PLANNERS[planner](THREE, w), [0]) for w in (0.0, 10 / 11))
    assert time_only.arrival_step[0] == way
    assert users_too.arrival_step[0] > way
    assert users_too.users_collected[0] > time_only.users_collected[0]


@settings(derandomize=True, deadline=None, max_examples=25)
@given(
    planner=st.sampled_from(["tour", "search"]),
    weight=st.sampled_from([0.0, 0.3, 10 / 11, 1.0]),
    max_steps=st.integers(4, 12),
    interference=st.sampled_from(["all", "associated", "none"]),
    ends=st.sampled_from(["at_time_limit", "on_arrival"]),
    moves=st.sampled_from([{}, {"model": "static"}, GAUSS_MARKOV]),
)
def test_it_lands_however_little_time_there_is(planner, weight, max_steps, interference, ends, moves):
    users = {"mobility": moves, "v_max_mps": None} if moves else {}
    scenario = tiny(
        mission={"max_steps": max_steps, "episode_end": ends, "r_min_bits": 2e6},
        radio={"interference": interference},
        users=users,
    )
    missions = roll_out(scenario, PLANNERS[planner](scenario, weight), range(2))
    assert missions.landed.all()


@pytest.mark.parametrize("planner", list(PLANNERS))
def test_a_decision_depends_on_what_the_planner_knows_only(planner):
    """So that a node, which has no more, decides alike; and one mission alone as among others."""
    act = PLANNERS[planner](THREE)
    states = [state for state, _ in rollout_steps(THREE, act, range(2))]
    for state in (states[0], states[11], states[-4]):
        unknown = np.full(state.step.shape, np.nan)
        known = replace(state, total_reward=unknown, mission_reward=unknown, motion=state.motion * np.nan)
        if PLANNERS[planner].knows != "positions":
            known = replace(known, users_m=np.full_like(state.users_m, np.nan))
        actions = act(state)
        np.testing.assert_array_equal(PLANNERS[planner](THREE)(known), actions)
        if planner != "random":  # whose table has a column for each mission
            for i, action in enumerate(actions):
                fields = State.__dataclass_fields__
                alone = State(**{name: getattr(known, name)[i] for name in fields})
                assert act(alone) == action


@settings(derandomize=True, deadline=None, max_examples=20)
@given(
    interference=st.sampled_from(["all", "associated", "none"]),
    seed=st.integers(0, 99),
    share=st.sampled_from([0.0, 0.3, 0.9]),
)
def test_tables_are_the_world_s(interference, seed, share):
    scenario = changed("three_clusters_hover", radio={"interference": interference})
    rng = np.random.default_rng(seed)
    users_m, collected = rng.uniform(0.0, 1000.0, (30, 2)), rng.random((1, 30)) < share
    cells = Cells(scenario)
    cell = rng.integers(len(cells.cells), size=1)
    uav_m = scenario.grid.centre_m(cells.cells[cell], like=users_m)
    link = world.measure(scenario, uav_m, users_m[None], collected)
    expected = mission.delivered(link.served, link.rate_bps, scenario.mission.step_s)
    delivery = Delivery(cells, users_m)
    np.testing.assert_allclose(delivery.of(cell, collected), expected, rtol=1e-12)
    np.testing.assert_allclose(delivery.everywhere(collected[0])[cell], expected, rtol=1e-12)


def test_a_stop_that_takes_too_long_is_left_out():
    """Half of the time that all clusters take: landing, with the users of some clusters."""
    scenario = changed("five_clusters_hover", mission={"max_steps": 32})
    missions = roll_out(scenario, PLANNERS["tour"](scenario), range(3))
    assert missions.landed.all()
    assert (missions.users_collected > 15).all()


def test_where_time_is_short_the_choice_is_the_best_of_all():
    """Of the stops, in their order, and the waits at each; against all choices."""
    tour = _Tour(THREE, 0.9)
    rng, n_stops = np.random.default_rng(1), 3
    between, home = tour._between, tour.cells.steps_home
    for _ in range(40):
        number, needs = rng.integers(len(home), size=1), np.full((1, n_stops, 4), np.inf)
        needs[..., 0] = 0.0
        for i in range(n_stops):
            n = rng.integers(0, 4)
            needs[0, i, 1 : n + 1] = np.sort(rng.uniform(0.0, 5.0, n))
        left, best = int(home[number[0]]) + int(rng.integers(0, 16)), {}
        for users in itertools.product(range(4), repeat=n_stops):
            waits = [needs[0, i, k] for i, k in enumerate(users)]
            stops = [i for i, k in enumerate(users) if k]
            if not np.isfinite(waits).all():
                continue
            legs = (
                [tour._legs[stops[0], number[0]], *(between[a, b] for a, b in itertools.pairwise(stops))]
                if stops
                else []
            )
            last = home[tour._stops[stops[-1]]] if stops else home[number[0]]
            steps = sum(legs) + last + np.ceil(waits).sum()
            if steps <= left:
                goal = stops[0] if stops else n_stops
                value = tour._user_value * sum(users) - tour._step_cost * steps
                best[goal] = max(value, best.get(goal, -np.inf))
        chosen = int(tour._best_in_time(number, np.asarray([left]), needs)[0])
        assert best[chosen] == pytest.approx(max(best.values()), abs=1e-12)


def test_among_obstacles_in_short_time_tour_is_at_least_as_good_as_a_fixed_one():
    tower = {"polygon_m": [[350, 350], [450, 350], [450, 450], [350, 450]], "height_m": 170.0}
    zone = {"polygon_m": [[600, -50], [720, -50], [700, 900], [640, 900]], "kind": "no_fly"}
    radio = {"obstruction_loss_db": 20.0}
    field = changed("five_clusters_hover", radio=radio, obstacles=[tower, zone])
    fixed, tour = (
        roll_out(field, PLANNERS[name](field), range(10)).objective(field).mean()
        for name in ("fixed_tour", "tour")
    )
    assert tour > fixed


@settings(derandomize=True, deadline=None, max_examples=20)
@given(places=st.lists(st.integers(1, 99), min_size=1, max_size=14, unique=True))
def test_the_order_of_stops_on_a_line_is_along_it(places):
    stops = np.asarray(places)
    order = _order(np.abs(stops[:, None] - stops), stops, 100 - stops)
    np.testing.assert_array_equal(stops[order], np.sort(stops))


def test_the_improved_order_is_close_to_the_best():
    rng = np.random.default_rng(3)
    for _ in range(5):
        stops = rng.integers(0, 20, (9, 2))
        between = np.abs(stops[:, None] - stops).sum(axis=-1)
        start, dock = stops.sum(axis=-1), np.abs(stops - 20).sum(axis=-1)

        def length(order, between=between, start=start, dock=dock):
            order = list(order)
            return start[order[0]] + between[order[:-1], order[1:]].sum() + dock[order[-1]]

        # Held and Karp: the shortest way through each subset that ends at each stop
        best = {(1 << i, i): start[i] for i in range(9)}
        for size, subset in itertools.product(range(2, 10), range(1, 2**9)):
            members = [i for i in range(9) if subset >> i & 1]
            if len(members) == size:
                for i in members:
                    before = (best[subset ^ 1 << i, j] + between[j, i] for j in members if j != i)
                    best[subset, i] = min(before)
        shortest = min(best[2**9 - 1, i] + dock[i] for i in range(9))
        assert shortest <= length(_order(between, start, dock)) <= 1.1 * shortest


def test_a_field_that_is_too_large_is_refused():
    n = int(np.sqrt(SIZE_MAX / 30)) + 1
    grid, limits = {"n_x": n, "n_y": n, "n_z": 1}, {"start_m": [0.0, 0.0, 100.0]}
    scenario = changed("three_clusters_hover", grid=grid, mission=limits)
    with pytest.raises(ParameterError, match=r"cells times users; the planner expects up to 20000000"):
        PLANNERS["search"](scenario)
    with pytest.raises(ParameterError, match=r"planner 'plan' needs the observation 'entities' in scenario "):
        PLANNERS["plan"](scenario)
