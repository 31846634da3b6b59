"""Counts of messages that cannot be decoded."""

from collections import Counter
from collections.abc import Iterator

from uav_dc_ros.errors import MessageError


class Unreadable(Counter[tuple[str, str]]):
    """Messages that cannot be decoded, by topic and `MessageError.reason`."""

    def __init__(self) -> None:
        super().__init__()
        self.first: dict[tuple[str, str], str] = {}  # text of the first error of each kind

    def add(self, topic: str, error: MessageError) -> None:
        """Count a message."""
        kind = topic, error.reason
        self[kind] += 1
        self.first.setdefault(kind, str(error))

    def lines(self) -> Iterator[str]:
        """A line for each kind: the count and the first error."""
        for (topic, reason), n in sorted(self.items()):
            yield f"{n:,} messages of {topic} cannot be read: {reason}: {self.first[topic, reason]}"
