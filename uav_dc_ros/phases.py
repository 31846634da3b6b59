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


TRANSITIONS = (
    Transition(Phase.IDLE, Phase.CONNECTING, 0, "the peers are ready, or a restart"),
    Transition(Phase.IDLE, Phase.LANDING, 0, "stopped, and the vehicle is armed"),
    Transition(Phase.IDLE, Phase.ABORTED, 0, "the mission is stopped"),
    Transition(Phase.CONNECTING, Phase.PREFLIGHT, 0, "telemetry has come"),
    Transition(Phase.CONNECTING, Phase.TAKEOFF, 0, "the vehicle flies already"),
    Transition(Phase.CONNECTING, Phase.LANDING, 0, "it came down, or must not go on"),
    Transition(Phase.CONNECTING, Phase.LANDED, 0, "it had landed before a restart"),
    Transition(Phase.CONNECTING, Phase.TIMEOUT, 0, "it was out of steps before a restart"),
    Transition(Phase.CONNECTING, Phase.ABORTED, 0, "stopped, or taken by a pilot"),
    Transition(Phase.PREFLIGHT, Phase.CONNECTING, 0, "telemetry is lost"),
    Transition(Phase.PREFLIGHT, Phase.TAKEOFF, 0, "armed, in the commanded mode"),
    Transition(Phase.PREFLIGHT, Phase.LANDING, 0, "armed where the mission must not begin"),
    Transition(Phase.PREFLIGHT, Phase.ABORTED, 0, "stopped, or taken by a pilot"),
    Transition(Phase.TAKEOFF, Phase.READY, 0, "at the start"),
    Transition(Phase.TAKEOFF, Phase.LANDING, 0, "a fault lasts, or a stop"),
    Transition(Phase.TAKEOFF, Phase.ABORTED, 0, "taken by a pilot or a failsafe"),
    Transition(Phase.READY, Phase.MOVING, 0, "a move came"),
    Transition(Phase.READY, Phase.LANDING, 0, "a fault lasts, or a stop"),
    Transition(Phase.READY, Phase.ABORTED, 0, "taken by a pilot or a failsafe"),
    Transition(Phase.MOVING, Phase.LANDING, 0, "a fault lasts, or a stop"),
    Transition(Phase.MOVING, Phase.ABORTED, 0, "taken by a pilot or a failsafe"),
    Transition(Phase.MOVING, Phase.READY, 1, "at the cell"),
    Transition(Phase.MOVING, Phase.LANDING, 1, "the last step is flown"),
    # A move that was begun when the bridge was killed is flown to its end.
    Transition(Phase.TAKEOFF, Phase.READY, 1, "at the cell"),
    Transition(Phase.TAKEOFF, Phase.LANDING, 1, "the last step is flown"),
    Transition(Phase.LANDING, Phase.LANDED, 0, "disarmed at the dock"),
    Transition(Phase.LANDING, Phase.TIMEOUT, 0, "disarmed elsewhere, out of steps"),
    Transition(Phase.LANDING, Phase.ABORTED, 0, "disarmed after a fault, or not heard of"),
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
