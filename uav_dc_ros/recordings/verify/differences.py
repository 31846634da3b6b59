"""Results of a verification: differences, and steps that cannot be recomputed."""

from collections import Counter
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import numpy as np

from uav_dc_ros.recordings.recorded_step import RecordedStep


class Difference(NamedTuple):
    """A recorded value that is not the recomputed one."""

    column: str
    text: str


def difference(
    step: RecordedStep, topic: str, column: str, recorded: Any, recomputed: Any, user: int | None = None
) -> Difference:
    """A difference in a step; `user`: index in a column with an entry per user."""
    flight = f"flight {step.flight}, " if step.flight else ""
    of_user = "" if user is None else f", user {user}"
    where = f"{topic}: {flight}mission {step.mission}, step {step.step}{of_user}, {column}"
    return Difference(column, f"{where}: recorded {recorded!r}, recomputed {recomputed!r}")


@dataclass(kw_only=True)
class Check:
    """One aspect of a bag, compared step by step.

    Attributes:
        tolerance: greatest relative difference of two equal numbers.
        compared: recomputed steps.
        differing: recomputed steps with a difference.
        skipped: steps that cannot be recomputed, by reason.
        first: the first difference.
        within: values that are equal only within the tolerance.
    """

    title: ClassVar[str]
    tolerance: float = 0.0
    compared: int = 0
    differing: int = 0
    skipped: Counter[str] = field(default_factory=Counter)
    first: Difference | None = None
    within: int = 0

    def skip(self, reason: str) -> None:
        """Count a step that cannot be recomputed."""
        self.skipped[reason] += 1

    def count(self, found: list[Difference]) -> None:
        """Count a recomputed step with its differences."""
        self.compared += 1
        self.differing += bool(found)
        if found and self.first is None:
            self.first = found[0]

    def compare(
        self, step: RecordedStep, topic: str, name: str, recorded: Any, recomputed: Any
    ) -> list[Difference]:
        """Compare a column with an entry per user, or one value; the first difference, if any."""
        ours, theirs = np.atleast_1d(recomputed), np.atleast_1d(recorded)
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
        i = int(wrong.argmax())
        user = i if np.ndim(recorded) > 0 else None
        return [difference(step, topic, name, theirs[i].item(), ours[i].item(), user)]

    def lines(self) -> list[str]:
        """The result as text."""
        total = self.compared + self.skipped.total()
        if not total:
            return [f"{self.title}: the bag holds no step to recompute"]
        summary = f"{self.title}: {self.compared} of {total} steps recomputed"
        if self.first:
            lines = [f"{summary}, {self.differing} differ; first:", f"  {self.first.text}"]
        else:
            lines = [f"{summary}, equal {'within the tolerance' if self.within else 'to the last bit'}"]
        if self.within:
            lines.append(f"  {self.within} values are equal within the tolerance only")
        return lines + [f"  {n} not recomputed: {reason}" for reason, n in self.skipped.most_common()]
