"""Latencies in a node's reports: as they are named now, and as older bags have them."""

import pytest

from uav_dc_ros.recordings.pages.health import NodeHistory, NodeStatus


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
def test_one_row_per_topic_has_the_latency_until_handling(values: dict[str, str]) -> None:
    node = NodeHistory("world")
    node.add(1.0, NodeStatus(0, "active", values))
    assert node.data()["latencies"] == [{"topic": "move", "p50_ms": 2.0, "p99_ms": 5.0}]
