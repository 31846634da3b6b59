"""Payloads of the JSON topics: typed, checked by whoever reads them, never trusted.

`msgs_json/` holds the same contract as JSON Schemas for other languages; a test holds the two equal,
and `python -m uav_dc_ros.messages` writes them anew.

Arrays with one entry per user are columns: entry `i` of each column is the same user. Numbers travel
with all their digits, so a float64 arrives as it was sent.
"""

import json
import secrets
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, TypeAlias, TypeVar

import msgspec
from msgspec import Meta
from msgspec.structs import force_setattr

from uav_dc_ros import files
from uav_dc_ros.core.grid import ActionLabel
from uav_dc_ros.errors import MessageError

MAX_BYTES = 64 * 2**20  # of one payload; a hundred thousand users take about 8 MiB
TOLD_MAX = 200  # characters of what is told about a bad one
HELD_BEFORE_0_2 = "holds: "  # how the reason began, in version 0.1, where now `held` is true

Index: TypeAlias = Annotated[int, Meta(ge=0, le=2**31 - 1)]
StampNs: TypeAlias = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Seed: TypeAlias = StampNs
NotNegative: TypeAlias = Annotated[float, Meta(ge=0)]
# In Python, `$` also stands before a newline at the end; in other languages `(?!\n)` changes nothing.
Name: TypeAlias = Annotated[str, Meta(pattern=r"^[a-z][a-z0-9_]{0,63}(?!\n)$")]

Run: TypeAlias = Annotated[
    str,
    Meta(
        pattern=r"^([0-9a-f]{16})?(?!\n)$",
        description="identity of the run of missions that this belongs to, drawn at random when the vehicle "
        "starts; a node publishes the one that it received in `mission`; empty in bags that are older than "
        "it, and in `ready` while the node has not received it yet",
    ),
]


class Phase(StrEnum):
    """Where a mission stands. A simulated vehicle knows `ready` and the ends only."""

    IDLE = "idle"  # nothing has begun
    CONNECTING = "connecting"  # waiting for the autopilot, and for its position
    PREFLIGHT = "preflight"  # on the ground, until mode and motors are as they must be
    TAKEOFF = "takeoff"  # on its way to where the mission starts
    READY = "ready"  # waiting for the move of this step
    MOVING = "moving"  # on its way to a cell
    LANDING = "landing"  # on its way down
    LANDED = "landed"  # over, at the dock
    TIMEOUT = "timeout"  # over, out of steps somewhere else
    ABORTED = "aborted"  # over, stopped before its end

    @property
    def is_over(self) -> bool:
        """Has this mission no further step."""
        return self in (Phase.LANDED, Phase.TIMEOUT, Phase.ABORTED)


class FaultKind(StrEnum):
    """What keeps a vehicle from going on."""

    LINK = "link"  # no heartbeat
    POSITION = "position"  # no position
    ESTIMATE = "estimate"  # the autopilot does not trust its own position
    CLOCK = "clock"  # the vehicle's time stands still
    TARGET = "target"  # the autopilot reports another target than the setpoint
    PROGRESS = "progress"  # it comes no nearer to its cell
    POLICY = "policy"  # nobody is there who decides


