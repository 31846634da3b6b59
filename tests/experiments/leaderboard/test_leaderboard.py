"""The leaderboard: its worlds, its figures, and a command that was killed, or that another policy joins."""

import json
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
from PIL import Image

from tests.support.worlds import saved, tiny
from uav_dc_ros import scenarios
from uav_dc_ros.agents import agent as agents
from uav_dc_ros.agents import policy as policies
from uav_dc_ros.core.objective import DEFAULT_WEIGHT
from uav_dc_ros.experiments.evaluate.fields import evaluate_fields
from uav_dc_ros.experiments.evaluate.rollout import roll_out
from uav_dc_ros.experiments.evaluate.shifts import apply, parse, transmitting
from uav_dc_ros.experiments.leaderboard import cli, decision_times, flights, page, pictures, standings, worlds
from uav_dc_ros.experiments.leaderboard.standings import LeaderboardReport
from uav_dc_ros.experiments.leaderboard.worlds import BoardWorld, Sizes, boards

SMALL = [
    "--planners",
    "nearest",
    "tour",
    "--only",
    "fields",
    "--fields",
    "3",
    "--bounds",
    "2",
    "--width",
    "20",
]


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A folder for the command, which flies in this process, two worlds a block, and draws nothing.

    The bounds are made up: to work them out takes seconds, and has tests of its own.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(flights, "solve", lambda problem, *_, **__: made_up(problem.scenario.name))
    monkeypatch.setattr(flights, "BLOCK", 2)
    monkeypatch.setattr(pictures, "draw", lambda *_: None)
    monkeypatch.setattr(policies, "names", lambda: ["five_clusters_dueling", "five_clusters_position"])
    monkeypatch.setattr(cli, "run_tasks", in_process())
    monkeypatch.setattr(decision_times, "FIELDS", 1)
    return tmp_path


def made_up(name):
    """A bound for each of the first two random fields; the mission of the first one is the best."""
    bound = {"random_0": 0.95, "random_1": 0.99}[name]
    return SimpleNamespace(bound=bound, objective=min(bound, 0.96))


def in_process(stop_after=None, flown=None):
    """What `run_tasks` does, but in this process."""

    def run(tasks, work, n_workers, on_progress, again):
        for i, task in enumerate(tasks):
            if i == stop_after:
                raise KeyboardInterrupt
            if flown is not None:
                flown.append((task.name, [one.name for one in task.contestants], task.bounds))
            work(task, lambda done, task=task: on_progress(task.name, done))

    return run


def command(*options):
    with pytest.raises(SystemExit) as exit:
        cli.main([*SMALL, *options])
    return exit.value.code


def content(folder):
    return {name: (folder / name).read_bytes() for name in (cli.REPORT_FILE, page.PAGE_FILE)}


def decoded(folder):
    return msgspec.json.decode((folder / cli.REPORT_FILE).read_bytes(), type=LeaderboardReport)


def test_figures_are_those_of_evaluate(here):
    assert command("--objective", "0.8") == 0
    report = decoded(here / "leaderboard")
    (board,) = report.boards
    names = ["nearest", "tour"]
    expected = evaluate_fields([agents.load(name) for name in names], 3, range(1), 0.8)
    rows = {row.policy: row for row in board.rows}
    for one in expected.evaluations:
        row = rows[one.policy]
        assert (row.objective, row.landing_rate, row.users, row.arrival) == (
            one.objective,
            one.landing_rate,
            one.users_share,
            one.arrival_share,
        )
        assert row.share_of_bound.n == 2
        assert row.share_of_bound.mean == pytest.approx(np.mean(row.objectives[:2]) / board.bound)
        assert row.users.mean <= row.data.mean <= 1.0
    assert (board.bound, board.found, board.n_optimal) == (0.97, 0.955, 1)
    assert [one.bound for one in sorted(report.worst, key=lambda one: one.scenario)] == [0.95, 0.99, None]
    assert report.baseline == "nearest", "without search and without a policy, the first planner"
    (compared,) = expected.comparisons
    assert rows["tour"].differences["objective"] == compared.differences["objective"]
    assert (rows["tour"].better, rows["tour"].worse) == (compared.better, compared.worse)
    assert [row.policy for row in board.rows] == sorted(rows, key=lambda name: -rows[name].objective.mean)
    worst = [int(one.scenario.removeprefix("random:")) for one in report.worst]
    assert worst == expected.evaluations[0].worst_fields
    assert (report.best.scenario, report.median.scenario) == tuple(f"random:{worst[i]}" for i in (2, 1))
    assert all(one.best == "tour" for one in report.worst)
    text = (here / "leaderboard" / page.PAGE_FILE).read_text()
    assert f"| {rows['tour'].objective.mean:.4f} (" in text.replace("| `tour` ", "")
    assert "| `tour` | `fields` | " in (here / "leaderboard" / "decision_times.md").read_text()


