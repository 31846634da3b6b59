"""Have what was written reach the disk, without making the writer wait for it."""

import os
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor


class DiskSync:
    """Calls `fsync` in a thread of its own, one at a time.

    While one is under way, others are left out: a slow disk is asked as often as it can answer.
    """

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="fsync")
        self._last: Future[None] | None = None

    @property
    def is_free(self) -> bool:
        """Whether none is under way."""
        return self._last is None or self._last.done()

    def begin(self, descriptors: Sequence[int]) -> None:
        """Sync files and folders, and close their descriptors. Only while it is free.

        Raises:
            OSError: the sync before this one failed, so the disk is gone, or full after all.
        """
        self.wait()
        self._last = self._thread.submit(_sync, descriptors)

    def wait(self) -> None:
        """Wait for the one that is under way.

        Raises:
            OSError: it failed.
        """
        last, self._last = self._last, None
        if last is not None:
            last.result()

    def close(self) -> None:
        """Let the thread go."""
        self._thread.shutdown()


def _sync(descriptors: Sequence[int]) -> None:
    try:
        for descriptor in descriptors:
            os.fsync(descriptor)
    finally:
        for descriptor in descriptors:
            os.close(descriptor)
