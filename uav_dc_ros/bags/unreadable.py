"""Messages that are there, and cannot be decoded: how many, of which topics, and what was wrong with them."""

from collections import Counter
from collections.abc import Iterator

from uav_dc_ros.errors import MessageError


class Unreadable(Counter[tuple[str, str]]):
    """Counts them by topic and reason, see `MessageError.reason`."""

    def __init__(self) -> None:
        super().__init__()
        self._first: dict[tuple[str, str], str] = {}

    def enter(self, topic: str, error: MessageError) -> None:
        """One more."""
        kind = topic, error.reason
        self[kind] += 1
        self._first.setdefault(kind, str(error))

    def why(self, topic: str, reason: str) -> str:
        """What was wrong with the first one of a kind."""
        return self._first[topic, reason]

    def lines(self) -> Iterator[str]:
        """How many of each kind there are and what was wrong with the first, in words."""
        for (topic, reason), n in sorted(self.items()):
            yield f"{n:,} messages of {topic} cannot be read: {reason}: {self._first[topic, reason]}"
