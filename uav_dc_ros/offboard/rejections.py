"""Commands that a vehicle rejected, and its status texts, which hold the reasons."""

from collections import deque
from collections.abc import Collection

WARNING = 4  # MAV_SEVERITY; a lower number is more severe
REASON_S = 2.0  # a text within this time before or after a rejection is its reason
MAX_TEXTS = 64


class Rejections:
    """Rejected commands and warnings of one vehicle; all times are of the steady clock, seconds."""

    def __init__(self) -> None:
        self._texts: deque[tuple[float, str]] = deque(maxlen=MAX_TEXTS)
        self._rejected: dict[str, tuple[float, str]] = {}  # by command: time and result

    def on_status_text(self, severity: int, text: str, now_s: float) -> None:
        """Keep a text of MAV_SEVERITY `WARNING` or worse."""
        if severity <= WARNING:
            self._texts.append((now_s, text.strip()))

    def reject(self, command: str, result: str, now_s: float) -> None:
        """Record that a command was rejected."""
        self._rejected[command] = now_s, result

    def accept(self, command: str) -> None:
        """Drop the rejection of a command that was accepted."""
        self._rejected.pop(command, None)

    def texts(self, from_s: float, to_s: float) -> list[str]:
        """Distinct warnings between two times."""
        return list(dict.fromkeys(text for text_s, text in self._texts if from_s <= text_s <= to_s))

    def recent_texts(self, now_s: float) -> str:
        """Warnings of the last `REASON_S`, joined; empty: none."""
        return "; ".join(self.texts(now_s - REASON_S, now_s))

    def latest(self, executed: Collection[str] = ()) -> str | None:
        """The newest rejection with its reason, such as `arming refused: PreArm: ...`.

        Commands that were `executed` do not count: a repeated one is rejected, and its acknowledgement may be
        late.
        """
        rejected = {command: kept for command, kept in self._rejected.items() if command not in executed}
        if not rejected:
            return None
        command, (at_s, result) = max(rejected.items(), key=lambda item: item[1][0])
        return f"{command} refused: {'; '.join(self.texts(at_s - REASON_S, at_s + REASON_S)) or result}"
