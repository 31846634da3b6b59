"""`bag export`: what the tables and transitions hold, against the environment and the bag itself."""

import csv
import json
import subprocess
import sys

import msgspec
import numpy as np
import pytest
from pyarrow import parquet

from tests.recordings.made import about, changing, copy, flight, write
from tests.support.worlds import tiny
from uav_dc_ros import bag as command
from uav_dc_ros import messages
from uav_dc_ros.core.grid import ACTION_LABELS, Action
from uav_dc_ros.env.gym_env import DataCollectionEnv
from uav_dc_ros.recordings.export.tables import TABLES

TINY = tiny()
MISSIONS, STEPS, SEED = 3, TINY.mission.max_steps, 4
ABOUT = about(TINY, SEED, policy="own", policy_sha256="ab" * 32)


def act(mission, step):
    """Moves that meet the edge of the grid, users and the dock."""
    return [1, 2, 2, 1, 3, 5, 6, 0, 2][(mission + step) % 9]


def export(capsys, bag, *options):
    """Exit status and output; of an error its line."""
    with pytest.raises(SystemExit) as exit:
        command.main(["export", str(bag), *map(str, options)])
    out, err = capsys.readouterr()
    if exit.value.code:
        assert (exit.value.code, len(err.splitlines())) == (2, 1), err
    return exit.value.code, out + err


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    recorded = flight(TINY, act=act, seed=SEED, missions=MISSIONS)
    return write(tmp_path_factory.mktemp("made") / "bag", recorded, ABOUT)


def rows_of(path):
    """Rows of a table of either format, with the values of Parquet."""
    if path.suffix == ".parquet":
        return parquet.read_table(path).to_pylist()
    kinds = TABLES[path.stem]
    read = {
        "int": int,
        "float": float,
        "bool": lambda text: {"true": True, "false": False}[text],
        "text": str,
    }
    with path.open(newline="") as file:
        return [
            {name: read[kinds[name]](value) if value else None for name, value in row.items()}
            for row in csv.DictReader(file)
        ]


@pytest.mark.parametrize(("format", "data"), [("parquet", "so_far"), ("csv", "so_far"), ("parquet", "step")])
def test_tables_hold_the_values_of_the_environment(bag, tmp_path, capsys, format, data):
    options = ("--out", tmp_path / "tables", "--format", format, "--reward-data", data)
    status, out = export(capsys, bag, *options)
    assert status == 0
    n_users = TINY.n_users
    assert f"3 missions: 27 rows of steps, {27 * n_users} rows of users, 3 rows of missions" in out
    assert sorted(path.name for path in tmp_path.iterdir()) == ["tables"], "nothing else is left"
    steps, users, missions = (rows_of(tmp_path / "tables" / f"{name}.{format}") for name in TABLES)
    env = DataCollectionEnv(tiny(reward={"data": data}))
    for mission in range(MISSIONS):
        _, info = env.reset(seed=SEED + mission)
        total = paid = 0.0
        totals = []
        for step in range(STEPS + 1):
            row = steps[mission * (STEPS + 1) + step]
            mine = users[(mission * (STEPS + 1) + step) * n_users :][:n_users]
            last = step == STEPS
            assert (row["mission"], row["step"], row["remaining_steps"]) == (mission, step, STEPS - step)
            assert [row["cell_x"], row["cell_y"], row["cell_z"]] == info["cell"].tolist()
            assert [row["x_m"], row["y_m"]] == (100.0 * info["cell"][:2]).tolist()
            assert row["time_s"] == 15.0 * (mission * (STEPS + 1) + step)
            assert row["action"] == (None if last else ACTION_LABELS[act(mission, step)])
            assert row["data_bits"] == info["data_bits"].sum()
            assert row["users_collected"] == info["collected"].sum()
            assert (row["total_reward"], row["reward"]) == ((total, paid) if step else (0.0, None))
            assert [one["user"] for one in mine] == list(range(n_users))
            assert [[one["x_m"], one["y_m"]] for one in mine] == info["users_m"].tolist()
            assert [one["data_bits"] for one in mine] == info["data_bits"].tolist()
            assert [one["collected"] for one in mine] == info["collected"].tolist()
            if step:
                assert [one["sinr"] for one in mine] == info["sinr"].tolist()
                assert [one["served"] for one in mine] == info["served"].tolist()
                assert row["sum_rate_bps"] == info["sum_rate_bps"]
            if not last:
                _, paid, _, _, info = env.step(act(mission, step))
                total = paid  # the form is the episode's
                totals.append(total)
        summary = missions[mission]
        assert summary["outcome"] == ("landed" if info["landed"] else "timeout") == row["phase"]
        assert (summary["seed"], summary["steps_flown"], summary["policy"]) == (SEED + mission, STEPS, "own")
        assert summary["users_collected"] == info["collected"].sum()
        assert summary["total_reward"] == total
        assert summary["reward"] == (total if data == "so_far" else pytest.approx(np.mean(totals), rel=1e-12))
        assert summary["reward_data"] == data
        rates = [one["sum_rate_bps"] for one in steps if one["mission"] == mission and one["step"]]
        assert summary["mean_sum_rate_bps"] == pytest.approx(np.mean(rates), rel=1e-12)