class Payload(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What every payload has in common: no field missing unless it has a default, none unknown."""


class OfRun(Payload, frozen=True, kw_only=True):
    """A payload that belongs to one run of missions. Equal seeds give equal payloads but for this field."""

    run: Run = ""


class _AnyOfRun(msgspec.Struct):
    """The run alone, of a payload whose other fields nobody looks at."""

    run: str = ""


class Stepped(OfRun, frozen=True, kw_only=True):
    """A payload that belongs to one step of one mission."""

    mission: Annotated[Index, Meta(description="index of the mission in this run, from 0")]
    step: Annotated[Index, Meta(description="steps flown in this mission")]


class Users(Stepped, frozen=True, kw_only=True):
    """Positions of the users, frame `map` (ENU). Columns are of one length, an entry per user."""

    stamp_ns: Annotated[
        StampNs,
        Meta(description="time of the positions, ROS time; their pose has this stamp or the next one"),
    ]
    cluster: Annotated[list[Index], Meta(description="index of the user's cluster")]
    x_m: Annotated[list[float], Meta(description="metres east")]
    y_m: Annotated[list[float], Meta(description="metres north")]

    def __post_init__(self) -> None:
        """Refuse columns of different length."""
        _same_length(cluster=self.cluster, x_m=self.x_m, y_m=self.y_m)


class Rates(Stepped, frozen=True, kw_only=True):
    """The channel during a step, and the data up to its end. Columns are of one length, an entry per user."""

    sum_rate_bps: Annotated[NotNegative, Meta(description="sum of the rates of the served users, bit/s")]
    sinr: Annotated[list[NotNegative], Meta(description="signal over interference and noise, linear")]
    rate_bps: Annotated[list[NotNegative], Meta(description="achievable rate, bit/s")]
    data_bits: Annotated[list[NotNegative], Meta(description="data collected in this mission, bit")]
    served: Annotated[list[bool], Meta(description="within range and not collected before this step")]
    collected: Annotated[list[bool], Meta(description="has given enough data")]

    def __post_init__(self) -> None:
        """Refuse columns of different length."""
        _same_length(
            sinr=self.sinr,
            rate_bps=self.rate_bps,
            data_bits=self.data_bits,
            served=self.served,
            collected=self.collected,
        )


class Mission(Stepped, frozen=True, kw_only=True):
    """What the vehicle says of its mission: which step it is ready for, or how it ended."""

    phase: Annotated[
        Phase,
        Meta(
            description="idle, connecting, preflight, takeoff: before the first step; ready: waiting for the "
            "move of this step; moving: flying it; landing: on its way down; landed: over, at the dock; "
            "timeout: over, out of steps elsewhere; aborted: stopped before its end. A simulated vehicle is "
            "ready, or over"
        ),
    ]
    reason: Annotated[
        str, Meta(max_length=TOLD_MAX, description="why it is in this phase, or does not go on; may be empty")
    ] = ""
    held: Annotated[
        bool, Meta(description="the vehicle stays where it is, because of a fault; `reason` tells which")
    ] = False
    fault: Annotated[
        FaultKind | None,
        Meta(description="kind of the fault; null: none, or not known, as in bags that are older than it"),
    ] = None
    cell: Annotated[
        tuple[Index, Index, Index],
        Meta(description="the cell that the UAV reached last: indices east, north, up"),
    ]
    remaining_steps: Annotated[Index, Meta(description="steps that the battery still allows")]
    steps_not_reached: Annotated[
        Index,
        Meta(description="flown steps whose cell was not reached within the tolerance; 0 in simulation"),
    ] = 0
    seed: Annotated[Seed, Meta(description="seed of this mission's users")]
    scenario: Annotated[Name, Meta(description="name of the scenario")]
    fingerprint: Annotated[
        str,
        Meta(
            pattern=r"^[0-9a-f]{12}(?!\n)$",
            description="of the scenario's world: equal for equal worlds only",
        ),
    ]

    def __post_init__(self) -> None:
        """Understand a vehicle of version 0.1. Its reason stays as it was recorded."""
        if not self.held and self.reason.startswith(HELD_BEFORE_0_2):
            force_setattr(self, "held", True)

    @property
    def state(self) -> str:
        """The phase in words, and whether the vehicle is held in it."""
        return f"{self.phase} (held)" if self.held else str(self.phase)


class Move(Stepped, frozen=True, kw_only=True):
    """The policy's decision for a step. A move for another step is ignored."""

    action: Annotated[
        ActionLabel,
        Meta(description="left is -x (west), right +x (east), forward +y (north), backward -y (south)"),
    ]


class Ready(OfRun, frozen=True, kw_only=True):
    """A node has found all its peers and can take part."""

    node: Annotated[Name, Meta(description="name of the node, as in the node table")]


# Payload of each JSON topic. The topics themselves are in topics.py.
PAYLOADS: dict[str, type[OfRun]] = {
    "users": Users,
    "rates": Rates,
    "mission": Mission,
    "move": Move,
    "ready": Ready,
}

P = TypeVar("P", bound=Payload)


def new_run() -> str:
    """A random identity for a run of missions."""
    return secrets.token_hex(8)


def run_of(text: bytes) -> str | None:
    """The run that a JSON text says it belongs to, whatever else it holds; None: it is no payload."""
    if len(text) > MAX_BYTES:
        return None
    try:
        return msgspec.json.decode(text, type=_AnyOfRun).run
    except (msgspec.DecodeError, RecursionError, UnicodeError):
        return None


def encode(payload: Payload) -> bytes:
    """The payload as JSON, UTF-8.

    What the types do not promise is that a number is one: JSON has no NaN and no infinity, and they must not
    leave the node. Everything else is the reader's to check, who would not trust this check anyway.

    Raises:
        MessageError: a number that is not finite.
    """
    text = msgspec.json.encode(payload)
    if b"null" in text:  # how a number that is none is written; a mission without a fault has it, too
        decode(text, type(payload))
    return text


def decode(text: str | bytes, kind: type[P]) -> P:
    """The payload in a JSON text.

    Raises:
        MessageError: with reason `oversized`, `malformed` (not JSON) or `invalid` (not the schema's).
    """
    if len(text) > MAX_BYTES:
        raise MessageError("oversized", f"{len(text)} bytes; expected at most {MAX_BYTES}")
    try:
        return msgspec.json.decode(text, type=kind)
    except msgspec.ValidationError as error:
        raise MessageError("invalid", told(str(error))) from None
    except (msgspec.DecodeError, RecursionError, UnicodeError) as error:
        raise MessageError("malformed", told(str(error))) from None


def schema(kind: type[Payload]) -> dict[str, Any]:
    """JSON Schema (2020-12) of a payload."""
    (body,), definitions = msgspec.json.schema_components([kind], ref_template="#/$defs/{name}")
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **body, "$defs": definitions}


def schema_text(kind: type[Payload]) -> str:
    """The schema as it stands in `msgs_json/`."""
    return json.dumps(schema(kind), indent=2) + "\n"


def write_schemas(folder: Path) -> None:
    """Write the schema of every JSON topic."""
    for topic, kind in PAYLOADS.items():
        files.write(folder / f"{topic}.schema.json", schema_text(kind).encode())


def told(text: str) -> str:
    """A text as it may be told, though it quotes what came from outside: a line, nothing a terminal obeys."""
    line = "".join(c if c.isprintable() else repr(c)[1:-1] for c in text[:TOLD_MAX])
    return line if len(line) < TOLD_MAX else f"{line[: TOLD_MAX - 3]}..."


def _same_length(**columns: list[Any]) -> None:
    lengths = {name: len(column) for name, column in columns.items()}
    if len(set(lengths.values())) > 1:
        told = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise ValueError(f"columns of different length: {told}")


if __name__ == "__main__":
    write_schemas(files.shipped_folder("msgs_json"))
