"""Energy: the models against their sources, a step's energy, and the end of a mission by the battery."""

import decimal
import math
from decimal import Decimal

import msgspec
import numpy as np
import pytest
import torch

from uav_dc_ros import scenarios
from uav_dc_ros.core import observations, world
from uav_dc_ros.core.energy import DESCENT_MAX, EnergySettings, state_of_charge
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.scenario import parse
from uav_dc_ros.errors import ScenarioError
from uav_dc_ros.planners import PLANNERS

PAPER = EnergySettings(battery_j=1e5)
LARGE = EnergySettings(
    battery_j=1e5, weight_n=100.0, disc_area_m2=0.79, tip_speed_mps=200.0, fuselage_drag=0.3
)
SPEEDS = [0.0, 0.1, 1.0, 4.03, 10.0, 18.3, 30.0, 60.0, 1000.0]


def level_by_hand(v, w=20, a="0.503", u=120, d0="0.6"):
    """Eq. (12) of Zeng, Xu and Zhang with the constants of their table, as written, in 60 digits."""
    with decimal.localcontext(prec=60):
        v, w, a, u, d0 = map(Decimal, (v, w, a, u, d0))
        rho, s = Decimal("1.225"), Decimal("0.05")
        p0 = Decimal("0.012") / 8 * rho * s * a * u**3
        pi = Decimal("1.1") * w * w.sqrt() / (2 * rho * a).sqrt()
        v0 = (w / (2 * rho * a)).sqrt()
        root = ((1 + v**4 / (4 * v0**4)).sqrt() - v**2 / (2 * v0**2)).sqrt()
        return float(p0 * (1 + 3 * v**2 / u**2) + pi * root + d0 * rho * s * a * v**3 / 2)


@pytest.mark.parametrize("speed", SPEEDS)
def test_level_flight_is_the_published_formula(speed):
    assert PAPER.level_w(speed) == pytest.approx(level_by_hand(speed), rel=1e-12)
    large = level_by_hand(speed, w=100, a="0.79", u=200, d0="0.3")
    assert LARGE.level_w(speed) == pytest.approx(large, rel=1e-12)


def test_the_published_numbers_of_both_tables_of_values():
    assert PAPER.profile_w == pytest.approx(79.8563, abs=5e-5)
    assert PAPER.induced_w == pytest.approx(88.6279, abs=5e-5)
    assert PAPER.induced_mps == pytest.approx(4.03, abs=5e-3)
    assert PAPER.level_w(0.0) == pytest.approx(79.8563 + 88.6279, abs=1e-4)
    assert LARGE.profile_w == pytest.approx(580.65, abs=5e-3)
    assert LARGE.induced_w == pytest.approx(790.6715, abs=5e-5)
    assert LARGE.induced_mps == pytest.approx(7.2, abs=5e-2)


def test_speeds_of_minimum_power_and_of_maximum_range():
    speeds = np.arange(1, 40_000) / 1000
    by_hand = np.asarray([level_by_hand(str(one)) for one in speeds[::1000]])
    power = np.asarray([PAPER.level_w(one) for one in speeds])
    np.testing.assert_allclose(power[::1000], by_hand, rtol=1e-12)
    assert speeds[power.argmin()] == pytest.approx(10.2, abs=0.05)
    assert speeds[(power / speeds).argmin()] == pytest.approx(18.3, abs=0.05)
    assert power.argmin() > 0, "hover needs more than slow flight"
    assert (np.diff(power[power.argmin() :]) > 0).all()
    assert (np.diff(power[: power.argmin()]) < 0).all()


@pytest.mark.parametrize("settings", [PAPER, LARGE])
def test_climb_is_momentum_theory(settings):
    """The power is W (V + 1.1 v) + P_0, where v solves the momentum equation W = 2 rho A (V + v) v."""
    for speed in (0.0, 0.5, 3.0, 12.0):
        induced = (settings.vertical_w(speed) - settings.profile_w) / settings.weight_n - speed
        induced /= 1.1
        thrust = 2 * 1.225 * settings.disc_area_m2 * (speed + induced) * induced
        assert thrust == pytest.approx(settings.weight_n, rel=1e-12)
    assert settings.vertical_w(0.0) == pytest.approx(settings.level_w(0.0), rel=1e-14)