def test_both_formats_hold_the_same(bag, tmp_path, capsys):
    for format in ("parquet", "csv"):
        export(capsys, bag, "--out", tmp_path / format, "--format", format)
    for name in TABLES:
        assert rows_of(tmp_path / "csv" / f"{name}.csv") == rows_of(tmp_path / "parquet" / f"{name}.parquet")
    schema = parquet.read_schema(tmp_path / "parquet" / "steps.parquet")
    assert schema.metadata[b"scenario_fingerprint"].decode() == TINY.fingerprint


def test_only_the_tables_named(bag, tmp_path, capsys):
    status, _ = export(
        capsys, bag, "--out", tmp_path / "some", "--tables", "missions,steps", "--format", "csv"
    )
    assert status == 0
    assert sorted(path.name for path in (tmp_path / "some").iterdir()) == ["missions.csv", "steps.csv"]


def test_what_is_missing_is_empty(bag, tmp_path, capsys):
    holes = copy(bag, tmp_path / "a", changing("rates", 1, 3, lambda _: None))
    holes = copy(holes, tmp_path / "b", changing("users", 1, 5, lambda _: None))
    holes = copy(holes, tmp_path / "c", changing("mission", 1, 8, lambda _: None))
    assert export(capsys, holes, "--out", tmp_path / "t")[0] == 0
    steps, users, missions = (rows_of(tmp_path / "t" / f"{name}.parquet") for name in TABLES)
    at = {(row["mission"], row["step"]): row for row in steps}
    assert at[1, 3]["data_bits"] is at[1, 3]["reward"] is at[1, 4]["reward"] is None
    assert at[1, 5]["reward"] is not None
    assert at[1, 5]["x_m"] is at[1, 5]["time_s"] is None, "a pose belongs to the time of its users"
    mine = [row for row in users if (row["mission"], row["step"]) == (1, 3)]
    assert len(mine) == TINY.n_users
    assert {row["sinr"] for row in mine} == {None}
    assert None not in {row["x_m"] for row in mine}
    assert [row["outcome"] for row in missions][1] == "unfinished"
    # The mission's reward is of the steps that have one: not 3, for want of rates, nor 8, for want of a cell.
    assert (missions[1]["total_reward"], missions[1]["reward"]) == (None, at[1, 7]["total_reward"])
    assert export(capsys, holes, "--out", tmp_path / "step", "--reward-data", "step")[0] == 0
    steps, missions = (rows_of(tmp_path / "step" / f"{name}.parquet") for name in ("steps", "missions"))
    known = [row["total_reward"] for row in steps if row["mission"] == 1 and row["step"] not in (0, 3, 8)]
    assert len(known) == 6
    assert missions[1]["reward"] == pytest.approx(np.mean(known), rel=1e-12)


