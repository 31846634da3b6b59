"""`bag index`: one table over many bags, against evaluations of the same missions."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from pyarrow import parquet

from tests.bags.test_foreign import run
from tests.recordings import made
from tests.support.bags import mcap_file
from tests.support.worlds import tiny
from uav_dc_ros.api import rollout
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.objective import objective
from uav_dc_ros.recordings.index import COLUMNS, find_bags

Capture = pytest.CaptureFixture[str]
WORLD = tiny()
# To the dock, away and back again: the second arrival counts.
ACTIONS = [Action.RIGHT, Action.RIGHT, Action.FORWARD, Action.FORWARD, Action.LEFT, Action.RIGHT, 6, 6]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Bags in folders, a file that is a bag alone, a torn one, one without missions, and none."""
    root = tmp_path_factory.mktemp("bags")
    about = made.about(WORLD, 3, policy="own", policy_sha256="ab" * 32)
    home = made.flight(WORLD, act=lambda mission, step: int(ACTIONS[step]), seed=3, missions=2)
    made.write(root / "a" / "home", home, about)
    made.write(root / "b", made.flight(WORLD, act=lambda *_: 6, seed=3), made.about(WORLD, 3))
    torn = made.write(root / "torn", made.flight(WORLD, missions=20), about) / "torn_0.mcap"
    torn.write_bytes(torn.read_bytes()[: torn.stat().st_size // 2])
    (torn.parent / "metadata.yaml").unlink()
    (root / "single.mcap").write_bytes((root / "b" / "b_0.mcap").read_bytes())
    (root / "other.mcap").write_bytes(mcap_file(compression="none", chunked=True, n=3))  # type: ignore[arg-type]
    (root / "junk").mkdir()
    (root / "junk" / "junk_0.mcap").write_bytes(b"no bag")
    (root / ".b.1.partial").mkdir()
    (root / ".b.1.partial" / "b_0.mcap").write_bytes(b"")
    return root


def test_every_bag_is_found_once(folder: Path) -> None:
    found = [str(path.relative_to(folder)) for path in find_bags(folder)]
    assert sorted(found) == ["a/home", "b", "junk", "other.mcap", "single.mcap", "torn"]


def test_rows_are_the_missions_as_evaluated(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    out = run(capsys, "index", folder, "--out", tmp_path / "i.parquet")
    rows = parquet.read_table(tmp_path / "i.parquet").to_pylist()
    assert list(rows[0]) == list(COLUMNS)
    home = [row for row in rows if row["bag"] == "a/home"]
    flown = rollout(
        lambda state: np.full(state.step.shape, int(ACTIONS[int(state.step.max())])), WORLD, [3, 4]
    )
    assert [row["seed"] for row in home] == [3, 4]
    assert [row["outcome"] for row in home] == ["landed"] * 2
    assert [row["arrival_step"] for row in home] == flown.arrival_step.tolist() == [6.0, 6.0]
    assert [row["users_collected"] for row in home] == flown.users_collected.tolist()
    assert [row["data_bits"] for row in home] == flown.data_bits.tolist()
    expected = objective(
        flown.users_collected, flown.arrival_step, flown.landed, n_users=4, max_steps=WORLD.mission.max_steps
    )
    assert [row["objective"] for row in home] == expected.tolist()
    assert {(row["policy"], row["policy_sha256"]) for row in home} == {("own", "ab" * 32)}
    (hovering,) = (row for row in rows if row["bag"] == "b")
    assert (hovering["outcome"], hovering["arrival_step"], hovering["objective"]) == ("timeout", None, 0.0)
    torn = [row for row in rows if row["bag"] == "torn"]
    assert "no end" in torn[0]["problem"]
    assert torn[-1]["outcome"] == "unfinished"
    problems = {row["bag"]: row["problem"] for row in rows if row["mission"] is None}
    assert problems["other.mcap"] == "no mission"
    assert "junk_0.mcap starts with b'no bag'" in problems["junk"]
    line = next(line for line in out.splitlines() if line.startswith(" a/home"))
    assert "own (abababababab)" in line
    assert line.split()[-4:] == ["landed", "100.0%", "6.0", f"{expected.mean():.3f}"]


def test_csv_and_json_have_the_same_rows(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    rows = json.loads(run(capsys, "index", folder, "--json", "--out", tmp_path / "i.csv"))
    with (tmp_path / "i.csv").open(newline="") as file:
        read = list(csv.DictReader(file))
    assert read == [{key: "" if v is None else str(v) for key, v in row.items()} for row in rows]
    assert "i.csv exists; expected a new name" in run(
        capsys, "index", folder, "--out", tmp_path / "i.csv", status=2
    )


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["{empty}"], "holds no bag; expected folders or files with .mcap, .db3"),
        (["{empty}/none"], "no such folder; expected one with bags"),
        (["{empty}", "--out", "{empty}/i.json"], "expected a file NAME.parquet or NAME.csv"),
    ],
)
def test_folders_without_an_index(tmp_path: Path, capsys: Capture, options: list[str], expected: str) -> None:
    given = [option.format(empty=tmp_path) for option in options]
    assert expected in run(capsys, "index", *given, status=2)
