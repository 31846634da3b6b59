"""Read a bag's messages ahead of who plays them, in a thread: a few megabytes, whatever the bag's size.

A chunk of a bag is read, checked, decompressed and sorted as a whole. Whoever did so between two messages
would be late with the second one.
"""

import contextlib
import queue
import threading
import time
from collections.abc import Collection, Iterator
from pathlib import Path
from types import TracebackType
from typing import Self

from uav_dc_ros.bags.read import BagMessage, BagReader

BATCH = 256  # messages that are handed over at once
BATCH_BYTES = 2**20
BATCHES = 16  # read ahead
FILL_S = 0.5  # to read that much at the start, at most
LOOK_S = 0.1  # how soon the thread sees that nobody wants more


class ReadAhead:
    """Iterates once over messages of a bag, as `BagReader.messages` has them; a context manager.

    Args:
        path: of the bag.
        topics: full names.
        start_ns: earliest log time.
        end_ns: log time before which all must lie; None: to the end.
    """

    def __init__(self, path: Path, topics: Collection[str], *, start_ns: int, end_ns: int | None) -> None:
        self._path = path
        self._wanted = (topics, start_ns, end_ns)
        self._batches: queue.Queue[list[BagMessage] | Exception | None] = queue.Queue(BATCHES)
        self._closed = False
        self._thread = threading.Thread(target=self._read, daemon=True)

    def __enter__(self) -> Self:
        """Start to read; the first messages lie ready, so that reading does not compete with playing them."""
        self._thread.start()
        deadline_s = time.monotonic() + FILL_S
        while self._thread.is_alive() and not self._batches.full() and time.monotonic() < deadline_s:
            time.sleep(0.002)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop reading."""
        self._closed = True
        self._thread.join()

    def __iter__(self) -> Iterator[BagMessage]:
        """Hand the messages out.

        Raises:
            BagError: the bag is damaged there.
        """
        while (batch := self._batches.get()) is not None:
            if isinstance(batch, Exception):
                raise batch
            yield from batch

    def _read(self) -> None:
        topics, start_ns, end_ns = self._wanted
        last: Exception | None = None
        try:
            # A reader of its own: SQLite's may be used only in the thread that made it.
            with BagReader(self._path) as reader:
                batch: list[BagMessage] = []
                batch_bytes = 0
                for message in reader.messages(topics, start_ns=start_ns, end_ns=end_ns):
                    batch.append(message)
                    batch_bytes += len(message.data)
                    if len(batch) >= BATCH or batch_bytes >= BATCH_BYTES:
                        self._hand_over(batch)
                        batch, batch_bytes = [], 0
                    if self._closed:
                        return
                self._hand_over(batch)
        except Exception as error:  # whoever iterates is to see it
            last = error
        self._hand_over(last)

    def _hand_over(self, batch: list[BagMessage] | Exception | None) -> None:
        while not self._closed:
            with contextlib.suppress(queue.Full):
                self._batches.put(batch, timeout=LOOK_S)
                return
