"""Latencies in a node's reports: as they are named now, and as older bags have them."""

import pytest

from uav_dc_ros.recordings.pages.diagnostics import Node, Report


@pytest.mark.parametrize(
    "values",
    [
        {"move latency p50 [ms]": "2.0", "move latency p99 [ms]": "5.0"},
        {
            "move transport latency p50 [ms]": "1.0",
            "move transport latency p99 [ms]": "3.0",
            "move handling latency p50 [ms]": "2.0",
            "move handling latency p99 [ms]": "5.0",
        },
    ],
    ids=["older bags", "now"],
)
def test_one_row_tells_how_long_messages_took_until_they_were_handled(values: dict[str, str]) -> None:
    node = Node("world")
    node.add(1.0, Report(0, "active", values))
    assert node.page()["heard"] == [{"topic": "move", "p50_ms": 2.0, "p99_ms": 5.0}]
