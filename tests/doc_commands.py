"""Command lines in documents, parsed by the programs' own parsers."""

import importlib
import re
import shlex
from collections.abc import Iterator
from typing import Any

import pytest
from ruamel.yaml import YAML

from uav_dc_ros import cli
from uav_dc_ros.nodes.framework.node_table import NODES
from uav_dc_ros.nodes.framework.parameters import COMMON

QOS = re.compile(r"qos_overrides\./(\w+)\.(publisher|subscription)\.(?:history|depth|reliability|durability)")


class Parsed(BaseException):
    """A command line was parsed; what it would do is not done."""


def blocks(text: str, language: str) -> list[str]:
    """The fenced blocks of a language in a document."""
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def commands(text: str) -> Iterator[list[str]]:
    """Each command of this project in a document, without the interpreter."""
    lines = [line for block in blocks(text, "sh") for line in block.replace("\\\n", " ").splitlines()]
    lines += re.findall(r"`(python -m uav_dc_ros[^`]*)`", " ".join(text.split("\n")))
    for line in lines:
        for command in " ".join(shlex.split(line, comments=True)).split(" && "):
            words = command.split()
            if words[1:2] == ["-m"] and words[2].startswith("uav_dc_ros") and "VERB" not in words:
                yield words[2:]


def parameter(node: str, assignment: str) -> Any:
    """The value that a node would use of `NAME:=VALUE`."""
    name, _, text = assignment.partition(":=")
    if (override := QOS.fullmatch(name)) is not None:
        topic, end = override.groups()
        assert topic in getattr(NODES[node], {"publisher": "publishes", "subscription": "subscribes"}[end])
        return text
    row = {row.name: row for row in (*NODES[node].parameters, *COMMON)}[name]
    return row.value(YAML(typ="safe", pure=True).load(text))


def parsed(monkeypatch: pytest.MonkeyPatch, words: list[str]) -> Any:
    """What the real parser of a command makes of its options."""
    found = []

    def parse_args(self: cli.Parser, *arguments: Any) -> None:
        found.append(super(cli.Parser, self).parse_args(*arguments))
        raise Parsed

    monkeypatch.setattr(cli.Parser, "parse_args", parse_args)
    with pytest.raises(Parsed):
        importlib.import_module(words[0]).main(words[1:])
    return found[0]
