"""Names of listed users where a reader looks for them: report, info and export."""

import json
from pathlib import Path
from typing import Any

import pytest
from pyarrow import parquet

from tests.recordings import report_bags
from tests.support.worlds import tiny
from uav_dc_ros import bag as command
from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.recordings.step_reader import Steps

LISTED = [
    {"x_m": 0.0, "y_m": 0.0, "name": "barn & <b>mill</b>", "cluster": "north"},
    {"x_m": 20.0, "y_m": 10.0, "cluster": "north"},
    {"x_m": 100.0, "y_m": 100.0, "name": "pump", "data_bits": 1e12},
]
ALONE = ["cluster_centres_m", "users_per_cluster", "cluster_radius_m"]


@pytest.fixture(scope="module")
def named() -> Scenario:
    return tiny(users={"user": LISTED, **dict.fromkeys(ALONE)}, mission={"max_steps": 6})


@pytest.fixture(scope="module")
def bag(named: Scenario, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return report_bags.write(tmp_path_factory.mktemp("named") / "bag", named, seeds=(1, 2))


def run(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    with pytest.raises(SystemExit) as ended:
        command.main([str(word) for word in words])
    printed = capsys.readouterr()
    assert ended.value.code == 0, printed
    return printed.out


def test_a_report_has_the_names_of_users_and_clusters(
    bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "page.html"
    run(capsys, "report", bag, "--out", page)
    unpacked = report_bags.unpacked(page)
    assert unpacked["mission-0"]["table"]["name"] == [LISTED[0]["name"], None, "pump"]
    assert unpacked["data"]["world"]["cluster_names"] == ["north", "pump"]
    assert "<b>mill" not in page.read_text("utf-8")


def test_info_lists_the_users_that_were_not_collected(bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found: list[dict[str, Any]] = json.loads(run(capsys, "info", bag, "--json"))["missions"]
    with BagReader(bag) as reader:
        last = {step.mission: step.rates for step in Steps(reader, "") if step.rates is not None}
    names = (LISTED[0]["name"], "1", "pump")
    for mission in found:
        rates = last[mission["mission"]]
        assert rates is not None
        left = [name for name, collected in zip(names, rates.collected, strict=True) if not collected]
        assert mission["not_collected"] == left
        assert "pump" in left
    shown = run(capsys, "info", bag)
    assert "not collected" in shown
    assert "pump" in shown


def test_the_table_of_users_has_a_column_of_names(
    bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run(capsys, "export", bag, "--out", tmp_path / "tables", "--tables", "users")
    table = parquet.read_table(tmp_path / "tables" / "users.parquet").to_pydict()
    assert set(zip(table["user"], table["name"], strict=True)) == {
        (0, LISTED[0]["name"]),
        (1, None),
        (2, "pump"),
    }


def test_without_names_nothing_changes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = report_bags.write(tmp_path / "bag", tiny(mission={"max_steps": 4}))
    run(capsys, "export", bag, "--out", tmp_path / "tables", "--tables", "users")
    assert "name" not in parquet.read_schema(tmp_path / "tables" / "users.parquet").names
    assert json.loads(run(capsys, "info", bag, "--json"))["missions"][0]["not_collected"] is None
    assert "not collected" not in run(capsys, "info", bag)
