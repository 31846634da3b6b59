"""Read a whole bag, of any recorder, as a stream, with a few chunks at a time in memory.

A bag is a rosbag2 folder with MCAP or SQLite files, with or without metadata.yaml, or one such file. A bag of
a killed recorder must be recovered first.

Each part of this package's recorder repeats latched messages of earlier parts at its head: they are left out,
except in the first part of a folder and in a single file.
"""

import heapq
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import ExitStack
from dataclasses import replace
from functools import cached_property
from itertools import chain, pairwise
from operator import attrgetter
from pathlib import Path
from typing import Self

from rosbags.rosbag2.metadata import dump_qos_v9

from uav_dc_ros.bags import receive_order
from uav_dc_ros.bags.mcap_storage import open_mcap
from uav_dc_ros.bags.metadata import is_latched, offered_qos
from uav_dc_ros.bags.sqlite_storage import open_sqlite
from uav_dc_ros.bags.storage import (
    SQLITE_MAGIC,
    BagMessage,
    RecordedTopic,
    Storage,
    merge_topic,
    read_errors,
    storage_files,
)

__all__ = ["BagMessage", "BagReader", "RecordedTopic"]


class BagReader:
    """Reads a bag; a context manager.

    Args:
        path: the bag's folder, or one of its files.
        torn: read files without their end, or damaged ones, as far as possible. They are scanned once before
            their messages are read.
        repeats: keep the latched messages at the head of the first file that repeat earlier ones, as those of
            a bag that was cut; without, `held` has them.

    Raises:
        BagError: no bag; a part without its end, since its recorder was killed; a damaged one, or one of an
            unsupported kind.
    """

    def __init__(self, path: Path, *, torn: bool = False, repeats: bool = True) -> None:
        self.path = path
        self.topics: dict[str, RecordedTopic] = {}  # by name
        self.about: dict[str, str] = {}  # description by this package's recorder, text by key; else empty
        # Published messages by topic that the recorder lost; None: not counted.
        self.dropped: dict[str, int] | None = None
        with ExitStack() as self._closing:
            files = storage_files(path)
            opened = [self._open(part, torn, repeats=repeats and part is files[0]) for part in files]
            self._closing = self._closing.pop_all()
        self.storages: list[Storage] = opened  # contents of each part
        self.parts: tuple[Path, ...] = tuple(part.path for part in opened)  # storage files, in their order
        for part in self.storages:
            self.about = part.about | self.about  # the first value stays
            if part.dropped is not None:
                self.dropped = dict(Counter(self.dropped or {}) + Counter(part.dropped))
            for topic in part.topics:
                merge_topic(self.topics, replace(topic))
        with_messages = [part for part in self.storages if _topics_with_messages(part)]
        # Log time of the first message, nanoseconds since the epoch; 0 without messages.
        self.first_ns: int = min((part.first_ns for part in with_messages), default=0)
        self.last_ns: int = max((part.last_ns for part in with_messages), default=0)  # of the last one

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.close()

    @property
    def message_count(self) -> int:
        """Messages of all topics."""
        return sum(topic.count for topic in self.topics.values())

    def messages(
        self, topics: Collection[str] | None = None, *, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[BagMessage]:
        """Messages sorted by log time; those of equal times are in the order of the bag.

        Args:
            topics: full names; None: all.
            start_ns: earliest log time.
            end_ns: end of the log times (excluded).

        Raises:
            BagError: the bag is damaged there.
        """
        streams = [part.messages(topics, start_ns, end_ns) for part in self.storages]
        # Only parts whose times overlap are merged.
        while streams:
            together = 1
            end = self.storages[-len(streams)].last_ns
            while together < len(streams) and self.storages[together - len(streams)].first_ns <= end:
                end = max(end, self.storages[together - len(streams)].last_ns)
                together += 1
            yield from heapq.merge(*streams[:together], key=attrgetter("log_time_ns"))
            del streams[:together]

    @cached_property
    def set_back_ns(self) -> int:
        """By how much the recorder's clock was set back at most, nanoseconds; 0: never.

        Raises:
            BagError: the bag is damaged somewhere.
        """
        goes_back_ns = max((part.goes_back_ns() for part in self.storages), default=0)
        if not self._is_side_by_side:
            for before, after in pairwise(part for part in self.storages if _topics_with_messages(part)):
                goes_back_ns = max(goes_back_ns, before.last_ns - after.first_ns)
        if goes_back_ns <= receive_order.MIN_SET_BACK_NS:
            return 0
        return receive_order.set_back_ns(self.recorded())

    def received(self, topics: Collection[str]) -> Iterator[tuple[int, BagMessage]]:
        """Messages in the order of receipt, each with how often the clock had been set back before it.

        It is the order of log times, unless the clock was set back: then it is the order of recording, as far
        as messages are no further apart than `receive_order.WAITING_BYTES`.

        Raises:
            BagError: the bag is damaged there.
        """
        if not self.set_back_ns:
            return ((0, message) for message in self.messages(topics))
        return receive_order.in_order(self.recorded(topics))

    def recorded(
        self, topics: Collection[str] | None = None, *, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[BagMessage]:
        """As `messages`, in the order of recording."""
        streams = [part.recorded(topics, start_ns, end_ns) for part in self.storages]
        if self._is_side_by_side:
            return heapq.merge(*streams, key=attrgetter("log_time_ns"))
        return chain(*streams)

    def held(self, before_ns: int | None = None) -> Iterator[BagMessage]:
        """The messages of latched topics that held at a log time, by topic and in order.

        Of each topic as many as its publishers offered different QoS. None: those at the head of the first
        file that repeat earlier ones, if they are left out.

        Raises:
            BagError: the bag is damaged there, or a topic's QoS is not in rosbag2's format.
        """
        head = self.storages[0].head() if self.storages else []
        if before_ns is None:
            yield from head
            return
        for topic in self.topics.values():
            offered = offered_qos(topic.name, topic.offered_qos)
            if not is_latched({"offered_qos_profiles": dump_qos_v9(offered)}):
                continue
            repeated = [message for message in head if message.topic == topic.name]
            n = max(len(offered), len(repeated))
            found: list[BagMessage] = []
            for part in reversed(self.storages):
                found = part.latest(topic.name, n - len(found), before_ns) + found
                if len(found) == n:
                    break
            yield from (repeated + found)[-n:]

    @property
    def _is_side_by_side(self) -> bool:
        """Whether the files have different topics, as those of simultaneous recorders."""
        names = [name for part in self.storages for name in _topics_with_messages(part)]
        return len(set(names)) == len(names)

    def _open(self, path: Path, torn: bool, *, repeats: bool) -> Storage:
        with read_errors(path), path.open("rb") as file:
            is_sqlite = file.read(len(SQLITE_MAGIC)) == SQLITE_MAGIC
        if is_sqlite:
            return open_sqlite(path, self._closing)
        return open_mcap(path, self._closing, torn=torn, repeats=repeats)


def _topics_with_messages(part: Storage) -> list[str]:
    return [topic.name for topic in part.topics if topic.count]
