"""Read a bag's messages ahead in a thread, with a few megabytes of memory whatever the bag's size.

A chunk is read, checked, decompressed and sorted as a whole; between two messages of a replay, that would
delay the second one.
"""

import contextlib
import queue
import threading
import time
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Self

from uav_dc_ros.bags.read import BagMessage, BagReader

BATCH = 256  # messages in a queue item
BATCH_BYTES = 2**20
BATCHES = 16  # in the queue
FILL_S = 0.5  # longest time to fill the queue at the start
STOP_CHECK_S = 0.1  # interval in which a blocked thread checks whether it must stop


class ReadAhead:
    """Iterates once over `BagReader.messages`, which a thread reads ahead; a context manager."""

    def __init__(self, path: Path, topics: Collection[str], *, start_ns: int, end_ns: int | None) -> None:
        self._path = path
        self._topics, self._start_ns, self._end_ns = topics, start_ns, end_ns
        self._batches: queue.Queue[list[BagMessage] | Exception | None] = queue.Queue(BATCHES)
        self._closed = False
        self._thread = threading.Thread(target=self._read, daemon=True)

    def __enter__(self) -> Self:
        """Start to read, and fill the queue, so that reading does not compete with the replay."""
        self._thread.start()
        deadline_s = time.monotonic() + FILL_S
        while self._thread.is_alive() and not self._batches.full() and time.monotonic() < deadline_s:
            time.sleep(0.002)
        return self

    def __exit__(self, *_: object) -> None:
        self._closed = True
        self._thread.join()

    def __iter__(self) -> Iterator[BagMessage]:
        while (batch := self._batches.get()) is not None:
            if isinstance(batch, Exception):
                raise batch
            yield from batch

    def _read(self) -> None:
        end: Exception | None = None
        try:
            # A reader of its own: only the thread that opened a SQLite file may read it.
            with BagReader(self._path) as reader:
                batch: list[BagMessage] = []
                batch_bytes = 0
                for message in reader.messages(self._topics, start_ns=self._start_ns, end_ns=self._end_ns):
                    batch.append(message)
                    batch_bytes += len(message.data)
                    if len(batch) >= BATCH or batch_bytes >= BATCH_BYTES:
                        self._put(batch)
                        batch, batch_bytes = [], 0
                    if self._closed:
                        return
                self._put(batch)
        except Exception as error:  # raised where the messages are read
            end = error
        self._put(end)

    def _put(self, item: list[BagMessage] | Exception | None) -> None:
        while not self._closed:
            with contextlib.suppress(queue.Full):
                self._batches.put(item, timeout=STOP_CHECK_S)
                return