def test_descent_is_the_fit_and_ends_where_it_ends():
    """It meets hover, and at twice the induced velocity in hover the windmill brake state, where v = v_0."""
    v0, weight = PAPER.induced_mps, PAPER.weight_n

    def induced(ratio):
        return (PAPER.vertical_w(ratio * v0) - PAPER.profile_w) / (weight * v0) - ratio

    assert induced(-1e-9) == pytest.approx(induced(0.0), abs=1e-8)
    assert induced(-1.0) == pytest.approx(1.1 + 1.125 - 1.372 + 1.718 - 0.655)
    assert induced(-DESCENT_MAX) == pytest.approx(1.0 + 0.1, abs=0.03)
    with pytest.raises(ValueError, match=r"speed is -8\.1 m/s; expected at least -8\.05"):
        PAPER.vertical_w(-8.1)
    speeds = np.linspace(-DESCENT_MAX * v0, 20.0, 500)
    powers = [PAPER.vertical_w(one) for one in speeds]
    assert min(powers) > 0.0
    assert (np.diff([PAPER.vertical_w(one) for one in np.linspace(0.0, 20.0, 50)]) > 0.0).all()
    assert min(LARGE.vertical_w(-one * LARGE.induced_mps) for one in (1.9, 2.0)) == 0.0, "none comes back"


def battery(three, changed, mission=None, **values):
    return changed(three, energy={"battery_j": 90_000.0} | values, mission=mission or {})


def test_energy_of_a_step(three, changed):
    """Constant speed over the step, or at cruise speed with a hover behind it."""
    hover_w = PAPER.level_w(0.0)
    slow = battery(three, changed).step_energies_j
    assert slow.hover == pytest.approx(15 * hover_w)
    assert slow.level == pytest.approx(15 * PAPER.level_w(100 / 15))
    assert slow.climb == pytest.approx(15 * PAPER.vertical_w(50 / 15))
    assert slow.descent == pytest.approx(15 * PAPER.vertical_w(-50 / 15))
    speeds = {"cruise_mps": 20.0, "climb_mps": 5.0, "descent_mps": 4.0}
    fast = battery(three, changed, **speeds).step_energies_j
    assert fast.level == pytest.approx(5 * PAPER.level_w(20.0) + 10 * hover_w)
    assert fast.climb == pytest.approx(10 * PAPER.vertical_w(5.0) + 5 * hover_w)
    assert fast.descent == pytest.approx(12.5 * PAPER.vertical_w(-4.0) + 2.5 * hover_w)
    assert slow.descent < slow.hover < slow.climb
    assert battery(three, changed, **speeds, weight_n=25.0).step_energies_j > fast


def fly(scenario, array, actions, dtype=np.float64):
    """Every (state, outcome) of missions with one action a step, in which users stand still."""
    n = np.shape(actions)[1:]
    draws = array(np.zeros((*n, scenario.n_users, 2)), dtype)
    state = world.initial(scenario, draws)
    for action in actions:
        state, outcome = world.step(scenario, state, array(action), draws)
        yield state, outcome


def test_a_mission_uses_the_sum_over_its_moves(three, changed, array):
    """In both libraries to the last bit; a move off the grid is a hover."""
    scenario = battery(three, changed)
    actions = np.random.default_rng(5).integers(0, 7, (three.mission.max_steps, 4))
    by_action = {
        Action.HOVER: scenario.step_energies_j.hover,
        Action.UPWARD: scenario.step_energies_j.climb,
        Action.DOWNWARD: scenario.step_energies_j.descent,
    }
    before, used, blocked = np.array([scenario.start_cell] * 4), np.zeros(4), 0
    for (state, outcome), moves in zip(fly(scenario, array, actions), actions, strict=True):
        cell = np.asarray(state.cell)
        for i, action in enumerate(moves):
            stays = (cell[i] == before[i]).all()
            blocked += stays and action != Action.HOVER
            used[i] += by_action.get(Action.HOVER if stays else action, scenario.step_energies_j.level)
        before = cell
        np.testing.assert_array_equal(np.asarray(state.energy_used_j), used)
        assert not np.asarray(outcome.landed).any()
    assert blocked > 10
    assert state.energy_used_j.dtype == array([0.0]).dtype


def test_float32_is_close(three, changed):
    scenario = battery(three, changed)
    actions = np.random.default_rng(5).integers(0, 7, (45, 4))
    both = [
        list(
            fly(
                scenario, lambda values, dtype=None: torch.tensor(values, dtype=dtype), actions, torch.float32
            )
        ),
        list(fly(scenario, np.array, actions)),
    ]
    assert both[0][-1][0].energy_used_j.dtype == torch.float32
    np.testing.assert_allclose(both[0][-1][0].energy_used_j, both[1][-1][0].energy_used_j, rtol=1e-6)


