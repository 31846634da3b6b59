"""The Foxglove layout: what can be known about it without Foxglove."""

import json
import re
from collections.abc import Iterator
from typing import Any

import pytest
from rosbags.typesys import Stores, get_typestore

from uav_dc_ros import files, messages
from uav_dc_ros.nodes.live_view import LAYOUT, LAYOUT_FOLDER
from uav_dc_ros.topics import DIAGNOSTICS, MARKERS, PATH, POSE, TOPICS

FOLDER = files.shipped_folder(LAYOUT_FOLDER)
WHOLE = json.loads((FOLDER / LAYOUT).read_text("utf-8"))
PANELS: dict[str, dict[str, Any]] = WHOLE["configById"]
SCRIPTS = {script["name"]: script["sourceCode"] for script in WHOLE["userNodes"].values()}
OUTPUT = re.compile(r'^export const output = "(/studio_script/\w+)";$', re.M)
KNOWN_PANELS = {"3D", "Plot", "RawMessages", "DiagnosticSummary"}


def leaves(tree: Any) -> Iterator[str]:
    """Panels of the layout's tree."""
    if isinstance(tree, str):
        yield tree
        return
    assert set(tree) == {"direction", "first", "second", "splitPercentage"}
    assert tree["direction"] in ("row", "column")
    assert 0 < tree["splitPercentage"] < 100
    yield from leaves(tree["first"])
    yield from leaves(tree["second"])


def outputs() -> dict[str, set[str]]:
    """Fields that each script's topic has."""
    found = {}
    for source in SCRIPTS.values():
        told = OUTPUT.search(source)
        body = re.search(r"^type Output = \{\n(.*?)^\};$", source, re.M | re.S)
        assert told is not None
        assert body is not None
        found[told[1]] = set(re.findall(r"^  (\w+): (?:number|string);$", body[1], re.M))
    return found


def paths() -> Iterator[str]:
    """Message paths that plots and raw messages show."""
    for panel in PANELS.values():
        yield from (series["value"] for series in panel.get("paths", ()))
        if "topicPath" in panel:
            yield panel["topicPath"]


def test_it_has_what_foxglove_reads() -> None:
    assert set(WHOLE) == {"configById", "globalVariables", "userNodes", "playbackConfig", "layout"}


def test_the_tree_shows_every_panel_once() -> None:
    shown = list(leaves(WHOLE["layout"]))
    assert sorted(shown) == sorted(PANELS)
    assert {panel.partition("!")[0] for panel in shown} == KNOWN_PANELS


def test_the_3d_panel_shows_topics_of_the_table_in_the_map() -> None:
    panel = PANELS["3D!mission"]
    assert panel["followTf"] == "map"
    assert set(panel["topics"]) <= {f"/{name}" for name in TOPICS}
    kinds = {TOPICS[name[1:]].type for name, how in panel["topics"].items() if how["visible"]}
    assert kinds == {PATH, MARKERS, POSE}


def test_the_diagnostics_are_the_table_s() -> None:
    panel = PANELS["DiagnosticSummary!nodes"]
    assert TOPICS[panel["topicToRender"][1:]].type == DIAGNOSTICS


@pytest.mark.parametrize("path", sorted(paths()))
def test_what_is_plotted_exists(path: str) -> None:
    topic, *fields = path.split(".")
    if topic in outputs():
        assert set(fields) <= outputs()[topic]
        return
    store = get_typestore(Stores.ROS2_JAZZY)
    type = TOPICS[topic[1:]].type
    for field in fields:
        definition = dict(store.fielddefs[type][1])
        assert field in definition, f"{type} has no {field}"
        type = definition[field][1] if isinstance(definition[field][1], str) else definition[field][1][0]
    assert type in ("float64", "int32")


@pytest.mark.parametrize("name", sorted(SCRIPTS))
def test_a_script_reads_fields_that_its_topic_has_and_gives_those_it_promises(name: str) -> None:
    source = SCRIPTS[name]
    (topic,) = re.findall(r'^export const inputs = \["/(\w+)"\];$', source, re.M)
    assert f'event: Input<"/{topic}">' in source
    payload = messages.PAYLOADS[topic]
    read = set(re.findall(rf"\b{topic}\.(\w+)", source))
    assert read
    assert read <= set(payload.__struct_fields__)
    returned = re.search(r"^  return \{\n(.*?)^  \};$", source, re.M | re.S)
    assert returned is not None
    told = OUTPUT.search(source)
    assert told is not None
    assert set(re.findall(r"^    (\w+): ", returned[1], re.M)) == outputs()[told[1]]