def test_a_killed_command_continues_and_a_contestant_that_joins_flies_alone(here, monkeypatch, capsys):
    monkeypatch.setattr(flights, "BLOCK", 1)
    flown = []
    two = ["--fields", "2", "--planners", "nearest", "tour"]
    whole = [(f"fields, {i} to {i} of 2", ["nearest", "tour"], True) for i in (1, 2)]
    monkeypatch.setattr(cli, "run_tasks", in_process(flown=flown))
    assert command(*two) == 0
    assert flown == whole
    first = content(here / "leaderboard")
    monkeypatch.setattr(cli, "run_tasks", in_process(stop_after=1))
    assert command(*two, "--flights", "others") == 130
    flown.clear()
    monkeypatch.setattr(cli, "run_tasks", in_process(flown=flown))
    assert command(*two, "--flights", "others", "--workers", "1") == 0
    assert flown == whole[1:], "only what is missing"
    assert content(here / "leaderboard") == first
    flown.clear()
    assert command(*two, "random") == 0
    assert [(names, bounds) for _, names, bounds in flown] == [(["random"], False)] * 2
    rows = {row.policy: row for row in decoded(here / "leaderboard").boards[0].rows}
    assert rows.keys() == {"nearest", "tour", "random"}
    capsys.readouterr()
    for path in (here / "leaderboard_flights").glob("[!b]*.json"):
        path.write_bytes(b"{")
    assert command(*two) == 2
    error = capsys.readouterr().err
    assert "cannot be read: " in error
    assert "delete it, and it is flown again" in error
    assert len(error.splitlines()) == 1


def test_other_causes_are_other_files(tmp_path):
    block = flights.blocks(boards(Sizes(fields=1, missions=1, variants=1, bounds=1), ("fields",))[0], 0.8, 9)[
        0
    ]
    planner = flights.Contestant(name="a", argument="a")
    policy = msgspec.structs.replace(planner, sha256="0")
    searching = msgspec.structs.replace(policy, search=8)
    changes = {"weight": 0.5, "n_missions": 2, "worlds": (BoardWorld(scenario="random:1"),)}
    others = [msgspec.structs.replace(block, **{key: value}) for key, value in changes.items()]
    files = [flights.result_file(tmp_path, one, planner) for one in (block, *others)]
    files += [flights.result_file(tmp_path, block, one) for one in (searching, policy)]
    assert len(set(files)) == 6
    moved = msgspec.structs.replace(policy, argument="elsewhere", name="b")
    assert flights.result_file(tmp_path, block, moved) == files[-1], "the same policy in another folder"
    wider = msgspec.structs.replace(block, width=10)
    assert flights.result_file(tmp_path, wider, planner) == files[0]
    assert flights.bounds_file(tmp_path, wider) != flights.bounds_file(tmp_path, block)


def test_a_policy_flies_in_its_own_world_and_one_for_any_field_everywhere():
    found = boards(Sizes(fields=1, missions=1, variants=1, bounds=1))
    own, planner = agents.load("five_clusters_dueling"), agents.load("tour")
    flies = [board.name for board in found if cli._flies(own, board)]
    assert flies == ["five_clusters", *(f"five_clusters, {shift}" for shift in worlds.SHIFTS[:-1])]
    assert all(cli._flies(planner, board) for board in found)
    assert {board.section for board in found} == set(worlds.SECTIONS)
    assert {board.name for board in found if board.section == "shipped"} == set(scenarios.names())
    homes = {policies.load(name).scenario.name for name in policies.names()}
    assert homes <= {board.home for board in found}, "each shipped policy flies"


def test_a_world_is_its_scenario_with_one_thing_changed():
    plain = scenarios.load("random:3")
    for name, keys in worlds.CHANNELS.items():
        scenario = BoardWorld(scenario="random:3", variant=name).load().scenario
        radio = msgspec.to_builtins(scenario.radio)
        assert {key: radio[key] for key in keys} == keys
        assert msgspec.structs.replace(scenario, radio=plain.radio) == plain
    for kind in worlds.OBSTACLES:
        one, again = (BoardWorld(scenario="random:3", variant=kind).load().scenario for _ in range(2))
        assert one == again
        assert [obstacle.kind == "building" for obstacle in one.obstacles] == [kind == worlds.BUILDINGS] * 3
        assert one.moves is not None
        assert one.users == plain.users


