"""Payloads of the JSON topics: typed, and validated by each subscriber.

`msgs_json/` holds the same contract as JSON Schemas for other languages; `python -m uav_dc_ros.messages`
writes them, and a test compares the two.

Arrays with one entry per user are columns: entry `i` of each column is the same user. Numbers keep all
digits: a float64 is received as it was sent.
"""

import json
import secrets
from enum import StrEnum
from typing import Annotated, TypeAlias, TypeVar

import msgspec
from msgspec import UNSET, Meta, UnsetType
from msgspec.structs import force_setattr

from uav_dc_ros import files
from uav_dc_ros.core.grid import ActionLabel
from uav_dc_ros.errors import MessageError

MAX_BYTES = 64 * 2**20  # of one payload; a hundred thousand users take about 8 MiB
TEXT_MAX = 200  # characters of a reason or an error text
_HELD_PREFIX_0_1 = "holds: "  # version 0.1 has this prefix in `reason` in place of `held`

Index: TypeAlias = Annotated[int, Meta(ge=0, le=2**31 - 1)]
StampNs: TypeAlias = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Seed: TypeAlias = StampNs
NotNegative: TypeAlias = Annotated[float, Meta(ge=0)]
# In Python, `$` also matches before a final newline; in other languages `(?!\n)` changes nothing.
Name: TypeAlias = Annotated[str, Meta(pattern=r"^[a-z][a-z0-9_]{0,63}(?!\n)$")]

Run: TypeAlias = Annotated[
    str,
    Meta(
        pattern=r"^([0-9a-f]{16})?(?!\n)$",
        description="random identity of the run of missions, drawn when the vehicle starts; other nodes "
        "publish the one that they received in `mission`; empty in bags older than this field, and in "
        "`ready` before the node has received it",
    ),
]


class Phase(StrEnum):
    """The phase of a mission. A simulated vehicle uses `ready` and the ends only."""

    IDLE = "idle"  # not started
    CONNECTING = "connecting"  # waiting for the autopilot and its position
    PREFLIGHT = "preflight"  # on the ground, waiting for the mode and for arming
    TAKEOFF = "takeoff"  # flying to the start position
    READY = "ready"  # waiting for the move of this step
    MOVING = "moving"  # flying to a cell
    LANDING = "landing"  # descending
    LANDED = "landed"  # over, at the dock
    TIMEOUT = "timeout"  # over, out of steps or battery elsewhere
    ABORTED = "aborted"  # over, stopped early

    @property
    def is_over(self) -> bool:
        """Whether the mission has ended."""
        return self in (Phase.LANDED, Phase.TIMEOUT, Phase.ABORTED)


class FaultKind(StrEnum):
    """The kinds of fault that hold a vehicle."""

    LINK = "link"  # no heartbeat
    POSITION = "position"  # no position
    ESTIMATE = "estimate"  # the autopilot reports its position estimate as bad
    CLOCK = "clock"  # the vehicle's clock has stopped
    TARGET = "target"  # the autopilot reports a target other than the setpoint
    PROGRESS = "progress"  # no progress towards the cell
    POLICY = "policy"  # no policy node


