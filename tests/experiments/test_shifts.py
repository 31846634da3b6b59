"""Shifts of `evaluate`: worlds that differ from a policy's own."""

import json

import msgspec
import numpy as np
import pytest
import torch

from tests.support.worlds import changed, saved, tiny
from uav_dc_ros import scenarios
from uav_dc_ros.agents import policy
from uav_dc_ros.agents.agent import greedy_act
from uav_dc_ros.core import world
from uav_dc_ros.core.scenario import from_values, leaves
from uav_dc_ros.core.stats import interval
from uav_dc_ros.core.world import rollout_steps
from uav_dc_ros.errors import ScenarioError
from uav_dc_ros.experiments.evaluate.cli import main
from uav_dc_ros.experiments.evaluate.evaluation import EvaluationReport, evaluate_act
from uav_dc_ros.experiments.evaluate.rollout import roll_out
from uav_dc_ros.experiments.evaluate.shifts import apply, parse, transmitting
from uav_dc_ros.planners import PLANNERS

AIR = {
    "model": "air_to_ground",
    "carrier_hz": 2e9,
    "environment": "urban",
    "line_of_sight": "mean_gain",
    "bandwidth_hz": 1e6,
    "tx_power_w": 5.0,
    "noise_power_dbm": -110.0,
    "interference": "all",
}


def shifted(scenario, text):
    return apply(parse(text), scenario)


def evaluated(capsys, *arguments):
    with pytest.raises(SystemExit) as exit:
        main([*map(str, arguments)])
    assert exit.value.code == 0
    return capsys.readouterr().out


def test_a_shift_is_the_scenario_with_the_values_changed_by_hand(tmp_path, capsys):
    text = "radio.noise_power_dbm=+6,users.v_max_mps=x2,mission.max_steps=-4,radio.ref_gain_db==-53"
    arguments = ["--policy", "tour", "--scenario", "three_clusters_hover", "--seeds", 6, "--shift", text]
    arguments += ["--shift", "mission.d_cons_m=200", "--json", tmp_path / "x.json"]
    out = evaluated(capsys, *arguments)
    three = scenarios.load("three_clusters_hover")
    worlds = [
        three,
        changed(
            "three_clusters_hover",
            radio={"noise_power_dbm": -104.0, "ref_gain_db": -53.0},
            users={"v_max_mps": 2 * three.users.v_max_mps},
            mission={"max_steps": three.mission.max_steps - 4},
        ),
        changed("three_clusters_hover", mission={"d_cons_m": 200.0}),
    ]
    by_hand = [evaluate_act("tour", None, PLANNERS["tour"](one), one, range(6)) for one in worlds]
    report = msgspec.json.decode((tmp_path / "x.json").read_bytes(), type=EvaluationReport)
    for found, expected in zip(report.evaluations, by_hand, strict=True):
        assert msgspec.structs.replace(found, shift=msgspec.UNSET) == expected.evaluation
    assert report.evaluations[1].shift.text == text
    first = report.evaluations[1].shift.values[0]
    assert (first.key, first.before, first.after) == ("radio.noise_power_dbm", -110.0, -104.0)
    assert [effect.shift for effect in report.shifts] == [text, "mission.d_cons_m=200"]
    assert report.comparisons == []
    for effect, one in zip(report.shifts, by_hand[1:], strict=True):
        pairs = one.values["data_bits"] - by_hand[0].values["data_bits"]
        difference = effect.differences["data_bits"]
        assert (difference.mean, difference.low, difference.high) == tuple(interval(pairs))
    assert out.count("tour in three_clusters_hover, 30 users") == 2, "one table of figures, and the shifts"
    assert "-110.0 -> -104.0" in out
    assert f"{report.shifts[0].differences['data_bits'].mean / 1e6:+.1f}" in out


def test_without_a_shift_the_file_is_what_it_was(tmp_path, capsys):
    evaluated(
        capsys,
        *(
            "--policy",
            "tour",
            "--scenario",
            "three_clusters_hover",
            "--seeds",
            2,
            "--json",
            tmp_path / "x.json",
        ),
    )
    report = json.loads((tmp_path / "x.json").read_text())
    assert set(report) == {"evaluations", "comparisons"}
    assert "shift" not in report["evaluations"][0]


def test_policies_are_compared_in_each_shifted_world(tmp_path, capsys):
    arguments = ["--policy", "tour", "nearest", "--scenario", "five_clusters_hover", "--seeds", 2]
    evaluated(capsys, *arguments, "--shift", "users.v_max_mps=x3", "--json", tmp_path / "x.json")
    report = msgspec.json.decode((tmp_path / "x.json").read_bytes(), type=EvaluationReport)
    compared = [(one.policy, one.baseline, one.shift) for one in report.comparisons]
    assert compared == [("nearest", "tour", msgspec.UNSET), ("nearest", "tour", "users.v_max_mps=x3")]
    assert report.comparisons[0].differences != report.comparisons[1].differences