@pytest.mark.parametrize("episode_end", ["at_time_limit", "on_arrival"])
def test_the_battery_ends_a_mission(three, changed, array, episode_end):
    hover_j = PAPER.level_w(0.0) * 15
    for ends, steps in {"steps": 45, "both": 25}.items():
        values = {"battery_j": 25.3 * hover_j, "ends": ends}
        scenario = battery(three, changed, {"episode_end": episode_end}, **values)
        # The rest after 24 hovers, 1.3 of one, lasts for a level move of 0.8; that after 25 does not.
        flown = list(fly(scenario, array, np.full((45, 1), Action.HOVER)))
        over = [bool((outcome.terminated | outcome.truncated)[0]) for _, outcome in flown]
        assert over.index(True) + 1 == steps
        last = flown[over.index(True)][1]
        assert bool(last.terminated[0]) is (ends == "both" or episode_end == "at_time_limit")
        assert not last.landed[0]


@pytest.mark.parametrize("episode_end", ["at_time_limit", "on_arrival"])
@pytest.mark.parametrize(
    ("reserve", "last_move", "step", "landed"),
    [
        (-0.01, Action.FORWARD, 20, False),  # the rest does not last for the move to the dock
        (0.01, Action.FORWARD, 21, True),
        (1.1, Action.FORWARD, 21, True),  # it does not last for a hover, which takes 1.26 level moves
        (1.3, Action.FORWARD, 22, True),
        (-0.01, Action.HOVER, 20, False),
        (0.1, Action.HOVER, 21, False),  # empty on the way
    ],
)
def test_a_uav_whose_battery_is_empty_before_the_dock_has_not_landed(
    three, changed, array, episode_end, reserve, last_move, step, landed
):
    """A descent and twenty moves to the dock, with a battery for `reserve` level moves more."""
    energies_j = battery(three, changed).step_energies_j
    assert energies_j.hover / energies_j.level == pytest.approx(1.26, abs=0.01)
    values = {"battery_j": (20 + reserve) * energies_j.level + energies_j.descent, "ends": "both"}
    scenario = battery(three, changed, {"episode_end": episode_end}, **values)
    actions = [Action.DOWNWARD, *[Action.RIGHT] * 10, *[Action.FORWARD] * 9, last_move, *[Action.HOVER] * 3]
    flown = list(fly(scenario, array, np.asarray(actions)[:, None]))
    over = [bool(outcome.terminated[0]) for _, outcome in flown]
    last = over.index(True)
    assert last + 1 == (21 if episode_end == "on_arrival" and landed else step)
    assert bool(flown[last][1].landed[0]) is landed
    charge = state_of_charge(scenario.energy, flown[last][0].energy_used_j)
    assert 0.0 <= float(charge[0]) < 0.1


def test_a_move_to_the_dock_on_an_empty_battery_is_no_landing(three, changed, array):
    """With a descent into the dock's column at the end, which takes more than the rest."""
    energies_j = battery(three, changed).step_energies_j
    for more, landed in ((-0.01, False), (0.01, True)):
        used_j = array([90_000.0 + more])
        scenario = battery(three, changed, {"episode_end": "on_arrival"}, battery_j=90_000.0, ends="both")
        ends = world.end_of_mission(scenario, array([30]), array([[10, 10, 0]]), used_j - 2 * array([more]))
        assert [bool(one[0]) for one in ends] == [True, False, landed]
    assert energies_j.descent > energies_j.level


def test_the_tour_flies_home_before_the_battery_is_spent(three, changed):
    level_j = battery(three, changed).step_energies_j.level
    scenario = battery(three, changed, {"episode_end": "on_arrival"}, battery_j=28 * level_j, ends="both")
    for name in ("tour", "nearest"):
        act, draws = PLANNERS[name](scenario), np.full((scenario.n_users, 2), 0.5)
        state, over = world.initial(scenario, draws), False
        while not over:
            state, outcome = world.step(scenario, state, act(state), draws)
            over = bool(outcome.terminated | outcome.truncated)
        assert outcome.landed, name


def test_without_a_battery_nothing_is_counted(three, array):
    flown = list(fly(three, array, np.full((3, 2), Action.UPWARD)))
    np.testing.assert_array_equal(np.asarray(flown[-1][0].energy_used_j), 0.0)


