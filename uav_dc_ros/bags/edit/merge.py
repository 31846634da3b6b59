"""The verb `merge`: one bag of several.

Bags whose times do not overlap follow each other, each in its order of recording. The messages of others are
sorted by log time; one that several of them have is written once. A latched message that a bag repeats at its
head is left out where the bag before it ends with the same message.
"""

import argparse
import heapq
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path

from uav_dc_ros.bags.edit.copy import BagCopy, add_output, copying, merged_about, output
from uav_dc_ros.bags.metadata import MADE_BY_KEY
from uav_dc_ros.bags.read import BagMessage, BagReader
from uav_dc_ros.errors import BagError, ParameterError


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    bags = "folders of bags, or files of them, in any order"
    parser.add_argument("bags", type=Path, nargs="+", metavar="BAG", help=bags)
    add_output(parser)


def run(options: argparse.Namespace) -> int:
    """Write the new bag; the exit status."""
    if len(options.bags) < 2:
        raise ParameterError(f"{options.bags[0]}: a single bag; expected at least two")
    with ExitStack() as closing:
        readers = [closing.enter_context(BagReader(path, repeats=False)) for path in options.bags]
        readers.sort(key=lambda reader: (reader.first_ns, reader.last_ns, str(reader.path)))
        about = merged_about(readers)
        n_missions = about.pop("missions", None)
        with copying(readers, output(options), about=about, made_by="bag merge") as copy:
            copy.hold(readers[0].held())
            for group in _overlapping(readers):
                _write(copy, group, is_first=group[0] is readers[0])
            if n_missions is not None and not any(map(_is_status, copy.duplicates)):
                copy.add_about({"missions": n_missions})
        named = {key for reader in readers for key in reader.about} - {MADE_BY_KEY, "missions"}
        if differing := sorted(named - about.keys()):
            print(f"  the bags differ in {', '.join(differing)}: the new bag does not name it")
    return 0


def _overlapping(readers: Sequence[BagReader]) -> Iterator[list[BagReader]]:
    """Bags in order of time, in groups that overlap each other."""
    group: list[BagReader] = []
    end_ns = 0
    for reader in readers:
        if group and reader.first_ns > end_ns:
            yield group
            group = []
        group.append(reader)
        end_ns = max(end_ns, reader.last_ns)
    yield group


def _write(copy: BagCopy, group: Sequence[BagReader], *, is_first: bool) -> None:
    if len(group) == 1:
        if not is_first:
            copy.write(message for message in _head(group[0]) if not copy.holds(message))
        copy.write(group[0].recorded())
        return
    for reader in group:
        if reader.set_back_ns:
            raise BagError(
                f"bag {reader.path}: its clock was set back by {reader.set_back_ns / 1e9:.3f} s, and it "
                "overlaps with another bag; expected log times that increase"
            )
    copy.write(_merged(copy, group, is_first=is_first))


def _is_status(topic: str) -> bool:
    """Whether it is the topic on which vehicles report missions."""
    return topic.endswith("/mission")


def _head(reader: BagReader) -> Iterator[BagMessage]:
    """Latched messages at the head of a bag, with the log time of its first message."""
    return (message._replace(log_time_ns=reader.first_ns) for message in reader.held())


def _merged(copy: BagCopy, group: Sequence[BagReader], *, is_first: bool) -> Iterator[BagMessage]:
    """Messages of bags that overlap, sorted by log time, each as often as the bag that has it most often."""

    def stream(number: int, reader: BagReader) -> Iterator[tuple[int, bool, BagMessage]]:
        if number or not is_first:
            yield from ((number, True, message) for message in _head(reader))
        yield from ((number, False, message) for message in reader.messages())

    now_ns = -1  # log time of the messages that are compared
    written: Counter[BagMessage] = Counter()
    read: defaultdict[int, Counter[BagMessage]] = defaultdict(Counter)  # by bag
    streams = [stream(number, reader) for number, reader in enumerate(group)]
    # A head is compared with what was written before the bag's first message, also of others at that time.
    in_order = heapq.merge(*streams, key=lambda item: (item[2].log_time_ns, not item[1]))
    for number, is_repeated, message in in_order:
        if is_repeated:
            if not copy.holds(message):
                yield message
            continue
        if message.log_time_ns != now_ns:
            now_ns = message.log_time_ns
            written.clear()
            read.clear()
        read[number][message] += 1
        if read[number][message] > written[message]:
            written[message] += 1
            yield message
        else:
            copy.duplicates.add(message.topic)