@pytest.mark.parametrize("tables", [{}, {"energy": {"battery_j": 9e4, "cruise_mps": 9.0}}, {"radio": AIR}])
def test_every_number_of_a_scenario_can_be_changed(tables):
    """By nothing, which gives the same world."""
    values = msgspec.to_builtins(scenarios.load("five_clusters_hover")) | tables
    scenario = msgspec.convert(values, type(scenarios.load("five_clusters_hover")))
    keys = [key for key, value in leaves(values) if isinstance(value, int | float) and "number of" not in key]
    assert len(keys) > 30
    for key in keys:
        for change in ("+0", "-0", "x1"):
            assert shifted(scenario, f"{key}={change}").scenario == scenario


def test_a_list_is_changed_element_by_element():
    five = scenarios.load("five_clusters_hover")
    centres_m = np.asarray(five.users.cluster_centres_m)
    moved = shifted(five, "users.cluster_centres_m=+60")
    np.testing.assert_array_equal(moved.scenario.users.cluster_centres_m, centres_m + 60.0)
    one = shifted(five, "users.cluster_centres_m[1][0]=x0.5").scenario
    assert one.users.cluster_centres_m[1] == (150.0, 800.0)
    assert one.users.cluster_centres_m[0] == five.users.cluster_centres_m[0]


def test_users_of_a_list_are_changed_all_or_one_by_one():
    users = {"user": [{"x_m": 10.0 * i, "y_m": 50.0, "data_bits": 1e6} for i in range(4)], "v_max_mps": 1.0}
    values = msgspec.to_builtins(tiny()) | {"users": users}
    scenario = from_values(values, "test")
    moved = shifted(scenario, "users.user.x_m=+60,users.user[2].y_m=-20,users.user.data_bits=x2")
    assert [user.x_m for user in moved.scenario.users.user] == [60.0, 70.0, 80.0, 90.0]
    assert [user.y_m for user in moved.scenario.users.user] == [50.0, 50.0, 30.0, 50.0]
    assert moved.shift.values[0].before == [0.0, 10.0, 20.0, 30.0]
    assert moved.known.cluster_centres_m == scenario.cluster_centres_m, "the map is the old one"
    assert [user.data_bits for user in moved.known.users.user] == [2e6] * 4
    with pytest.raises(ScenarioError, match=r"unknown key users.user.height_m"):
        shifted(scenario, "users.user.height_m=+1")


LISTED = {
    "user": [
        {"x_m": 0.0, "y_m": 0.0, "cluster": "a"},
        {"x_m": 90.0, "y_m": 0.0},
        {"x_m": 0.0, "y_m": 10.0, "cluster": "a"},
        {"x_m": 90.0, "y_m": 0.0},
    ],
    "v_max_mps": 1.0,
}


@pytest.mark.parametrize("listed", [False, True])
def test_each_cluster_is_a_share_of_the_distance_to_the_nearest_one_off_the_map(listed):
    scenario = scenarios.load("five_clusters_hover")
    if listed:
        scenario = from_values(msgspec.to_builtins(tiny()) | {"users": LISTED}, "test")
    world = shifted(scenario, "users.position_error=20%")
    before, after = (np.asarray(one.cluster_centres_m) for one in (scenario, world.scenario))
    apart_m = np.linalg.norm(before[:, None] - before, axis=-1)
    nearest_m = np.where(np.eye(len(before), dtype=bool), np.inf, apart_m).min(axis=1)
    np.testing.assert_allclose(np.linalg.norm(after - before, axis=1), 0.2 * nearest_m, atol=1e-9)
    assert world.known == scenario, "the map is the old one"
    assert shifted(scenario, "users.position_error=20%") == world, "the same for equal scenarios"
    (west_m, south_m), (east_m, north_m) = scenario.grid.area_m
    assert ((after >= (west_m, south_m)) & (after <= (east_m, north_m))).all()
    ways = np.asarray(world.scenario.user_centres_m) - np.asarray(scenario.user_centres_m)
    for cluster in range(scenario.n_clusters):
        assert np.ptp(ways[scenario.user_cluster == cluster], axis=0) == pytest.approx(0.0, abs=1e-9)
    directions = {tuple(np.sign(way)) for way in (after - before)[nearest_m > 0.0]}
    assert listed or len(directions) > 1, "not all the same way"


