"""Keys of nested plain values, as errors name them: `users.cluster_centres_m[1]`."""

import re
from collections.abc import Iterator
from typing import Any


def path_of(text: str) -> tuple[str | int, ...]:
    """Names and indices of the key that an error begins with: `missing key ...`, `grid.n_x = ...`."""
    key = re.match(r"[\w.\[\]]*", re.sub("^missing (key|table) ", "", text))
    assert key is not None, "the pattern matches any text"
    return tuple(int(part) if part.isdecimal() else part for part in re.findall(r"\w+", key[0]))


def leaves(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Key and value of every leaf of nested dicts and lists; a list yields its length first."""
    if isinstance(value, dict):
        for name, entry in value.items():
            yield from leaves(entry, f"{key}.{name}" if key else name)
    elif isinstance(value, list | tuple):
        yield f"the number of {key}", len(value)
        for i, entry in enumerate(value):
            yield from leaves(entry, f"{key}[{i}]")
    else:
        yield key, value