class Payload(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Base of every payload: fields without a default are required, unknown ones are errors."""


class RunPayload(Payload, frozen=True, kw_only=True):
    """A payload of one run of missions. Equal seeds give payloads that are equal except for this field."""

    run: Run = ""


class _RunOnly(msgspec.Struct):
    """The run of a payload; other fields are ignored."""

    run: str = ""


class Stepped(RunPayload, frozen=True, kw_only=True):
    """A payload that belongs to one step of one mission."""

    mission: Annotated[Index, Meta(description="index of the mission in this run, from 0")]
    step: Annotated[Index, Meta(description="steps flown in this mission")]


class PerUser(Stepped, frozen=True, kw_only=True):
    """A payload whose lists are columns of equal lengths, with an entry per user."""

    def __post_init__(self) -> None:
        """Reject columns of different lengths."""
        values = msgspec.structs.astuple(self)
        if len({len(column) for column in values if type(column) is list}) > 1:
            columns = zip(self.__struct_fields__, values, strict=True)
            listed = ", ".join(f"{name} {len(column)}" for name, column in columns if type(column) is list)
            raise ValueError(f"columns of different length: {listed}")


class Users(PerUser, frozen=True, kw_only=True):
    """Positions of the users, frame `map` (ENU). Columns have equal lengths, an entry per user."""

    stamp_ns: Annotated[
        StampNs,
        Meta(description="ROS time of the positions; the pose of the step has this stamp or the next one"),
    ]
    cluster: Annotated[list[Index], Meta(description="index of the user's cluster")]
    x_m: Annotated[list[float], Meta(description="metres east")]
    y_m: Annotated[list[float], Meta(description="metres north")]
    shadowing_seed: Annotated[
        Seed | UnsetType,
        Meta(description="seed of the mission's shadowing; absent in a scenario without shadowing"),
    ] = UNSET
    link_seed: Annotated[
        Seed | UnsetType,
        Meta(
            description="seed of the line of sight and the fading of each user in this step; absent in a "
            "scenario whose channel draws neither"
        ),
    ] = UNSET


class Rates(PerUser, frozen=True, kw_only=True):
    """The channel during a step, and the data after it. Columns have equal lengths, an entry per user."""

    sum_rate_bps: Annotated[NotNegative, Meta(description="sum of the rates of the served users, bit/s")]
    sinr: Annotated[list[NotNegative], Meta(description="signal over interference and noise, linear")]
    rate_bps: Annotated[list[NotNegative], Meta(description="achievable rate, bit/s")]
    data_bits: Annotated[list[NotNegative], Meta(description="data collected in this mission, bit")]
    served: Annotated[list[bool], Meta(description="within range and not collected before this step")]
    collected: Annotated[list[bool], Meta(description="has sent enough data")]


class Mission(Stepped, frozen=True, kw_only=True):
    """State of the vehicle's mission: the step that it is ready for, or the outcome."""

    phase: Annotated[
        Phase,
        Meta(
            description="idle, connecting, preflight, takeoff: before the first step; ready: waiting for the "
            "move of this step; moving: flying it; landing: descending; landed: over, at the dock; "
            "timeout: over, out of steps or battery elsewhere; aborted: stopped early. A simulated vehicle "
            "is ready, or over"
        ),
    ]
    reason: Annotated[
        str, Meta(max_length=TEXT_MAX, description="reason for the phase or the fault; may be empty")
    ] = ""
    held: Annotated[
        bool, Meta(description="whether a fault holds the vehicle at its position; `reason` describes it")
    ] = False
    fault: Annotated[
        FaultKind | None,
        Meta(description="kind of the fault; null: none, or unknown, as in bags older than this field"),
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
    energy_used_j: Annotated[
        NotNegative | UnsetType,
        Meta(
            description="energy of the steps flown by the scenario's model, joules; absent in a scenario "
            "without a battery"
        ),
    ] = UNSET
    state_of_charge: Annotated[
        Annotated[float, Meta(ge=0, le=1)] | UnsetType,
        Meta(description="share of the battery that is left by the same model; absent likewise"),
    ] = UNSET
    seed: Annotated[Seed, Meta(description="seed of this mission's users")]
    scenario: Annotated[Name, Meta(description="name of the scenario")]
    fingerprint: Annotated[
        str,
        Meta(
            pattern=r"^[0-9a-f]{12}(?!\n)$",
            description="hash of the scenario's world: equal for equal worlds only",
        ),
    ]

    def __post_init__(self) -> None:
        """Set `held` in a payload of version 0.1; its reason stays as it was recorded."""
        if not self.held and self.reason.startswith(_HELD_PREFIX_0_1):
            force_setattr(self, "held", True)

    @property
    def state(self) -> str:
        """The phase, with `(held)` where a fault holds the vehicle."""
        return f"{self.phase} (held)" if self.held else str(self.phase)


class Move(Stepped, frozen=True, kw_only=True):
    """The policy's action for a step. The vehicle ignores a move for another step."""

    action: Annotated[
        ActionLabel,
        Meta(description="left is -x (west), right +x (east), forward +y (north), backward -y (south)"),
    ]
    search_timed_out: Annotated[
        bool | UnsetType,
        Meta(
            description="true: the search of this step ran out of time, and the action is the policy's own; "
            "absent otherwise"
        ),
    ] = UNSET


class Ready(RunPayload, frozen=True, kw_only=True):
    """A node is ready: it has found all its peers."""

    node: Annotated[Name, Meta(description="name of the node, as in the node table")]


# Payload of each JSON topic of topics.py.
PAYLOADS: dict[str, type[RunPayload]] = {
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


def read_run(text: bytes) -> str | None:
    """The run in a JSON text, whose other fields may be invalid; None: it is no payload."""
    if len(text) > MAX_BYTES:
        return None
    try:
        return msgspec.json.decode(text, type=_RunOnly).run
    except (msgspec.DecodeError, RecursionError, UnicodeError):
        return None


def encode(payload: Payload) -> bytes:
    """The payload as JSON, UTF-8. Only what the types cannot ensure is checked.

    Raises:
        MessageError: a number that is not finite, which JSON does not have.
    """
    text = msgspec.json.encode(payload)
    # A number that is not finite is `null`, as is a field that is None.
    n_none = msgspec.structs.astuple(payload).count(None)
    if text.count(b"null") != n_none:
        decode(text, type(payload))
    return text


def decode(text: str | bytes, kind: type[P]) -> P:
    """The payload in a JSON text.

    Raises:
        MessageError: with reason `oversized`, `malformed` (not JSON) or `invalid` (against the schema).
    """
    if len(text) > MAX_BYTES:
        raise MessageError("oversized", f"{len(text)} bytes; expected at most {MAX_BYTES}")
    try:
        return msgspec.json.decode(text, type=kind)
    except msgspec.ValidationError as error:
        raise MessageError("invalid", one_line(str(error))) from None
    except (msgspec.DecodeError, RecursionError, UnicodeError) as error:
        raise MessageError("malformed", one_line(str(error))) from None


def one_line(text: str) -> str:
    """A text from outside as at most `TEXT_MAX` characters in one line, without control characters."""
    line = printable(text[:TEXT_MAX])
    return line if len(line) < TEXT_MAX else f"{line[: TEXT_MAX - 3]}..."


def printable(text: str) -> str:
    """Text of a bag, or a file's name, as one line without control characters for a terminal."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def schema_text(kind: type[Payload]) -> str:
    """JSON Schema (2020-12) of a payload, as the text of its file in `msgs_json/`."""
    (body,), definitions = msgspec.json.schema_components([kind], ref_template="#/$defs/{name}")
    head = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
    return json.dumps({**head, **body, "$defs": definitions}, indent=2) + "\n"


if __name__ == "__main__":
    for topic, payload in PAYLOADS.items():
        path = files.shipped_folder("msgs_json") / f"{topic}.schema.json"
        files.write(path, schema_text(payload).encode())