def test_a_finer_grid_is_the_same_field_with_the_same_uav():
    scenario = changed("five_clusters_hover", energy={"battery_j": 3e5, "cruise_mps": 9.0})
    world = shifted(scenario, "grid.cells=x3").scenario
    assert world.grid.shape == (31, 31, 7)
    for cell, finer in (
        (scenario.grid.last_cell, world.grid.last_cell),
        (scenario.start_cell, world.start_cell),
    ):
        at_m, finer_m = (
            one.grid.centre_m(np.asarray(at), like=np.zeros(1))
            for one, at in ((scenario, cell), (world, finer))
        )
        np.testing.assert_allclose(finer_m, at_m)
    assert world.dock_cell == (30, 30)
    speeds = [one.grid.cell_m / one.mission.step_s for one in (scenario, world)]
    assert speeds[0] == pytest.approx(speeds[1])
    times = [one.mission.max_steps * one.mission.step_s for one in (scenario, world)]
    assert times[0] == pytest.approx(times[1])
    hover_j = [one.step_energies_j.hover * one.mission.max_steps for one in (scenario, world)]
    assert hover_j[0] == pytest.approx(hover_j[1])
    assert world.users == scenario.users
    missions = roll_out(world, PLANNERS["fixed_tour"](world), range(2), service=False)
    assert missions.landed.all()


def test_a_policy_does_not_know_that_the_users_have_moved(tmp_path):
    five = scenarios.load("five_clusters_hover")
    made = policy.load(saved(tmp_path / "made", five, observation="map"))
    moved = shifted(five, "users.cluster_centres_m=+60,mission.max_steps=+20")
    act, own = greedy_act(made, moved.known), greedy_act(made, five)
    start, home = (next(rollout_steps(one, None, range(20)))[0] for one in (moved.scenario, five))
    np.testing.assert_allclose(start.users_m - home.users_m, 60.0, atol=1e-9)
    np.testing.assert_array_equal(act(start), own(home))
    assert moved.known.mission.max_steps == 80, "but its time it knows"
    observed = world.observe("map", moved.scenario, start)
    assert (observed != world.observe("map", five, home)).any(), "the map of the moved users is another"


@pytest.mark.parametrize("library", ["numpy", "torch"])
@pytest.mark.parametrize("interference", ["all", "associated", "none"])
def test_a_user_that_sends_nothing_is_as_one_that_is_not_there(library, interference):
    scenario = changed("three_clusters_hover", radio={"interference": interference})
    rng = np.random.default_rng(3)
    users_m, collected = rng.random((5, 30, 2)) * 500.0, rng.random((5, 30)) < 0.2
    uav_m = np.array([200.0, 250.0, 100.0])
    sends = np.arange(30) % 3 > 0
    as_array = torch.asarray if library == "torch" else np.asarray
    arrays = (as_array(one) for one in (uav_m, users_m, collected, sends))
    link = world.measure(scenario, *arrays)
    alone = world.measure(scenario, uav_m, users_m[:, sends], collected[:, sends])
    assert 0 < alone.served.sum() < alone.served.size
    np.testing.assert_array_equal(np.asarray(link.served)[:, sends], alone.served)
    np.testing.assert_allclose(np.asarray(link.rate_bps)[:, sends], alone.rate_bps, rtol=1e-12)
    np.testing.assert_allclose(link.sum_rate_bps, alone.sum_rate_bps, rtol=1e-12)
    for values in (link.served, link.sinr, link.rate_bps):
        assert not np.asarray(values)[:, ~sends].any()


def test_missing_users_are_a_share_of_each_mission_and_are_never_collected():
    scenario, seeds = tiny(users={"users_per_cluster": 20}), range(30)
    few, many = (transmitting(scenario, seeds, share) for share in (0.3, 0.6))
    assert ((~few).sum(axis=1) == 6).all()
    assert ((~many).sum(axis=1) == 12).all()
    assert not (~few & many).any(), "who is missing at 30% is at 60%"
    assert len({tuple(row) for row in few}) == 30, "others in each mission"
    np.testing.assert_array_equal(few[5:8], transmitting(scenario, range(5, 8), 0.3))
    plan = [1, 6, 6, 6, 1, 2, 2, 6]
    missing = shifted(scenario, "users.missing=30%")
    assert missing.scenario == scenario

    def act(state):
        return np.full(state.step.shape, plan[state.step[0]])

    # With users that can be collected in full, those that send are.
    flown = evaluate_act("plan", None, act, scenario, seeds, missing.shift)
    expected = roll_out(scenario, act, seeds, transmitting=few)
    np.testing.assert_array_equal(flown.values["data_bits"], expected.data_bits)
    states = [state for state, _ in rollout_steps(scenario, act, seeds, transmitting=few)]
    assert not states[-1].data_bits[~few].any()
    assert (states[-1].data_bits[few] > 0.0).all()
    walked = [state for state, _ in rollout_steps(scenario, act, seeds)]
    np.testing.assert_array_equal(states[-1].users_m, walked[-1].users_m, "the mission is the same")


