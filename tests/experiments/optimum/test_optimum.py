"""The optimum: equal to exhaustive search in small worlds, and bounds that hold in the shipped ones."""

import msgspec
import numpy as np
import pytest

from tests.support.worlds import changed
from uav_dc_ros import scenarios
from uav_dc_ros.agents import agent as agents
from uav_dc_ros.core import mission, mobility, world
from uav_dc_ros.core.grid import MOVES
from uav_dc_ros.core.objective import DEFAULT_WEIGHT
from uav_dc_ros.errors import ScenarioError
from uav_dc_ros.experiments.evaluate.rollout import roll_out
from uav_dc_ros.experiments.optimum import mip
from uav_dc_ros.experiments.optimum.cli import OptimumReport, main, report_of
from uav_dc_ros.experiments.optimum.front import draw_front, greatest_users
from uav_dc_ros.experiments.optimum.problem import ClairvoyantProblem
from uav_dc_ros.experiments.optimum.solve import fly, solve
from uav_dc_ros.scenarios.generation import document


def small(seed, **tables):
    """A world of 5 x 5 x 2 cells, 12 steps and 6 users in 3 clusters, drawn from a seed."""
    rng = np.random.default_rng(seed)
    own = tables.pop("mission", {})
    return changed(
        "five_clusters_hover",
        grid={"n_x": 5, "n_y": 5, "n_z": 2},
        users={
            "cluster_centres_m": rng.uniform(0.0, 400.0, (3, 2)).round(1).tolist(),
            "users_per_cluster": 2,
            "v_max_mps": 2.0,
        },
        mission={
            "start_m": [0.0, 0.0, 150.0],
            "dock_m": [400.0, 100.0 * int(rng.integers(0, 5))],
            "max_steps": 12,
            "d_cons_m": 190.0,
            "r_min_bits": float(rng.uniform(1e7, 4e7)),
            **own,
        },
        **tables,
    )


def different(data):
    """Each of the rows `[n, U]` once."""
    _, first = np.unique(data @ np.random.default_rng(0).random(data.shape[-1]), return_index=True)
    return data[first]


def exhaustive(scenario, seed, weight):
    """The greatest J of all missions: every partial mission in turn, but for those with equal data."""
    rng = np.random.default_rng(seed)
    state = world.initial(scenario, rng.random(scenario.draws_shape))
    users_m, motion = state.users_m, state.motion
    n_steps, on_arrival = scenario.mission.max_steps, scenario.mission.episode_end == "on_arrival"
    # (cell, step since which the UAV is over the dock or 0) -> data of missions, `[n, U]`
    missions, best = {(scenario.start_cell, 0): np.zeros((1, scenario.n_users))}, 0.0
    for step in range(1, n_steps + 1):
        users_m, motion = mobility.move(scenario, users_m, motion, rng.random(scenario.draws_shape))
        after = {}
        for (cell, since), data in missions.items():
            for move in MOVES:
                to = tuple(int(i) for i in np.add(cell, move))
                if min(to) < 0 or any(i >= n for i, n in zip(to, scenario.grid.shape, strict=True)):
                    continue
                to_dock = abs(to[0] - scenario.dock_cell[0]) + abs(to[1] - scenario.dock_cell[1])
                if to_dock > n_steps - step:
                    continue
                uav_m = scenario.grid.centre_m(np.array(to), like=users_m)
                link = world.measure(scenario, uav_m, users_m, np.zeros(scenario.n_users, bool))
                bits = mission.delivered(link.served, link.rate_bps, scenario.mission.step_s)
                arrived = (since or step) if to_dock == 0 else 0
                total = np.minimum(data + bits, scenario.mission.r_min_bits)
                if arrived and (on_arrival or step == n_steps):
                    users = (total >= scenario.mission.r_min_bits).sum(axis=-1).max() / scenario.n_users
                    best = max(best, weight * users + (1.0 - weight) * (1.0 - arrived / n_steps))
                else:
                    after.setdefault((to, arrived), []).append(total)
        missions = {key: different(np.concatenate(parts)) for key, parts in after.items()}
    return best


