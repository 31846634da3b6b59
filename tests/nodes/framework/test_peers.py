"""Peers are found by name: other nodes that subscribe or publish do not count."""

from types import SimpleNamespace
from typing import Any

import pytest

from uav_dc_ros.nodes.framework.mission_node import MissionNode
from uav_dc_ros.nodes.framework.node_table import NODES

US = "/uav1"


class End:
    """A publisher or subscription of the world, and the nodes at its other ends."""

    def __init__(self, nodes: list[str]) -> None:
        self.nodes = nodes

    def get_subscription_count(self) -> int:
        return len(self.nodes)

    get_publisher_count = get_subscription_count

    def infos(self) -> list[Any]:
        return [
            SimpleNamespace(node_namespace=name.rpartition("/")[0] or "/", node_name=name.rpartition("/")[2])
            for name in self.nodes
        ]


def is_ready(mission: list[str], move: list[str]) -> bool:
    """Whether a world with the peers policy and mission_monitor is matched on `mission` and `move`."""
    ends = {"mission": End(mission), "move": End(move)}
    found: list[bool] = []
    world = SimpleNamespace(
        peers=["policy", "mission_monitor"],
        rows=NODES,
        publishers_of={"mission": ends["mission"]},
        subscriptions_of={"move": ends["move"]},
        get_namespace=lambda: US,
        get_subscriptions_info_by_topic=lambda topic: ends[topic].infos(),
        get_publishers_info_by_topic=lambda topic: ends[topic].infos(),
        _peers_timer=SimpleNamespace(cancel=lambda: None),
        on_peers=lambda: found.append(True),
    )
    world._are_matched = MissionNode._are_matched.__get__(world)  # type: ignore[attr-defined]
    MissionNode._find_peers(world)  # type: ignore[arg-type]
    return bool(found)


@pytest.mark.parametrize(
    ("mission", "move", "ready"),
    [
        (["/uav1/policy", "/uav1/mission_monitor"], ["/uav1/policy"], True),
        (["/uav1/policy", "/uav1/mission_monitor", "/_ros2cli_71"], ["/uav1/policy"], True),
        (["/uav1/mission_monitor", "/_ros2cli_71"], ["/uav1/policy"], False),  # `ros2 topic echo`
        (["/uav1/policy", "/uav1/mission_monitor"], ["/_ros2cli_71"], False),  # `ros2 topic pub`
        (["/uav1/policy", "/mission_monitor"], ["/uav1/policy"], False),  # of another namespace
        (["/uav1/policy"], ["/uav1/policy"], False),
        ([], [], False),
    ],
)
def test_peers_are_found_by_name(mission: list[str], move: list[str], ready: bool) -> None:
    assert is_ready(mission, move) is ready
