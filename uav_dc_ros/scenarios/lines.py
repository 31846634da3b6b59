"""Lines of the keys of a TOML file. Python's parser reports none.

A key stands on the first line with which the text so far, parsed by the same parser, has it. Arrays and texts
that a line leaves open are closed for that, so an element of an array has its own line, too.
"""

import tomllib
from collections.abc import Sequence
from typing import Any

CLOSINGS = ("", "]", "]]", "]]]", "]}", '"""', "'''")  # of what a line leaves open


class Lines:
    """Finds lines in the text of a TOML file, counted from 1, with a few parses each."""

    def __init__(self, text: str) -> None:
        self._lines = [f"{line}\n" for line in text.removeprefix("\ufeff").split("\n")]
        self._parsed: dict[int, Any] = {0: {}}

    def of(self, path: Sequence[str | int]) -> int | None:
        """The line of a key, or of the innermost table or array around it; None if there is none."""
        for length in range(len(path), 0, -1):
            if (line := self.exactly(path[:length])) is not None:
                return line
        return None

    def exactly(self, path: Sequence[str | int]) -> int | None:
        """The line of a key; None if there is none."""
        low, high = 0, len(self._lines)  # the key is not in the first `low` lines, but in the first `high`
        if not _has(self._values(high), path):
            return None
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (low, middle) if _has(self._values(middle), path) else (middle, high)
        return high

    def _values(self, n_lines: int) -> Any:
        """What the first lines hold; fewer lines, where no closing makes these a whole file."""
        if n_lines not in self._parsed:
            text = "".join(self._lines[:n_lines])
            for closing in CLOSINGS:
                try:
                    self._parsed[n_lines] = tomllib.loads(text + closing)
                    break
                except (ValueError, RecursionError):
                    continue
            else:
                return self._values(n_lines - 1)
        return self._parsed[n_lines]


def _has(values: Any, path: Sequence[str | int]) -> bool:
    for part in path:
        try:
            values = values[part]
        except (KeyError, IndexError, TypeError):
            return False
    return True
