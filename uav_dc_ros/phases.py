"""Which phase of a real vehicle's mission may follow which, and why.

The bridge and `bag verify` check phases against it. A simulated vehicle uses `ready` and the ends only.
"""

from typing import NamedTuple

from uav_dc_ros.errors import PhaseError
from uav_dc_ros.messages import Phase

GROUND = (Phase.IDLE, Phase.CONNECTING, Phase.PREFLIGHT)
BEFORE_START = (*GROUND, Phase.TAKEOFF)
POLICY_CONTROLLED = (Phase.READY, Phase.MOVING)
OFFBOARD = (Phase.TAKEOFF, *POLICY_CONTROLLED)  # controlled by setpoints
FLYING = (*OFFBOARD, Phase.LANDING)
RESTART = (Phase.IDLE, Phase.CONNECTING)  # where a restarted bridge begins, after any phase


class PhaseTransition(NamedTuple):
    """A phase that may follow another when `steps` (0 or 1) more are flown."""

    before: Phase
    after: Phase
    steps: int
    reason: str


TRANSITIONS = (
    PhaseTransition(Phase.IDLE, Phase.CONNECTING, 0, "the peers are ready, or a restart"),
    PhaseTransition(Phase.IDLE, Phase.LANDING, 0, "stopped, and the vehicle is armed"),
    PhaseTransition(Phase.IDLE, Phase.ABORTED, 0, "the mission is stopped"),
    PhaseTransition(Phase.CONNECTING, Phase.PREFLIGHT, 0, "telemetry is received"),
    PhaseTransition(Phase.CONNECTING, Phase.TAKEOFF, 0, "the vehicle flies already"),
    PhaseTransition(Phase.CONNECTING, Phase.LANDING, 0, "it came down, or must not continue"),
    PhaseTransition(Phase.CONNECTING, Phase.LANDED, 0, "it had landed before a restart"),
    PhaseTransition(Phase.CONNECTING, Phase.TIMEOUT, 0, "it was out of steps before a restart"),
    PhaseTransition(Phase.CONNECTING, Phase.ABORTED, 0, "stopped, or taken by a pilot"),
    PhaseTransition(Phase.PREFLIGHT, Phase.CONNECTING, 0, "telemetry is lost"),
    PhaseTransition(Phase.PREFLIGHT, Phase.TAKEOFF, 0, "armed, in the commanded mode"),
    PhaseTransition(Phase.PREFLIGHT, Phase.LANDING, 0, "armed where the mission must not begin"),
    PhaseTransition(Phase.PREFLIGHT, Phase.ABORTED, 0, "stopped, or taken by a pilot"),
    PhaseTransition(Phase.TAKEOFF, Phase.READY, 0, "at the start"),
    PhaseTransition(Phase.TAKEOFF, Phase.LANDING, 0, "a fault lasts, or a stop"),
    PhaseTransition(Phase.TAKEOFF, Phase.ABORTED, 0, "taken by a pilot or a failsafe"),
    PhaseTransition(Phase.READY, Phase.MOVING, 0, "a move is received"),
    PhaseTransition(Phase.READY, Phase.LANDING, 0, "a fault lasts, or a stop"),
    PhaseTransition(Phase.READY, Phase.ABORTED, 0, "taken by a pilot or a failsafe"),
    PhaseTransition(Phase.MOVING, Phase.LANDING, 0, "a fault lasts, or a stop"),
    PhaseTransition(Phase.MOVING, Phase.ABORTED, 0, "taken by a pilot or a failsafe"),
    PhaseTransition(Phase.MOVING, Phase.READY, 1, "at the cell"),
    PhaseTransition(Phase.MOVING, Phase.LANDING, 1, "the last step is flown"),
    # A restarted bridge completes the move that was being flown.
    PhaseTransition(Phase.TAKEOFF, Phase.READY, 1, "at the cell"),
    PhaseTransition(Phase.TAKEOFF, Phase.LANDING, 1, "the last step is flown"),
    PhaseTransition(Phase.LANDING, Phase.LANDED, 0, "disarmed at the dock"),
    PhaseTransition(Phase.LANDING, Phase.TIMEOUT, 0, "disarmed elsewhere, out of steps"),
    PhaseTransition(Phase.LANDING, Phase.ABORTED, 0, "disarmed after a fault, or its link lost"),
)


def next_phases(before: Phase, steps: int = 0, *, restarts: bool = False) -> tuple[Phase, ...]:
    """The phases that may follow `before` when `steps` more are flown; `restarts`: or a bridge restarts."""
    found = tuple(one.after for one in TRANSITIONS if (one.before, one.steps) == (before, steps))
    return (*found, *RESTART) if restarts else found


def transition_error(before: Phase, after: Phase, steps: int) -> PhaseError | None:
    """The error of a phase that may not follow `before` when `steps` more are flown; None: it may."""
    allowed = next_phases(before, steps)
    if after in allowed:
        return None
    expected = ", ".join(allowed) or "none"
    return PhaseError(f"{after} after {before}, with {steps} more steps flown; expected {expected}")
