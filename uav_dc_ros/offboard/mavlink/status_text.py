"""The bridge's STATUSTEXT messages: chunks of MAVLink 2, and a limit of their rate."""

from collections import deque
from typing import NamedTuple

from uav_dc_ros.offboard.ground_station import StatusText

CHUNK_BYTES = 50  # of a STATUSTEXT
TEXT_BYTES = 4 * CHUNK_BYTES - 1  # four chunks: one that is full to the end would need a fifth
MESSAGES_MAX, WITHIN_S = 6, 1.0  # in any such time, steady clock; the last text of a flood adds at most four
WAITING_MAX = 16  # texts, while there is no link
IDS = 65535


class Chunk(NamedTuple):
    """Fields of one STATUSTEXT."""

    severity: int
    text: bytes
    id: int  # 0: the text has one chunk
    chunk_seq: int


def split(text: str) -> list[bytes]:
    """The chunks of a text, in ASCII. The last one of several is not full, which marks the end."""
    data = text.encode("ascii", "replace")[:TEXT_BYTES]
    if len(data) <= CHUNK_BYTES:
        return [data]
    return [data[i : i + CHUNK_BYTES] for i in range(0, len(data) + 1, CHUNK_BYTES)]


class StatusTextQueue:
    """Texts to send. Of those that exceed the rate, the newest of the most severe waits, and the others go.

    So a hundred texts in a second give at most ten messages. A text that follows omitted ones begins with
    their number: `(+90)`.
    """

    def __init__(self) -> None:
        self._waiting: list[StatusText] = []
        self._omitted = 0  # texts, since the last one was sent
        self._sent_s: deque[float] = deque(maxlen=MESSAGES_MAX)
        self._id = 0

    def add(self, text: StatusText) -> None:
        """Add a text."""
        self._waiting.append(text)
        if len(self._waiting) > WAITING_MAX:
            self._omit()

    def due(self, now_s: float) -> list[Chunk]:
        """The messages to send at a steady time; they count as sent."""
        room = MESSAGES_MAX - sum(now_s - at_s < WITHIN_S for at_s in self._sent_s)
        texts = self._chunks()
        if sum(map(len, texts)) > room:
            self._omit()
            texts = self._chunks()
        if not texts or sum(map(len, texts)) > room:
            return []
        self._waiting, self._omitted = [], 0
        chunks = [chunk for text in texts for chunk in text]
        self._sent_s.extend([now_s] * len(chunks))
        return chunks

    def _omit(self) -> None:
        """Keep one of the waiting texts."""
        self._omitted += len(self._waiting) - 1
        self._waiting = [min(reversed(self._waiting), key=lambda text: text.severity)]

    def _chunks(self) -> list[list[Chunk]]:
        """The chunks of each waiting text."""
        texts: list[list[Chunk]] = []
        for waiting in self._waiting:
            omitted = f"(+{self._omitted}) " if self._omitted and not texts else ""
            parts = split(f"{omitted}{waiting.text}")
            number = 0
            if len(parts) > 1:
                number = self._id = self._id % IDS + 1
            texts.append([Chunk(int(waiting.severity), part, number, i) for i, part in enumerate(parts)])
        return texts
