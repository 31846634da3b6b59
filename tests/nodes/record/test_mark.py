"""`bag mark`: its text is in the recording, in `info` and in the report; without a recorder it fails."""

import json
import signal
from pathlib import Path

import pytest

from tests.bags.test_foreign import run
from tests.conftest import Ros, finish, wait_for
from tests.recordings import made
from tests.recordings.report_bags import unpacked
from tests.support.bags import text
from tests.support.worlds import tiny
from uav_dc_ros import topics
from uav_dc_ros.bags.read import BagMessage, BagReader
from uav_dc_ros.recordings.marks import read_marks


def test_a_mark_reaches_the_recorders_of_its_namespace(ros: Ros) -> None:
    recorder = ros.start("uav_dc_ros.bag", "record", "--out", ros.folder / "bag", "--namespace", "/uav1")
    assert recorder.stdout is not None
    wait_for(recorder.stdout, "Ctrl-C ends it")
    status, output = ros.run(
        "uav_dc_ros.bag", "mark", "Böe from the north", "--namespace", "/uav1", "--timeout", 60
    )
    assert (status, output) == (
        0, "marked 'Böe from the north' in the recording of /uav1/bag_record\n"
    )  # fmt: skip
    status, output = ros.run("uav_dc_ros.bag", "mark", "elsewhere", "--namespace", "/uav2", "--timeout", 0.3)
    assert status == 2
    assert "no recorder received /uav2/mark within 0.3 s; expected one that records in /uav2" in output
    recorder.send_signal(signal.SIGINT)
    assert finish(recorder)[0] == 0
    with BagReader(ros.folder / "bag") as reader:
        (mark,) = read_marks(reader)
        assert (mark.namespace, mark.text) == ("/uav1", "Böe from the north")
        assert read_marks(reader, "") == []


def test_info_and_reports_show_marks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    world = tiny()
    recorded = made.flight(world)
    at_ns = recorded[20].log_time_ns + 1
    marks = [
        BagMessage(topic, topics.JSON, data, at_ns, at_ns)
        for topic, data in (
            ("/mark", text("gust\n\x1b[31m")),
            ("/mark", b"\0\1\0\0\t"),
            ("/x/mark", text("other")),
        )
    ]
    ordered = sorted([*recorded, *marks], key=lambda message: message.log_time_ns)
    bag = made.write(tmp_path / "bag", ordered, made.about(world))
    at_s = (at_ns - recorded[0].log_time_ns) / 1e9
    out = run(capsys, "info", bag)
    assert f" mark at {at_s:.3f} s: gust\\n\\x1b[31m" in out
    assert f" mark in /x at {at_s:.3f} s: other" in out
    found = json.loads(run(capsys, "info", bag, "--json"))["marks"]
    assert found == [
        {"s": at_s, "namespace": "", "text": "gust\\n\\x1b[31m"},
        {"s": at_s, "namespace": "/x", "text": "other"},
    ]
    run(capsys, "report", bag, "--out", tmp_path / "page.html")
    page = unpacked(tmp_path / "page.html")
    assert page["data"]["health"]["marks"] == [{"s": at_s, "text": "gust\\n\\x1b[31m"}]


@pytest.mark.parametrize("given", ["", "  ", "two\nlines", "x" * 201, "\x1b[31mred"])
def test_texts_that_are_no_mark(capsys: pytest.CaptureFixture[str], given: str) -> None:
    assert "expected one line of 1 to 200 characters" in run(capsys, "mark", given, status=2)