@pytest.mark.parametrize(
    ("shift", "complaint"),
    [
        (
            "radio.noise=+6",
            "'five_clusters_hover': unknown key radio.noise; did you mean radio.noise_power_dbm?",
        ),
        ("energy.battery_j=x2", "unknown key energy.battery_j; expected a numeric key, such as"),
        ("users.cluster_centres_m[7][0]=+6", "unknown key users.cluster_centres_m[7][0]"),
        ("radio.interference=1", "radio.interference is 'all'; expected a numeric key"),
        ("radio=x2", "radio is a table; expected one of its keys"),
        ("users.cluster_centres_m=5", "is a list; expected +DELTA, -DELTA, xFACTOR, or one of its elements"),
        ("users.users_per_cluster=x1.25", "users.users_per_cluster = 12.5; expected a whole number"),
        ("mission.max_steps=x1e999", "mission.max_steps = inf; expected a whole number"),
        ("radio.noise_power_dbm=+600", "radio.noise_power_dbm = 490.0; expected float <= 100"),
        ("mission.dock_m=-7", "mission.dock_m = [993.0, 993.0]; expected the centre of a cell"),
        (
            "mission.max_steps=19",
            "mission.max_steps = 19; expected at least 20, the moves from start to dock",
        ),
        ("grid.n_x=+1", "--shift grid.n_x=+1: policy 'five_clusters_hover_dueling' does not fit scenario"),
        ("users.missing=0.3", "'users.missing=0.3'; expected KEY=VALUE"),
        ("users.missing=+30%", "'users.missing=+30%'; expected KEY=VALUE"),
        ("users.missing=0%", "users.missing = 0%; expected at least one and at most all of 50 users"),
        ("users.missing=101%", "users.missing = 101%; expected at least one and at most all of 50 users"),
        ("users.position_error=20", "'users.position_error=20'; expected KEY=VALUE"),
        ("users.position_error=0%", "users.position_error = 0%; expected above 0% and at most 100%"),
        ("grid.cells=3", "'grid.cells=3'; expected KEY=VALUE"),
        ("grid.cells=x1.5", "grid.cells = x1.5; expected x and a whole number from 2 to 999"),
        ("grid.cells=x200", "grid.n_x = 2001; expected int <= 1000"),
        (
            "grid.cells=x2",
            "--shift grid.cells=x2: policy 'five_clusters_hover_dueling' does not fit scenario",
        ),
        ("radio.noise_power_dbm=+6%", "'radio.noise_power_dbm=+6%'; expected KEY=VALUE"),
        ("radio.noise_power_dbm", "'radio.noise_power_dbm'; expected KEY=VALUE"),
        ("radio.noise_power_dbm=nan", "'radio.noise_power_dbm=nan'; expected KEY=VALUE"),
        ("radio.noise_power_dbm=+1_0", "'radio.noise_power_dbm=+1_0'; expected KEY=VALUE"),
        ("mission.step_s=+1,", "''; expected KEY=VALUE"),
        ("mission.step_s=+1,mission.step_s=x2", "mission.step_s is changed 2 times; expected once"),
    ],
)
def test_a_mistake_is_one_line_and_status_2(capsys, shift, complaint):
    with pytest.raises(SystemExit) as exit:
        main(["--policy", "five_clusters_hover_dueling", "--seeds", "1", "--shift", shift])
    assert exit.value.code == 2
    err = capsys.readouterr().err
    assert complaint in err
    assert len(err.splitlines()) == 1


def test_one_cluster_has_no_distance_to_another():
    with pytest.raises(ScenarioError, match="the scenario has one cluster; expected two or more"):
        shifted(tiny(), "users.position_error=20%")


def test_shifts_are_given_once_and_without_a_picture(capsys):
    same = ["--shift", "mission.step_s=+1"]
    for more, complaint in (
        (same + same, "--shift mission.step_s=+1 is given 2 times; expected once"),
        ([*same, "--picture", "x.png"], "--picture of 2 evaluations; expected one policy"),
    ):
        with pytest.raises(SystemExit) as exit:
            main(["--policy", "five_clusters_hover_dueling", "--seeds", "1", *more])
        assert exit.value.code == 2
        assert complaint in capsys.readouterr().err
