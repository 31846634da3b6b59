"""Other publishers of a mission's exclusive topics."""

from types import SimpleNamespace
from typing import Any

import pytest

from uav_dc_ros.nodes.framework import other_publishers
from uav_dc_ros.nodes.framework.node_table import NODES, WORLD_BESIDE_BRIDGE
from uav_dc_ros.nodes.play.playback_publisher import SubscriberMonitor
from uav_dc_ros.topics import TOPICS

OURS = {
    "pose": ["/uav1/world"],
    "users": ["/uav1/world"],
    "rates": ["/uav1/channel_monitor"],
    "mission": ["/uav1/world"],
    "move": ["/uav1/policy"],
}


def test_the_topics_that_a_mission_trusts_have_one_publisher() -> None:
    exclusive = [topic.name for topic in TOPICS.values() if topic.exclusive]
    assert exclusive == ["pose", "users", "rates", "mission", "move", "target", "clock"]
    for name in exclusive:
        others = [row.name for row in NODES.values() if name in row.publishes and row.name != "bridge"]
        assert len(others) == 1, name


def test_a_mission_alone_has_no_rivals() -> None:
    assert not other_publishers.find(OURS, "/uav1", NODES)
    assert not other_publishers.find({}, "/", NODES)


def test_a_player_is_named_with_what_it_publishes() -> None:
    found = other_publishers.find(
        OURS | {"pose": ["/uav1/world", "/player"], "rates": ["/player"]}, "/uav1", NODES
    )
    assert found.foreign == {"/player": ["pose", "rates"]}
    assert found.description("0123456789abcdef") == (
        "/player publishes pose, rates here (run 0123456789abcdef), and is no node of this mission"
    )


def test_a_node_of_our_names_in_another_namespace_is_foreign() -> None:
    assert other_publishers.find({"mission": ["/world"]}, "/uav1", NODES).foreign == {"/world": ["mission"]}


def test_a_node_that_is_there_twice_is_another_mission() -> None:
    found = other_publishers.find(OURS | {"mission": ["/uav1/world"] * 2}, "/uav1", NODES)
    assert found.description("0123456789abcdef") == (
        "another mission is being flown here by /uav1/world (run 0123456789abcdef)"
    )


def test_a_node_that_we_have_not_begun_is_another_mission() -> None:
    found = other_publishers.find(OURS, "/uav1", NODES, absent=["world", "policy"])
    assert found.description() == "another mission is being flown here by /uav1/world, /uav1/policy"


@pytest.mark.parametrize("twice", ["world", "policy"])
def test_the_graph_may_still_tell_of_a_node_that_was_killed(twice: str) -> None:
    publishers = {topic: names * (1 + names[0].endswith(twice)) for topic, names in OURS.items()}
    assert other_publishers.find(publishers, "/uav1", NODES)
    assert not other_publishers.find(publishers, "/uav1", NODES, restarted=[twice])


def test_nobody_is_a_rival_on_a_topic_that_this_mission_does_not_have() -> None:
    """Beside a real vehicle no node of the mission publishes a clock: a simulator may."""
    around = {**NODES, "world": WORLD_BESIDE_BRIDGE}
    assert not other_publishers.find({"clock": ["/gazebo"]}, "/", around)
    assert other_publishers.find({"clock": ["/gazebo"]}, "/", NODES)


def audience(publishers: dict[str, list[str]], *played: str) -> SubscriberMonitor:
    """Who is there while topics are played, as in the graph: full names of nodes, by topic."""

    def ends(topic: str) -> list[Any]:
        names = [name.rpartition("/") for name in ("/player", *publishers.get(topic, ()))]
        return [SimpleNamespace(node_namespace=space or "/", node_name=name) for space, _, name in names]

    node: Any = SimpleNamespace(get_publishers_info_by_topic=ends)
    outlets: Any = [SimpleNamespace(name=topic) for topic in played]
    return SubscriberMonitor(node, outlets)


@pytest.mark.parametrize(
    ("topic", "publisher", "is_refused"),
    [
        ("/pose", "/world", True),
        ("/pose", "/bridge", True),
        ("/uav2/move", "/uav2/policy", True),
        ("/uav2/pose", "/world", False),  # of another mission: a note reports it
        ("/pose", "/player", False),
        ("/pose", "/mavros", False),
        ("/diagnostics", "/world", False),  # which any node may publish
        ("/camera", "/world", False),
    ],
)
def test_a_bag_is_not_played_into_a_mission(topic: str, publisher: str, is_refused: bool) -> None:
    reported = audience({topic: [publisher]}, topic, "/other").mission()
    assert reported == (f"another mission is being flown here by {publisher}" if is_refused else None)
    assert audience({topic: [publisher]}, f"/elsewhere{topic}").mission() is None, "by --namespace"


def test_a_bag_s_clock_does_not_stand_beside_a_mission_s() -> None:
    beside = audience({"/clock": ["/world"]}, "/pose")
    assert beside.mission() is None
    assert beside.mission(["/clock"]) == "another mission is being flown here by /world"