def test_the_observation_energy_is_mission_and_the_state_of_charge(three, changed, array):
    scenario = battery(three, changed, battery_j=10_000.0)
    states = [state for state, _ in fly(scenario, array, np.full((5, 1), Action.UPWARD))]
    kinds = {kind: np.asarray(world.observe(kind, scenario, states[2])) for kind in ("mission", "energy")}
    np.testing.assert_array_equal(kinds["energy"][:, :-1], kinds["mission"])
    np.testing.assert_array_equal(kinds["mission"], np.asarray(world.observe("mission", three, states[2])))
    assert kinds["energy"][0, -1] == pytest.approx(1 - 3 * 2527.263 / 10_000, abs=1e-5)
    assert np.asarray(world.observe("energy", scenario, states[4]))[0, -1] == 0.0, "empty"
    low, high = observations.bounds("energy", scenario)
    assert low.shape == high.shape == kinds["energy"].shape[1:]
    assert "expected a scenario with [energy]" in (observations.problem("energy", three) or "")


TEXT = scenarios.find("three_clusters_hover").read_text("utf-8")


def test_every_value_is_in_the_fingerprint_and_none_in_that_of_a_scenario_without():
    plain, full = parse(TEXT, "a"), parse(f"{TEXT}\n[energy]\nbattery_j = 9e4\n", "a")
    assert "energy" not in msgspec.to_builtins(plain)
    prints = {plain.fingerprint, full.fingerprint}
    for key, value in msgspec.to_builtins(full.energy).items():
        speeds = {"cruise_mps": 9, "climb_mps": 5, "descent_mps": 4}
        other = "'both'" if key == "ends" else speeds.get(key) or value * 1.01
        line = "" if key == "battery_j" else "battery_j = 9e4"
        prints.add(parse(f"{TEXT}\n[energy]\n{line}\n{key} = {other}\n", "a").fingerprint)
    assert len(prints) == 2 + len(msgspec.to_builtins(full.energy))


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ("", "missing key energy.battery_j"),
        ("battery_j = 0", "energy.battery_j = 0; expected float > 0.0"),
        ("battery_j = 'full'", "energy.battery_j = 'full'; expected float, got str"),
        ("battery_j = inf", "energy.battery_j = inf; expected a finite number"),
        ("battery_j = 9e4\nends = 'time'", "energy.ends = 'time'; expected one of steps, battery, both"),
        ("battery_j = 9e4\ncruise_mps = 'fast'", "energy.cruise_mps = 'fast'; expected float, got str"),
        (
            "battery_j = 9e4\ncruise_mps = 6.6",
            "energy.cruise_mps = 6.6; expected at least 6.66667, or a move of 100 m",
        ),
        (
            "battery_j = 9e4\nclimb_mps = 3",
            "energy.climb_mps = 3; expected at least 3.33333, or a move of 50 m",
        ),
        (
            "battery_j = 9e4\ndescent_mps = 9",
            "energy.descent_mps = 9; expected at most 8.05709, twice the induced",
        ),
        ("battery_j = 9e4\nweight_n = -1", "energy.weight_n = -1; expected float > 0.0"),
        ("battery_j = 9e4\nsolidity = 2", "energy.solidity = 2; expected float <= 1.0"),
        (
            "battery_j = 4e4\nends = 'both'",
            "energy.battery_j = 40000; expected at least 40187.8, the energy",
        ),
        (
            "battery_j = 1e5\nends = 'battery'",
            "mission.max_steps = 45; expected at least 50, the steps that energy.battery_j lasts, so",
        ),
        ("battery_j = 9e4\nbatery_j = 2", "unknown key energy.batery_j = 2; did you mean 'battery_j'?"),
    ],
)
def test_a_bad_value_is_one_clear_line(lines, message):
    with pytest.raises(ScenarioError) as caught:
        parse(f"{TEXT}\n[energy]\n{lines}\n", "mine.toml")
    assert str(caught.value).startswith(f"mine.toml: {message}")
    assert "\n" not in str(caught.value)


def test_a_value_where_the_table_belongs():
    with pytest.raises(ScenarioError, match=r"mine.toml: energy = 3; expected table, got int"):
        parse(f"energy = 3\n{TEXT}", "mine.toml")


def test_a_battery_alone_may_end_every_mission():
    lines = "battery_j = 8e4\nends = 'battery'\n"
    scenario = parse(f"{TEXT}\n[energy]\n{lines}", "a")
    assert scenario.ends_at_any_step
    assert math.floor(8e4 / min(scenario.step_energies_j)) < 45
