"""Reads mission.launch.xml as `ros2 launch` would, as far as that file goes.

PyPI has no `launch`: this is a stand-in, made after its documentation. An element, an attribute or a
substitution that it does not know is an error.
"""

import re
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from ruamel.yaml import YAML

from uav_dc_ros.nodes.framework.node_table import NODES

ATTRIBUTES = {
    "launch": set(),
    "arg": {"name", "default", "description"},
    "let": {"name", "value", "if", "unless"},
    "group": {"if", "unless"},
    "node": {"pkg", "exec", "name", "namespace", "output", "on_exit", "if", "unless"},
    "param": {"name", "value", "type"},
}
BOOLEAN = {"true": True, "True": True, "1": True, "false": False, "False": False, "0": False}
TYPES: dict[str, Callable[[str], Any]] = {"str": str, "int": int, "float": float, "bool": BOOLEAN.__getitem__}


@dataclass(frozen=True)
class LaunchedNode:
    """A node that the launch file starts."""

    package: str
    executable: str
    name: str
    namespace: str
    parameters: dict[str, Any]


def arguments(path: Path) -> dict[str, dict[str, str]]:
    """Attributes of the file's arguments, by name."""
    return {arg.attrib["name"]: arg.attrib for arg in ElementTree.parse(path).getroot().iter("arg")}


def nodes(path: Path, given: Mapping[str, str]) -> list[LaunchedNode]:
    """What `ros2 launch uav_dc_ros mission.launch.xml NAME:=VALUE ...` starts."""
    root = ElementTree.parse(path).getroot()
    assert root.tag == "launch"
    unknown = given.keys() - arguments(path).keys()
    assert not unknown, unknown
    return _run(root, dict(given))


def _run(parent: ElementTree.Element, variables: dict[str, str]) -> list[LaunchedNode]:
    started = []
    for element in parent:
        known = ATTRIBUTES[element.tag]
        assert element.attrib.keys() <= known, f"{element.tag}: {element.attrib.keys() - known}"
        text = {k: v for k, v in element.attrib.items() if k != "description"}
        if "if" in text and not BOOLEAN[_expand(text["if"], variables)]:
            continue
        if "unless" in text and BOOLEAN[_expand(text["unless"], variables)]:
            continue
        if element.tag == "arg":
            if text["name"] not in variables:
                variables[text["name"]] = _expand(text["default"], variables)
        elif element.tag == "let":
            variables[text["name"]] = _expand(text["value"], variables)
        elif element.tag == "group":
            started += _run(element, dict(variables))
        else:
            assert text["output"] == "screen"
            assert (text.get("on_exit") == "shutdown") == NODES[text["name"]].needed
            started.append(
                LaunchedNode(
                    *(_expand(text[key], variables) for key in ("pkg", "exec", "name", "namespace")),
                    parameters={param.attrib["name"]: _value(param, variables) for param in element},
                )
            )
    return started


def _value(param: ElementTree.Element, variables: dict[str, str]) -> Any:
    assert param.tag == "param"
    assert param.attrib.keys() <= ATTRIBUTES["param"]
    text = _expand(param.attrib["value"], variables)
    if "type" in param.attrib:
        return TYPES[param.attrib["type"]](text)
    return YAML(typ="safe", pure=True).load(text)


def _expand(text: str, variables: Mapping[str, str]) -> str:
    text = re.sub(r"\$\(var (\w+)\)", lambda found: variables[found[1]], text)
    evaluated = re.sub(
        r'\$\(eval "([^"]*)"(?: (\w+))?\)',
        lambda found: str(eval(found[1], {}, {"time": time} if found[2] == "time" else {})),
        text,
    )
    assert "$(" not in evaluated, evaluated
    return evaluated
