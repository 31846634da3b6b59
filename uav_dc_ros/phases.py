"""Which phase of a real vehicle's mission may follow which, and why.

The bridge enters no other phase, `bag verify` checks recorded missions against the same table, and the docs
draw it. A simulated vehicle knows `ready` and the ends only.
"""

from typing import NamedTuple

from uav_dc_ros.errors import PhaseError
from uav_dc_ros.messages import Phase

GROUND = (Phase.IDLE, Phase.CONNECTING, Phase.PREFLIGHT)
BEFORE_START = (*GROUND, Phase.TAKEOFF)
DECIDED = (Phase.READY, Phase.MOVING)  # by a policy
STEERED = (Phase.TAKEOFF, *DECIDED)  # by setpoints
FLYING = (*STEERED, Phase.LANDING)
RESTART = (Phase.IDLE, Phase.CONNECTING)  # where a bridge begins again that was killed, after any phase


class Transition(NamedTuple):
    """One phase that may follow another: `steps` more are flown then, 0 or 1."""

    before: Phase
    after: Phase
    steps: int
    why: str


_STOPPED = "the mission is stopped"
_TAKEN = "a pilot or a failsafe has the vehicle"
_FAULT = "a fault lasts, or the mission is stopped: return or land"
_DOCK = "the last step is flown"
TRANSITIONS = tuple(
    Transition(before, after, steps, why)
    for before, steps, following in (
        (
            Phase.IDLE,
            0,
            {
                Phase.CONNECTING: "the peers are ready, or a mission is taken up again",
                Phase.LANDING: f"{_STOPPED}, and the vehicle is armed",
                Phase.ABORTED: _STOPPED,
            },
        ),
        (
            Phase.CONNECTING,
            0,
            {
                Phase.PREFLIGHT: "telemetry has come",
                Phase.TAKEOFF: "the vehicle flies already",
                Phase.LANDING: "a mission that came down is taken up again, or must not go on",
                Phase.LANDED: "it had landed when the bridge came back",
                Phase.TIMEOUT: "it was out of steps when the bridge came back",
                Phase.ABORTED: f"{_STOPPED}, or {_TAKEN}",
            },
        ),
        (
            Phase.PREFLIGHT,
            0,
            {
                Phase.CONNECTING: "telemetry is lost",
                Phase.TAKEOFF: "armed, in the commanded mode",
                Phase.LANDING: "armed where the mission must not begin",
                Phase.ABORTED: f"{_STOPPED}, or {_TAKEN}",
            },
        ),
        (Phase.TAKEOFF, 0, {Phase.READY: "at the start", Phase.LANDING: _FAULT, Phase.ABORTED: _TAKEN}),
        (Phase.READY, 0, {Phase.MOVING: "a move came", Phase.LANDING: _FAULT, Phase.ABORTED: _TAKEN}),
        (Phase.MOVING, 0, {Phase.LANDING: _FAULT, Phase.ABORTED: _TAKEN}),
        (Phase.MOVING, 1, {Phase.READY: "at the cell", Phase.LANDING: _DOCK}),
        # A move that was begun when the bridge was killed is flown to its end.
        (Phase.TAKEOFF, 1, {Phase.READY: "at the cell of a move that was begun", Phase.LANDING: _DOCK}),
        (
            Phase.LANDING,
            0,
            {
                Phase.LANDED: "disarmed at the dock",
                Phase.TIMEOUT: "disarmed elsewhere, out of steps",
                Phase.ABORTED: "disarmed after a fault, or not heard of",
            },
        ),
    )
    for after, why in following.items()
)


def following(before: Phase, steps: int = 0, *, restarts: bool = False) -> tuple[Phase, ...]:
    """The phases that may follow one when some more steps are flown; `restarts`: also of another bridge."""
    found = tuple(one.after for one in TRANSITIONS if (one.before, one.steps) == (before, steps))
    return (*found, *RESTART) if restarts else found


def impossible(before: Phase, after: Phase, steps: int) -> PhaseError | None:
    """Why a phase cannot follow another one when some more steps are flown; None: it can."""
    possible = following(before, steps)
    if after in possible:
        return None
    expected = ", ".join(possible) or "none"
    return PhaseError(f"{after} after {before}, with {steps} more steps flown; expected {expected}")
