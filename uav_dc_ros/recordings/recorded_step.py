"""One step of a recorded mission: what was said of it, by all who said something."""

from bisect import insort
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import msgspec

from uav_dc_ros import messages
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.messages import FaultKind, Mission, Phase
from uav_dc_ros.phases import BEFORE_START

POSES_KEPT = 64  # of a step
TOLD_KEPT = 1000  # words of a vehicle on a step: one that waits for hours tells of it again and again


class RecordedPose(NamedTuple):
    """A pose: its stamp, x, y, altitude in metres `[3]`, and when it was received and published (ns).

    `place` is that of its message among all that were received.
    """

    stamp_ns: int
    position_m: Array
    log_ns: int
    publish_ns: int
    place: int = 0


class Told(NamedTuple):
    """A phase that the vehicle told, why, whether a fault held it, and when that was received and published.

    Times are in ns. `clock` is how often the recorder's clock had been set back by then: only times of one
    clock compare.
    """

    phase: Phase
    reason: str
    held: bool
    fault: FaultKind | None
    log_ns: int
    publish_ns: int
    clock: int = 0


@dataclass(kw_only=True)
class RecordedStep:
    """One step of a mission; None for what the bag does not have.

    Attributes:
        flight: counts from 0, one up whenever the vehicle begins again: two runs in one bag.
        mission, step: index of the mission in its flight, steps flown.
        position_m: x, y, altitude of the first pose of the step's own time, metres, `[3]`.
        users, rates, status, move: the payloads; of repeated ones the first. A real vehicle says several
            times how a step stands; then `status` is what weighs most: the end of the mission, or that it was
            ready for a move, or else the newest.
        told: every phase and reason of the vehicle, in the order in which they were published: at most
            `TOLD_KEPT`.
        untold: how many more there were, in the middle.
        place: of its latest message among all that were received.
        clock: how often the recorder's clock had been set back when its users were received.
        log_ns: when each was received, nanoseconds since the epoch, by topic.
        publish_ns: when each was published, by topic.
        poses: the first poses of the step's own time, by stamp: at most `POSES_KEPT`.
        others: by topic the first payload that was said again for this step, and differently. Of users, one
            of another time only stands back behind others.
    """

    flight: int
    mission: int
    step: int
    position_m: Array | None = None
    users: messages.Users | None = None
    rates: messages.Rates | None = None
    status: messages.Mission | None = None
    move: messages.Move | None = None
    told: list[Told] = field(default_factory=list)
    untold: int = 0
    place: int = 0
    clock: int = 0
    log_ns: dict[str, int] = field(default_factory=dict)
    publish_ns: dict[str, int] = field(default_factory=dict)
    poses: list[RecordedPose] = field(default_factory=list)
    others: dict[str, messages.Stepped] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The step in words."""
        flight = f" of flight {self.flight}" if self.flight else ""
        return f"mission {self.mission}, step {self.step}{flight}"

    @property
    def is_measured(self) -> bool:
        """Are users and rates to be expected: has the vehicle come to where the step begins.

        Before it took off nobody measures, nor where a bridge that was killed takes a mission up.
        """
        if not self.told or any(told.phase is Phase.READY for told in self.told):
            return True
        return self.step > 0 and self.told[0].phase not in BEFORE_START

    @property
    def phases(self) -> Iterator[Told]:
        """Each phase as it was entered: reasons that changed within one are left out."""
        before: Phase | None = None
        for told in self.told:
            if told.phase is not before:
                yield told
            before = told.phase

    def tell(self, payload: Mission, log_ns: int, publish_ns: int, clock: int = 0) -> bool:
        """Note what the vehicle says of this step; tells whether it was something new.

        A vehicle that says why it is in a phase may be in it twice. One that gives no reasons repeats itself.
        """
        said = payload.phase, payload.reason, payload.held, payload.fault
        for told in self.told:
            again = publish_ns == told.publish_ns or not payload.reason or told is self.told[-1]
            if again and said == told[:4]:
                return False
        told = Told(*said, log_ns, publish_ns, clock)
        insort(self.told, told, key=lambda one: (one.clock, one.publish_ns))
        if len(self.told) > TOLD_KEPT:  # how it began, and how it ended, tells most
            del self.told[TOLD_KEPT // 2]
            self.untold += 1
        return True


def printable(text: str) -> str:
    """A reason, or a file's name, as a line of UTF-8 that no terminal obeys: bags are told by anybody."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def with_standing_of(one: Mission, other: Mission) -> Mission:
    """A word on a step with all that may change while the step lasts as in another one."""
    changing = ("phase", "reason", "held", "fault", "steps_not_reached")
    return msgspec.structs.replace(one, **{name: getattr(other, name) for name in changing})


def is_same_status(one: Mission, other: Mission) -> bool:
    """Whether two words on a step differ in nothing but what may change while it lasts."""
    return with_standing_of(one, other) == other


def is_later_only(one: messages.Stepped, other: messages.Stepped) -> bool:
    """Whether they are the same users at another time: a vehicle was ready for the same step again."""
    if not isinstance(one, messages.Users) or not isinstance(other, messages.Users):
        return False
    return msgspec.structs.replace(one, stamp_ns=other.stamp_ns) == other


def outweighs(now: Mission, before: Mission, newer: bool) -> bool:
    """Whether a word on a step takes the place of another one: `newer` tells whether it was said later.

    Of several ends the last one holds; it was ready as of the first time.
    """
    weights = _weight(now), _weight(before)
    return weights[0] > weights[1] or (newer and weights in ((0, 0), (2, 2)))


def _weight(status: Mission) -> int:
    return 2 if status.phase.is_over else int(status.phase is Phase.READY)