def test_transitions_are_those_of_the_environment(bag, tmp_path, capsys):
    check_transitions(capsys, bag, tmp_path / "t.npz", "mission", "episode")


@pytest.mark.parametrize("observation", ["position", "map"])
def test_other_observations_and_the_immediate_reward(bag, tmp_path, capsys, observation):
    check_transitions(capsys, bag, tmp_path / "t.npz", observation, "immediate")


@pytest.mark.parametrize("form", ["immediate", "episode"])
def test_transitions_of_the_data_of_the_step(bag, tmp_path, capsys, form):
    check_transitions(capsys, bag, tmp_path / "t.npz", "mission", form, "step")


def check_transitions(capsys, bag, out, observation, form, data="so_far"):
    status, printed = export(
        *(capsys, bag, "--transitions", "--out", out),
        *("--observation", observation, "--reward-form", form, "--reward-data", data),
    )
    assert status == 0
    assert (
        f"24 transitions of {len(DataCollectionEnv(TINY, observation).reset(seed=0)[0])} numbers" in printed
    )
    made = np.load(out)
    env = DataCollectionEnv(tiny(reward={"form": form, "data": data}), observation)
    i = 0
    for mission in range(MISSIONS):
        seen, _ = env.reset(seed=SEED + mission)
        for step in range(STEPS):
            after, reward, terminated, truncated, _ = env.step(act(mission, step))
            assert made["observation"][i].tobytes() == seen.tobytes()
            assert made["next_observation"][i].tobytes() == after.tobytes()
            assert made["action"][i] == act(mission, step)
            assert made["reward"][i] == reward
            assert (made["terminated"][i], made["truncated"][i]) == (terminated, truncated)
            assert (made["flight"][i], made["mission"][i], made["step"][i]) == (0, mission, step)
            seen, i = after, i + 1
    assert len(made["action"]) == i
    metadata = json.loads(str(made["metadata"]))
    assert metadata["scenario_fingerprint"] == TINY.fingerprint
    assert (metadata["observation"], metadata["reward"]["form"]) == (observation, form)
    assert metadata["reward"]["data"] == data
    assert sorted(path.name for path in out.parent.iterdir()) == ["t.npz"], "nothing else is left"


def test_on_arrival_a_mission_terminates_at_the_dock_and_truncates_elsewhere(tmp_path, capsys):
    world = tiny(mission={"episode_end": "on_arrival"})
    way = [1, 1, 2, 2]
    recorded = flight(
        world, act=lambda mission, step: way[step] if mission == 0 and step < 4 else 6, missions=2
    )
    bag = write(tmp_path / "bag", recorded, about(world))
    assert export(capsys, bag, "--transitions", "--out", tmp_path / "t.npz")[0] == 0
    made = np.load(tmp_path / "t.npz")
    assert made["terminated"].tolist() == [False] * 3 + [True] + [False] * 8
    assert made["truncated"].tolist() == [False] * 11 + [True]


def test_the_action_of_a_transition_is_what_was_flown(tmp_path, capsys):
    """A move that came too late was not; one that the bag lacks shows in the cells."""
    recorded = flight(TINY, act=lambda mission, step: [6, 1, 2][step % 3])
    right = messages.Move(mission=0, step=0, action="right")
    late = changing("move", 0, 0, lambda _: right)
    lost = changing("move", 0, 1, lambda _: None)
    recorded = [kept for message in recorded if (kept := lost(late(message))) is not None]
    bag = write(tmp_path / "bag", recorded, about(TINY, pace="10.0"))
    status, out = export(capsys, bag, "--transitions", "--out", tmp_path / "t.npz")
    assert status == 0
    assert "2 actions are deduced from the cells" in out
    assert np.load(tmp_path / "t.npz")["action"][:3].tolist() == [Action.HOVER, Action.RIGHT, Action.FORWARD]