SHORT = range(1, 10)  # without those in which there are the most missions: 0, 10, 16, 17, 18


def of_seed(seed):
    return seed, DEFAULT_WEIGHT if seed % 2 else 0.6, "on_arrival" if seed % 5 == 4 else "at_time_limit"


SMALL = [of_seed(seed) for seed in SHORT]
SMALL += [pytest.param(*of_seed(seed), marks=pytest.mark.long) for seed in range(25) if seed not in SHORT]


@pytest.mark.parametrize(("seed", "weight", "end"), SMALL)
def test_it_equals_exhaustive_search(seed, weight, end):
    scenario = small(seed, mission={"episode_end": end})
    found = solve(ClairvoyantProblem(scenario, seed), weight)
    assert found.is_optimal
    assert found.objective == pytest.approx(exhaustive(scenario, seed, weight), abs=1e-12)


@pytest.mark.long
@pytest.mark.parametrize(("seed", "weight", "end"), [of_seed(seed) for seed in range(25)])
def test_the_mixed_integer_program_has_the_same_optimum(seed, weight, end):
    pytest.importorskip("highspy")
    problem = ClairvoyantProblem(small(seed, mission={"episode_end": end}), seed)
    program = mip.solve_program(problem, weight)
    flown = fly(problem.scenario, program.actions, seed).objective(problem.scenario, weight)[0]
    assert program.bound == pytest.approx(flown, abs=1e-6)
    assert solve(problem, weight).objective == pytest.approx(flown, abs=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_a_narrow_diagram_bounds_the_optimum(seed):
    """Whatever is merged, what is excluded is impossible: the bound is never below the optimum."""
    problem = ClairvoyantProblem(small(seed), seed)
    optimum = solve(problem, 0.6).objective
    for width in (1, 3, 10):
        found = solve(problem, 0.6, widths=(width,))
        assert found.objective <= optimum <= found.bound
    stopped = solve(problem, 0.6, time_limit_s=0.0)
    assert stopped.stopped
    assert stopped.objective <= optimum <= stopped.bound


@pytest.mark.parametrize(
    ("name", "policy"), [("five_clusters", "five_clusters_dueling"), ("farm", "farm_dueling")]
)
def test_no_policy_is_better_than_the_bound(name, policy):
    scenario = scenarios.load(name)
    found = solve(ClairvoyantProblem(scenario, 1), DEFAULT_WEIGHT, widths=(250,))
    for name in (policy, "tour", "fixed_tour"):
        act = agents.load(name).act_in(scenario)
        assert roll_out(scenario, act, [1]).objective(scenario)[0] <= found.objective <= found.bound


def test_the_mission_of_five_clusters_is_proved_to_be_the_best():
    found = solve(ClairvoyantProblem(scenarios.load("five_clusters"), 0), DEFAULT_WEIGHT)
    assert found.is_optimal
    assert (found.users_collected, found.arrival_step) == (50, 29)


def test_a_random_channel_is_known_to_the_clairvoyant():
    shadowing = {"shadowing": {"sigma_db": 6.0, "correlation_m": 60.0}, "fading": {"model": "rayleigh"}}
    scenario = small(3, radio=shadowing)
    problem = ClairvoyantProblem(scenario, 3)
    assert solve(problem, DEFAULT_WEIGHT).is_optimal
    assert not np.array_equal(problem.share, ClairvoyantProblem(small(3), 3).share)


def test_obstacles_are_flown_around():
    wall = {"polygon_m": [[150.0, -60.0], [250.0, -60.0], [250.0, 360.0], [150.0, 360.0]], "kind": "no_fly"}
    open_field, walled = small(3), small(3, obstacles=[{"name": "wall", **wall}])
    both = [solve(ClairvoyantProblem(one, 3), 0.0) for one in (open_field, walled)]
    assert all(one.is_optimal for one in both)
    assert both[0].arrival_step < both[1].arrival_step


@pytest.mark.parametrize(
    ("tables", "error"),
    [
        (
            {"radio": {"interference": "associated"}},
            "interference = 'associated'.*expected 'all' or 'none'",
        ),
        ({"energy": {"battery_j": 90e3, "ends": "both"}}, "energy.ends = 'both'.*expected 'steps'"),
        ({"users": {"users_per_cluster": 40_000}}, "expected at most 300000000"),
    ],
)
def test_a_world_that_has_no_table_is_refused(tables, error):
    with pytest.raises(ScenarioError, match=error):
        ClairvoyantProblem(changed("three_clusters_hover", **tables), 0)


def command(*arguments):
    with pytest.raises(SystemExit) as exit:
        main([*map(str, arguments)])
    return exit.value.code


def test_the_command_reports_missions_and_policies(tmp_path, capsys):
    arguments = [
        "--scenario",
        "three_clusters",
        "--seeds",
        2,
        "--policy",
        "three_clusters_dueling",
        "fixed_tour",
    ]
    assert command(*arguments, "--json", tmp_path / "x.json") == 0
    written = (tmp_path / "x.json").read_bytes()
    report = msgspec.json.decode(written, type=OptimumReport)
    assert [one.seed for one in report.missions] == [0, 1]
    assert all(one.is_optimal and one.bound == pytest.approx(one.objective) for one in report.missions)
    assert report.bound == pytest.approx(np.mean([one.bound for one in report.missions]))
    learned, tour = report.policies
    assert tour.objective < learned.objective <= report.bound
    assert learned.share_of_bound == pytest.approx(np.mean(learned.objectives) / report.bound)
    scenario = scenarios.load("three_clusters")
    for one in report.missions:
        again = fly(scenario, np.asarray(one.actions), one.seed)
        assert again.objective(scenario)[0] == one.objective
        assert again.data_bits[0] == one.data_bits
    out = capsys.readouterr().out
    assert "2 of 2 missions are proved to be the best" in out
    assert f"{100 * tour.share_of_bound:.1f}%" in out
    assert command(*arguments, "--json", tmp_path / "y.json") == 0
    assert (tmp_path / "y.json").read_bytes() == written


def test_the_mixed_integer_program_is_a_method_of_the_command(tmp_path):
    pytest.importorskip("highspy")
    (tmp_path / "small.toml").write_text(document.text(small(3)))
    arguments = ["--scenario", tmp_path / "small.toml", "--seeds", 1, "--objective", 0.5]
    found = []
    for method in ("mip", "diagram"):
        assert command(*arguments, "--method", method, "--json", tmp_path / "x.json") == 0
        (one,) = msgspec.json.decode((tmp_path / "x.json").read_bytes(), type=OptimumReport).missions
        assert not one.stopped
        found.append((one.users_collected, one.arrival_step))
        assert one.bound == pytest.approx(one.objective, abs=1e-6)
    assert found[0] == found[1]


def test_the_front_bounds_users_at_every_arrival(tmp_path):
    scenario = small(5)
    problem = ClairvoyantProblem(scenario, 5)
    reports = [report_of(scenario, w, [solve(problem, w)], []) for w in (0.0, 0.3, 0.6, 0.9, 1.0)]
    for one in reports:
        (best,) = one.missions
        assert greatest_users(reports, np.array([best.arrival_step]))[0] >= best.users_collected - 1e-9
    assert greatest_users(reports, np.array([0.0]))[0] < scenario.n_users
    draw_front(reports, tmp_path / "front.png")
    assert (tmp_path / "front.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--scenario", "town"], "radio.interference = 'associated'"),
        (["--scenario", "farm", "--objective", "-1"], "expected a weight between 0"),
        (["--scenario", "farm", "--time-limit", "soon"], "'soon'; expected seconds, at least 0"),
        (["--scenario", "farm", "--policy", "five_clusters_dueling"], "does not fit scenario 'farm'"),
        (["--scenario", "farm", "--policy", "tour", "tour"], "given 2 times; expected once"),
        (["--scenario", "farm", "--json", "/nowhere/x"], "/nowhere/x cannot be written"),
    ],
)
def test_a_mistake_is_one_line_and_status_2(capsys, arguments, complaint):
    assert command(*arguments) == 2
    err = capsys.readouterr().err
    assert complaint in err
    assert len(err.splitlines()) == 1