def test_a_shift_is_flown_as_evaluate_does_and_paired_with_the_same_fields(here, monkeypatch):
    monkeypatch.setattr(worlds, "SHIFTS", ("users.missing=30%", "radio.noise_power_dbm=+6"))
    options = ["--only", "fields", "shifts", "--variants", "2", "--missions", "1", "--planners", "nearest"]
    assert command(*options) == 0
    report = decoded(here / "leaderboard")
    by_name = {board.name: board for board in report.boards}
    text = "users.missing=30%"
    (row,) = by_name[text].rows
    plain = by_name["fields"].rows[0].objectives
    for i in range(2):
        world = apply(parse(text), scenarios.load(f"random:{i}"))
        act = agents.load("nearest").act_in(world.known)
        missions = roll_out(world.scenario, act, [0], transmitting=transmitting(world.scenario, [0], 0.3))
        assert row.objectives[i] == missions.objective(world.scenario, DEFAULT_WEIGHT)[0]
    assert row.shift_effect.mean == pytest.approx(np.mean(row.objectives) - np.mean(plain[:2]))
    assert by_name[text].bound is None
    shifted = by_name[f"five_clusters, {text}"]
    assert {one.policy for one in shifted.rows} == {
        "nearest",
        "five_clusters_dueling",
        "five_clusters_position",
    }


def test_a_policy_that_does_not_fit_is_named():
    refusal = flights.BlockResult(refused="policy 'x' does not fit")
    flown = flights.BlockResult(objective=[0.5], users=[0.4], data=[0.4], landed=[True], arrival=[0.9])
    result = standings.BoardResults(
        boards(Sizes(fields=1, missions=1, variants=1, bounds=0), ("fields",))[0],
        {"x": refusal, "y": flown},
        flights.Bounds(bound=[], found=[]),
    )
    found = standings._standings(result, None, "x")
    assert ([row.policy for row in found.rows], found.refused) == (["y"], {"x": "policy 'x' does not fit"})
    assert flights.joined([result.flown["y"], refusal]) == refusal


def test_a_sheet_has_a_tile_for_each_flight(here, tmp_path):
    assert command("--fields", "1", "--planners", "nearest", "--bounds", "0") == 0
    report = decoded(here / "leaderboard")
    for name in ("one.png", "again.png"):
        pictures._sheet(report.worst * 2, 3, 0.25, agents.load("nearest"), report, tmp_path / name)
    with Image.open(tmp_path / "one.png") as sheet:
        assert sheet.width == 3 * 180
        tiles = [np.asarray(sheet.convert("RGB"))[:, i * 180 : (i + 1) * 180] for i in range(3)]
    assert (tiles[0] == tiles[1]).all()
    assert np.ptp(tiles[0]) > 100
    assert np.ptp(tiles[2], axis=(0, 1)).max() == 0, "nothing but paper"
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "again.png").read_bytes()


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["--policy", "tour"], "--policy tour: a planner; expected --planners tour"),
        (["--policy", "nowhere"], "policy 'nowhere': no such name or folder"),
        (
            ["--policy", "elsewhere"],
            "--policy test: it flies in 'tiny' only; expected a policy for any field, or",
        ),
        (["--search", "8"], "--search 8 without --policy; expected a policy that searches"),
        (
            ["--policy", "copy"],
            "another policy has the name 'five_clusters_dueling'; expected a name of its own",
        ),
        (["--only", "shift"], "argument --only: invalid choice: 'shift'"),
        (["--fields", "0"], "argument --fields: '0'; expected a whole number of at least 1"),
        (["--objective", "2"], "argument --objective: '2'; expected a weight"),
        (["--out", "/dev/null/x"], "/dev/null/x cannot be made: Not a directory"),
    ],
)
def test_a_mistake_is_one_line_and_status_2(here, capsys, options, complaint):
    saved(here / "elsewhere", tiny())
    saved(here / "copy", scenarios.load("farm"), name="five_clusters_dueling")
    assert command(*options) == 2
    error = capsys.readouterr().err
    assert complaint in error
    assert len(error.splitlines()) == 1
    assert not (here / "leaderboard_flights").exists()


@pytest.mark.long
def test_all_sections_fly_in_processes_and_are_drawn(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    sizes = ["--fields", "12", "--missions", "2", "--variants", "2", "--bounds", "2", "--width", "50"]
    bytes_of = {}
    for workers in ("2", "1"):
        with pytest.raises(SystemExit) as exit:
            cli.main([*sizes, "--workers", workers, "--out", workers, "--flights", f"flights{workers}"])
        assert exit.value.code == 0
        folder = tmp_path / workers
        bytes_of[workers] = {
            path.name: path.read_bytes() for path in folder.iterdir() if path.name != "decision_times.md"
        }
    assert bytes_of["1"] == bytes_of["2"]
    assert bytes_of["1"].keys() == {cli.REPORT_FILE, page.PAGE_FILE, page.FLIGHTS_PICTURE, page.WORST_PICTURE}
    report = json.loads(bytes_of["1"][cli.REPORT_FILE])
    assert len(report["worst"]) == 10
    for board in report["boards"]:
        if board["bound"] is not None:
            n = board["n_bounded"]
            assert all(np.mean(row["objectives"][:n]) <= board["bound"] for row in board["rows"])
    assert sum(board["bound"] is not None for board in report["boards"]) >= 10
    assert report["baseline"] == "search"
    assert {row["policy"] for board in report["boards"] for row in board["rows"]} == set(
        report["contestants"]
    )
