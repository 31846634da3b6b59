"""What a recomputation found: values that are not those recorded, and steps that could not be recomputed."""

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from uav_dc_ros.recordings.recorded_step import RecordedStep


@dataclass(frozen=True, kw_only=True)
class Difference:
    """Where a recorded value is not the recomputed one: `user` where it is one of many."""

    topic: str
    flight: int
    mission: int
    step: int
    column: str
    user: int | None = None
    recorded: Any
    recomputed: Any

    def __str__(self) -> str:
        """One line."""
        flight = f"flight {self.flight}, " if self.flight else ""
        user = "" if self.user is None else f", user {self.user}"
        return (
            f"{self.topic}: {flight}mission {self.mission}, step {self.step}{user}, {self.column}: "
            f"recorded {self.recorded!r}, recomputed {self.recomputed!r}"
        )


@dataclass(kw_only=True)
class Book:
    """What was compared on one matter.

    Attributes:
        tolerance: greatest relative difference of two numbers that counts as none.
        compared: steps that could be recomputed.
        differing: of these, steps with a difference.
        skipped: steps that could not, by reason.
        first: the first difference.
        within: values that were equal within the tolerance only.
    """

    tolerance: float = 0.0
    compared: int = 0
    differing: int = 0
    skipped: Counter[str] = field(default_factory=Counter)
    first: Difference | None = None
    within: int = 0

    def skip(self, reason: str) -> None:
        """Count a step that cannot be recomputed."""
        self.skipped[reason] += 1

    def enter(self, found: list[Difference]) -> None:
        """Count a step that was recomputed, with its differences."""
        self.compared += 1
        self.differing += bool(found)
        if found and self.first is None:
            self.first = found[0]

    def column(self, step: RecordedStep, topic: str, name: str, recorded: Any, made: Any) -> list[Difference]:
        """Compare an entry per user, or one value; the first difference, if any."""
        ours, theirs = np.atleast_1d(made), np.atleast_1d(recorded)
        if ours.shape != theirs.shape:
            return [difference(step, topic, f"length of {name}", theirs.shape[0], ours.shape[0])]
        floats = ours.dtype == np.float64
        wrong = ours.view(np.uint64) != theirs.view(np.uint64) if floats else ours != theirs
        if floats and self.tolerance and wrong.any():
            near = np.abs(ours - theirs) <= self.tolerance * np.abs(ours)
            self.within += int((wrong & near).sum())
            wrong &= ~near
        if not wrong.any():
            return []
        user = int(wrong.argmax())
        many = np.ndim(recorded) > 0
        return [difference(step, topic, name, theirs[user].item(), ours[user].item(), user if many else None)]


def difference(
    step: RecordedStep, topic: str, column: str, recorded: Any, recomputed: Any, user: int | None = None
) -> Difference:
    """A difference in a step."""
    return Difference(
        topic=topic,
        flight=step.flight,
        mission=step.mission,
        step=step.step,
        column=column,
        user=user,
        recorded=recorded,
        recomputed=recomputed,
    )
