"""The verb `filter`: a new bag with some topics of another."""

import argparse
from collections.abc import Collection, Iterable
from fnmatch import fnmatchcase
from pathlib import Path

from uav_dc_ros import cli
from uav_dc_ros.bags.edit.copy import add_output, copying, output
from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.errors import ParameterError

_names = cli.names("full names of topics, or patterns such as '/uav1/*'", start="/")


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    add = parser.add_argument
    add("bag", type=Path, metavar="BAG", help="folder of a bag, or one of its files")
    what = "full names of topics, or patterns such as '/uav1/*'"
    add("--topics", type=_names, metavar="A,B,...", help=f"{what}, to keep (default: all)")
    add("--exclude", type=_names, metavar="A,B,...", help=f"{what}, to leave out")
    add_output(parser)


def run(options: argparse.Namespace) -> int:
    """Write the new bag; the exit status."""
    if options.topics is None and options.exclude is None:
        raise ParameterError("neither --topics nor --exclude; expected at least one")
    with BagReader(options.bag, repeats=False) as reader:
        kept = _matching(reader.topics, options.topics or ("*",), "--topics")
        kept -= _matching(reader.topics, options.exclude or (), "--exclude")
        if not kept:
            raise ParameterError(f"--exclude {','.join(options.exclude)}: no topic is left; expected one")
        with copying([reader], output(options), topics=kept, made_by="bag filter") as copy:
            copy.hold(reader.held())
            copy.write(reader.recorded(kept))
    return 0


def _matching(topics: Collection[str], patterns: Iterable[str], option: str) -> set[str]:
    """Topics that match a pattern; raises ParameterError for a pattern that no topic matches."""
    found: set[str] = set()
    for pattern in patterns:
        matching = {topic for topic in topics if fnmatchcase(topic, pattern)}
        if not matching:
            listed = ", ".join(sorted(topics)) or "(none)"
            raise ParameterError(f"{option} {pattern}: no such topic; expected some of {listed}")
        found |= matching
    return found