def test_what_is_no_transition_is_skipped_and_counted(tmp_path, capsys):
    hovering = flight(TINY, act=lambda mission, step: 6)
    jump = changing("mission", 0, 6, lambda one: msgspec.structs.replace(one, cell=(2, 0, 0)))
    recorded = [jump(m) for m in map(changing("rates", 0, 3, lambda _: None), hovering) if m]
    bag = write(tmp_path / "bag", recorded, about(TINY))
    status, out = export(capsys, bag, "--transitions", "--out", tmp_path / "t.npz")
    assert status == 0
    assert "2 skipped: a step whose start or end is not recorded" in out
    assert "2 skipped: a step between cells that are not adjacent" in out
    assert np.load(tmp_path / "t.npz")["step"].tolist() == [0, 1, 4, 7]


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["--out", "{taken}"], "exists; expected a new name, nothing is overwritten"),
        (["--transitions", "--out", "{taken}/t.csv"], "expected a file NAME.npz for transitions"),
        (["--transitions", "--out", "{new}.npz", "--tables", "steps"], "--tables applies to tables only"),
        (["--out", "{new}", "--observation", "map"], "--observation applies to --transitions only"),
        (["--out", "{new}", "--tables", "steps,poses"], "'poses'; expected some of steps, users, missions"),
        (["--out", "/proc/new"], "/proc/new cannot be written"),
        (
            ["--out", "{new}", "--scenario", "five_clusters_hover"],
            "start this node with the mission's scenario",
        ),
        (["--transitions", "--out", "{new}.npz", "--scenario", "five_clusters_hover"], "holds no transition"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_mistake_is_one_line_and_leaves_nothing(bag, tmp_path, capsys, options, complaint):
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "mine").write_text("mine")
    given = [one.format(taken=tmp_path / "taken", new=tmp_path / "new") for one in options]
    status, err = export(capsys, bag, *given)
    assert status == 2
    assert complaint in err
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]
    assert [path.name for path in (tmp_path / "taken").iterdir()] == ["mine"]


def test_csv_needs_no_pyarrow_and_parquet_reports_what_it_needs(bag, tmp_path):
    def without_pyarrow(*options):
        code = "import sys; sys.modules['pyarrow'] = sys.modules['torch'] = None\n"
        code += f"from uav_dc_ros.bag import main; main(['export', {str(bag)!r}, *{[*map(str, options)]!r}])"
        return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)

    refused = without_pyarrow("--out", tmp_path / "p")
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1)
    assert 'pip install "uav_dc_ros[train]", or --format csv' in refused.stderr
    assert without_pyarrow("--out", tmp_path / "c", "--format", "csv").returncode == 0
    assert without_pyarrow("--out", tmp_path / "t.npz", "--transitions").returncode == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["c", "t.npz"]


def test_many_rows_come_in_row_groups(tmp_path, capsys, monkeypatch):
    from uav_dc_ros.recordings.export import tables

    monkeypatch.setattr(tables, "ROWS", 20)
    bag = write(tmp_path / "bag", flight(TINY, missions=3), about(TINY))
    assert export(capsys, bag, "--out", tmp_path / "t")[0] == 0
    assert parquet.ParquetFile(tmp_path / "t" / "users.parquet").num_row_groups == 6
    assert len(rows_of(tmp_path / "t" / "users.parquet")) == 27 * TINY.n_users


def test_two_flights_are_distinguished(tmp_path, capsys):
    first = flight(TINY, steps=4)
    second = flight(TINY, begun_ns=first[-1].log_time_ns + 10**9)
    bag = write(tmp_path / "bag", first + second, about(TINY))
    assert export(capsys, bag, "--out", tmp_path / "t", "--format", "csv")[0] == 0
    missions = rows_of(tmp_path / "t" / "missions.csv")
    assert [(row["flight"], row["outcome"], row["steps_flown"]) for row in missions] == [
        (0, "aborted", 4),
        (1, "timeout", STEPS),
    ]
