"""Read a whole bag, of any recorder, as a stream: message by message, a few chunks at a time in memory.

Each part that our recorder writes repeats latched messages of earlier parts at its head, for who has no other
part: of the parts of one folder they are left out, except of the first one there.

A bag is a rosbag2 folder with MCAP or SQLite files, with or without metadata.yaml, or one such file. What a
killed recorder left is recovered first.
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
from types import TracebackType
from typing import Self

from uav_dc_ros.bags import receive_order
from uav_dc_ros.bags.mcap_storage import open_mcap
from uav_dc_ros.bags.sqlite_storage import open_sqlite
from uav_dc_ros.bags.storage import (
    SQLITE_MAGIC,
    BagMessage,
    RecordedTopic,
    Storage,
    reading,
    storage_files,
)

__all__ = ["BagMessage", "BagReader", "RecordedTopic"]


class BagReader:
    """A bag that is read; a context manager.

    Args:
        path: the bag's folder, or one of its files.
        torn: read files that lack their end, or are damaged, as far as they go. They are read once more,
            to know what they hold.

    Attributes:
        parts: its storage files, in their order.
        storages: what each of them holds.
        topics: by name.
        about: what our recorder wrote about it, text by key; empty for a bag of another one.
        dropped: messages by topic that were published, but lost before they were recorded; None: not counted.
        first_ns, last_ns: log times of its first and last message, nanoseconds since the epoch; 0 without.

    Raises:
        BagError: no bag; a part of it has no end, since its recorder was killed; it is damaged, or of a kind
            that cannot be read.
    """

    def __init__(self, path: Path, *, torn: bool = False) -> None:
        self.path = path
        self.topics: dict[str, RecordedTopic] = {}
        self.about: dict[str, str] = {}
        self.dropped: dict[str, int] | None = None
        self._closing = ExitStack()
        try:
            files = storage_files(path)
            self.storages = [self._open(part, torn, repeats=part is files[0]) for part in files]
        except BaseException:
            self._closing.close()
            raise
        self.parts = tuple(part.path for part in self.storages)
        for part in self.storages:
            self.about = part.about | self.about  # what was said first stays
            if part.dropped is not None:
                self.dropped = dict(Counter(self.dropped or {}) + Counter(part.dropped))
            for topic in part.topics:
                if topic.name in self.topics:
                    self.topics[topic.name].join(topic)
                else:
                    self.topics[topic.name] = replace(topic)
        with_messages = [part for part in self.storages if any(topic.count for topic in part.topics)]
        self.first_ns = min((part.first_ns for part in with_messages), default=0)
        self.last_ns = max((part.last_ns for part in with_messages), default=0)

    def __enter__(self) -> Self:
        """Read the bag in a `with` statement."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close its files."""
        self._closing.close()

    @property
    def message_count(self) -> int:
        """Messages of all topics."""
        return sum(topic.count for topic in self.topics.values())

    def messages(
        self,
        topics: Collection[str] | None = None,
        *,
        start_ns: int | None = None,
        end_ns: int | None = None,
    ) -> Iterator[BagMessage]:
        """Messages in the order of their log times; equal times as they lie in the bag.

        Args:
            topics: full names; all, unless told.
            start_ns: earliest log time.
            end_ns: log time before which all must lie.

        Raises:
            BagError: the bag is damaged there.
        """
        streams = [part.messages(topics, start_ns, end_ns) for part in self.storages]
        # Parts follow each other; only where their times overlap do they have to be merged.
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
        """By how much the clock was set back, at most, while the bag was recorded, nanoseconds; 0: never.

        Raises:
            BagError: the bag is damaged there.
        """
        goes_back_ns = max((part.goes_back_ns() for part in self.storages), default=0)
        if not self._is_side_by_side:
            for before, after in pairwise(part for part in self.storages if _names(part)):
                goes_back_ns = max(goes_back_ns, before.last_ns - after.first_ns)
        return receive_order.set_back_ns(self._recorded(None)) if goes_back_ns > receive_order.LEAST_NS else 0

    def received(self, topics: Collection[str]) -> Iterator[tuple[int, BagMessage]]:
        """Messages in the order of their receipt, each with how often the clock had been set back by then.

        That is the order of their log times, but for a clock that was set back: then it is that in which they
        were recorded, as far as they lie no further apart than `receipt.WAITING_BYTES`.

        Raises:
            BagError: the bag is damaged there.
        """
        if not self.set_back_ns:
            return ((0, message) for message in self.messages(topics))
        return receive_order.in_order(self._recorded(topics))

    def _recorded(self, topics: Collection[str] | None) -> Iterator[BagMessage]:
        """Messages in the order in which they were recorded."""
        streams = [part.recorded(topics) for part in self.storages]
        if self._is_side_by_side:
            return heapq.merge(*streams, key=attrgetter("log_time_ns"))
        return chain(*streams)

    @property
    def _is_side_by_side(self) -> bool:
        """Whether its files hold different topics, as those of several recorders, not one after the other."""
        names = [name for part in self.storages for name in _names(part)]
        return len(set(names)) == len(names)

    def _open(self, path: Path, torn: bool, *, repeats: bool) -> Storage:
        with reading(path), path.open("rb") as file:
            is_sqlite = file.read(len(SQLITE_MAGIC)) == SQLITE_MAGIC
        if is_sqlite:
            return open_sqlite(path, self._closing)
        return open_mcap(path, self._closing, torn=torn, repeats=repeats)


def _names(part: Storage) -> list[str]:
    """Topics with messages."""
    return [topic.name for topic in part.topics if topic.count]
