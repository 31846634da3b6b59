"""State machine of a mission: phases, steps and faults of one vehicle, from connecting to landing.

    idle -> connecting -> preflight -> takeoff -> ready <-> moving -> landing -> landed | timeout | aborted

`phases.TRANSITIONS` lists the permitted transitions. A fault holds the vehicle at its last setpoint; when the
fault timer expires, the bridge requests return or land, and the mission ends as `aborted`. After a takeover
(a pilot or a failsafe changes the mode) the bridge sends no setpoints and no commands; where the new mode is
return or land, it monitors the vehicle until it stands.
"""

from collections.abc import Callable
from typing import ClassVar

import msgspec

from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.messages import FaultKind, Phase
from uav_dc_ros.offboard.frames import Enu
from uav_dc_ros.offboard.mission.fault_detector import CrashDetector, FaultDetector, SafetySettings
from uav_dc_ros.offboard.mission.geofence import Geofence
from uav_dc_ros.offboard.mission.landing import LANDING_MODES, Decision, Landing
from uav_dc_ros.offboard.mission.preflight import Preflight, other_controller
from uav_dc_ros.offboard.mission.progress import Cell, Checkpoint, MissionProgress
from uav_dc_ros.offboard.mission.steps import StepControl
from uav_dc_ros.offboard.mission.timeouts_and_retries import CommandRetry, FaultTimer, Instant, PolicyTimeout
from uav_dc_ros.offboard.vehicle import Command, Mode, SetMode, Telemetry
from uav_dc_ros.phases import FLYING, GROUND, OFFBOARD, POLICY_CONTROLLED, transition_error

POLICY_LOST = "policy lost"


class MissionController:
    """Controls one mission of one vehicle; a `checkpoint` is that of a mission that is resumed."""

    # An impossible transition raises PhaseError (in tests); otherwise it ends the mission.
    is_strict: ClassVar[bool] = False

    def __init__(
        self,
        scenario: Scenario,
        settings: SafetySettings,
        on_change: Callable[[], None] = lambda: None,
        checkpoint: Checkpoint | None = None,
        fence: Geofence | None = None,  # None: the one around the scenario
    ) -> None:
        self.scenario, self.settings = scenario, settings
        self.fence = fence or Geofence.around(scenario)  # for setpoints and positions
        self.phase, self.reason = Phase.IDLE, "not started"
        self.progress = MissionProgress(scenario, checkpoint)
        self.setpoint: Enu | None = None  # to be streamed, in the grid's ENU frame, inside the fence
        self.policy_lost = False  # set by the caller while the policy is not alive: the vehicle stops
        self._on_change = on_change  # called after each change of phase, step, reason or checkpoint
        self._telemetry = Telemetry()
        self._now = self._entered = Instant(0.0, 0.0)  # last tick; start of the phase
        self._entered_step = self.step
        before = self.progress.checkpoint
        self._released = before.released  # another controller has the vehicle
        self._stop_reason = before.stop_reason  # of a stop after the step in progress; empty: none
        self._other_controller: str | None = None  # as reported
        home = Enu(*before.home) if before.home else None
        self.detector = FaultDetector(settings, before.at_rest_v, home)
        self._crash = CrashDetector(settings)
        self._steps = StepControl(self.progress, settings, self.fence)
        self._preflight = Preflight(self.progress, settings, self.fence, self.detector)
        self._landing = Landing(
            self.progress, self.detector, self.fence, settings.failsafe_action, Phase.ABORTED, ""
        )
        self._fault_timer = FaultTimer(settings.fault_timeout_s)
        self._policy = PolicyTimeout(settings, scenario.mission.step_s)
        self._retry = CommandRetry(settings)
        self._saved = self._to_save()

    @property
    def is_over(self) -> bool:
        """Whether the mission has ended."""
        return self.phase.is_over

    @property
    def step(self) -> int:
        """Steps flown."""
        return self.progress.step

    @property
    def cell(self) -> Cell:
        """Cell that the vehicle reached last."""
        return self.progress.cell

    @property
    def fault(self) -> str | None:
        """Fault that holds the vehicle, in words; None: none."""
        return self._fault_timer.fault.text if self._fault_timer.fault is not None else None

    @property
    def fault_kind(self) -> FaultKind | None:
        """Kind of the fault that holds the vehicle; None: none."""
        if self.phase not in OFFBOARD:
            return None
        if self._fault_timer.fault is not None:
            return self._fault_timer.fault.kind
        return FaultKind.POLICY if self._policy.lost_since is not None else None

    @property
    def warnings(self) -> list[str]:
        """Warnings that do not prevent the flight."""
        return self._preflight.warnings(self._telemetry)

    @property
    def checkpoint(self) -> Checkpoint:
        """Current state, for a bridge that is restarted."""
        saved = msgspec.structs.replace(
            self.progress.checkpoint,
            allowed_mode=self._preflight.allowed_mode,
            pilot_has_control=self._preflight.pilot_has_control,
            at_rest_v=self.detector.battery.at_rest_v,
            home=self.detector.home,
        )
        if self.phase in GROUND:
            return saved
        lands, landing = self.phase is Phase.LANDING or self.is_over, self._landing
        return msgspec.structs.replace(
            saved,
            step=self.step,
            cell=self.cell,
            goal=self.progress.goal if self._steps.resumes_move or self.phase is Phase.MOVING else None,
            steps_not_reached=self.progress.steps_not_reached,
            stop_reason=self._stop_reason,
            energy_used_j=float(self.progress.energy_used_j),
            airborne=True,
            released=self._released or (self.is_over and not self._telemetry.armed),
            outcome=(self.phase if self.is_over else landing.outcome) if lands else None,
            reason=self.reason if lands else "",
            landing_mode=landing.mode if lands else None,
            landing_requested=lands and landing.requests > 0,
            landing_confirmed=lands and landing.confirmed,
        )

    def _to_save(self) -> tuple[object, ...]:
        """Parts of the checkpoint that must be saved before a command is sent."""
        preflight, landing = self._preflight, self._landing
        return preflight.allowed_mode, preflight.pilot_has_control, landing.requests > 0, landing.confirmed

    def move(self, step: int, action: Action) -> str | None:
        """Begin the move of a step; returns why it is refused, or None."""
        if self.phase is not Phase.READY or self.fault is not None:
            return f"the vehicle is {self.phase.value} ({self.fault or self.reason}); expected it to be ready"
        if self._stop_reason:
            return f"the mission ends: {self._stop_reason}"
        if step != self.step:
            return f"a move for step {step}; expected {self.step}"
        cell = self.progress.neighbour(action)
        target = self.progress.centre(cell)
        if (breach := self.fence.breach(target)) is not None:
            return f"the target is outside the fence: {breach}"
        here = self._telemetry.position or self.progress.target
        if (breach := self.fence.path_breach(here, target)) is not None:
            return f"the way to the target is outside the fence: {breach}"
        self.progress.goal, self.setpoint = cell, target
        self._enter(Phase.MOVING, f"{action.label} to cell {cell}")
        return None

    def stop(self, reason: str, telemetry: Telemetry | None = None) -> None:
        """End the mission: a vehicle that flies lands; `telemetry` is needed before the first tick.

        So does one that is armed in the commanded mode before take-off. In another mode it is a pilot's, and
        where several vehicles are on the link, it may be another system's.
        """
        telemetry = telemetry or self._telemetry
        is_ours = telemetry.armed and telemetry.is_selected and telemetry.mode is Mode.COMMANDED
        if self.phase in OFFBOARD:
            self._abort(reason)
        elif self.phase in GROUND and is_ours and not self._released:
            self._telemetry = telemetry
            mode = self.detector.landing_mode(self._now.steady_s, telemetry)
            self._land(Mode.LAND if telemetry.on_ground else mode, Phase.ABORTED, reason)
        elif self.phase is not Phase.LANDING and not self.is_over:
            self._released = True  # nothing was requested
            self._end(Phase.ABORTED, reason)

    def stop_after_step(self, reason: str, telemetry: Telemetry | None = None) -> None:
        """End the mission as `stop` does, but first complete the move in progress."""
        if self.phase is not Phase.MOVING:
            self.stop(reason, telemetry)
        elif not self._stop_reason:
            self._stop_reason = reason
            self._on_change()

    def can_be_released(self, telemetry: Telemetry) -> bool:
        """Whether the mission ends without further commands."""
        return self.is_over or (self.phase is Phase.LANDING and self._landing.confirm(telemetry))

    def tick(self, now_s: float, telemetry: Telemetry) -> list[Command]:
        """Decide at a steady time; returns commands to be sent now."""
        if self.phase.is_over:
            return []
        self._telemetry = telemetry = self.detector.update(now_s, telemetry)
        self._now = Instant(telemetry.vehicle_s, now_s)
        self._retry.update(self._now, clock_stopped=self.detector.clock_stopped(now_s))
        self._steps.set_setpoint(self.setpoint, now_s)
        if self.phase is Phase.IDLE:
            self._enter(Phase.CONNECTING, "waiting for a heartbeat and a position")
        if self.phase in FLYING:
            if self._is_taken_over(telemetry):
                return []
            if self.phase is not Phase.LANDING:
                self._check_faults(now_s, telemetry)
        elif not self.progress.checkpoint.airborne:
            takeover = self._preflight.takeover(now_s, telemetry)
            if takeover is not None:
                self._released = True
                self._end(Phase.ABORTED, takeover)
                return []
        if self._stop_reason and self.phase is Phase.READY:
            self._abort(self._stop_reason)
        if self._fault_timer.fault is not None and self.phase in OFFBOARD:
            return []  # holds at the setpoint
        if self.phase in POLICY_CONTROLLED and not self._check_policy(telemetry):
            return []
        command = self._act(now_s, telemetry)
        commands = [command] if command is not None and self._retry.may_send(command) else []
        self._landing.requests += any(isinstance(command, SetMode) for command in commands)
        if self._to_save() != self._saved:
            self._saved = self._to_save()
            self._on_change()
        return commands

    # Faults.

    def _is_taken_over(self, telemetry: Telemetry) -> bool:
        """Detect a change of the mode or disarming by others; whether the mission has ended because of it."""
        lands = self.phase is Phase.LANDING
        if lands and not telemetry.armed:
            return False
        fault = self.fault or (self.reason if lands else None) or telemetry.refusal
        after = f" (after: {fault})" if fault else ""
        after += f" (autopilot: {telemetry.status_text})" if telemetry.status_text else ""
        allowed = self._landing.allows(telemetry.mode) if lands else telemetry.mode is Mode.COMMANDED
        self._released |= not allowed or not telemetry.armed
        if not telemetry.armed:
            event = f"disarmed by a pilot or by the autopilot itself in the phase {self.phase.value}"
            self._end(Phase.ABORTED, f"{event}{after}")
        elif not allowed:
            event = f"mode {telemetry.mode_text}: changed by a pilot or by the autopilot's failsafe"
            if not lands and telemetry.mode in LANDING_MODES:
                self._land(telemetry.mode, Phase.ABORTED, f"{event}{after}")
            else:
                self._end(Phase.ABORTED, f"{event}{after}")
        return self.phase.is_over

    def _check_faults(self, now_s: float, telemetry: Telemetry) -> None:
        """End the mission at once, or when the fault timer expires."""
        if (low := self.detector.battery.fault(telemetry)) is not None:
            self._abort(low)
            return
        if (other := other_controller(telemetry)) not in (None, self._other_controller):
            self._other_controller = other
            self._set_reason(f"{self.reason}; {other}")
        lost = self.detector.link_lost(now_s, telemetry)
        if not lost and (crash := self._crash.update(telemetry, self.setpoint)) is not None:
            self._abort(crash, Mode.LAND)
            return
        if telemetry.position is not None and (breach := self.fence.breach(telemetry.position)) is not None:
            self._abort(f"the vehicle is outside the fence: {breach}")
            return
        fault = self.detector.fault(now_s, telemetry)
        if fault is None and self.phase in POLICY_CONTROLLED:
            fault = self._steps.fault(telemetry, self.phase is Phase.MOVING and not self.policy_lost)
        match self._fault_timer.update(self._now, fault):
            case "changed":
                self._set_reason(str(self.fault))
            case "cleared" if self._policy.lost_since is not None:
                self._set_reason(POLICY_LOST)
            case "cleared":
                self._set_reason(f"resumed after: {self.reason}")
            case "expired" if (lasting := self._fault_timer.fault) is not None:
                since_s = self._fault_timer.since.steady_s
                self._abort(lasting.text, None, since_s if lasting.kind is FaultKind.POSITION else None)

    def _check_policy(self, telemetry: Telemetry) -> bool:
        """Stop the vehicle and its step's time while the policy is lost; whether the policy is alive."""
        since, now = self._policy.lost_since, self._now
        if self.policy_lost and since is None:
            self._policy.lost_since = now
            if self.phase is Phase.MOVING and telemetry.position is not None:
                self.setpoint = telemetry.position
            self._set_reason(POLICY_LOST)
        elif self.policy_lost and since is not None and self._policy.has_expired(since, now):
            self._abort(f"{POLICY_LOST} for {self._policy.limit_s:g} s")
        elif not self.policy_lost and since is not None:
            self._policy.lost_since = None
            entered_s = self._entered.vehicle_s + (now.vehicle_s - since.vehicle_s)
            self._entered = self._entered._replace(vehicle_s=entered_s)
            self._steps.resume()
            here = self._telemetry.position or self.progress.target
            if (breach := self.fence.path_breach(here, self.progress.target)) is not None:
                self._abort(f"the way to cell {self.progress.goal} is outside the fence: {breach}")
                return False
            self.setpoint = self.progress.target
            self._set_reason(f"resumed after: {self.reason}")
        return not self.policy_lost

    def _abort(self, reason: str, mode: Mode | None = None, blind_since_s: float | None = None) -> None:
        """Land, and end the mission as `aborted`; the reason names what preceded it first."""
        reason = "; ".join([*self._preceding(reason), reason])
        self._fault_timer.fault = None
        mode = mode or self.detector.landing_mode(self._now.steady_s, self._telemetry)
        self._land(mode, Phase.ABORTED, reason, blind_since_s)

    def _preceding(self, reason: str) -> list[str]:
        """What may be the cause of the end: another system's commands, the fault that held the vehicle."""
        cause, last = self._fault_timer.cause, self._fault_timer.fault
        if cause is None and self.phase in POLICY_CONTROLLED:
            # A vehicle that flies to another target may crash or leave the fence before that is a fault.
            cause = self._steps.target_fault(self._telemetry, self.settings.crash_timeout_s)
        elif cause is not None and last is not None and cause.kind is last.kind and last.text == reason:
            cause = None  # the fault itself ends the mission
        return [text for text in (self._other_controller, cause.text if cause else None) if text is not None]

    # Phases.

    def _act(self, now_s: float, telemetry: Telemetry) -> Command | None:
        """Decide by the current phase; returns a command, also one that was sent before."""
        takeoff_s, reason, setpoint = self.settings.takeoff_timeout_s, self.reason, self.setpoint
        match self.phase:
            case Phase.CONNECTING:
                waited_s = now_s - self._entered.steady_s
                return self._apply(self._preflight.connect(now_s, telemetry, waited_s))
            case Phase.PREFLIGHT:
                return self._apply(self._preflight.prepare(now_s, telemetry))
            case Phase.TAKEOFF if telemetry.vehicle_s - self._entered.vehicle_s > takeoff_s:
                self._abort(f"not at the start after {takeoff_s:g} s")
            case Phase.TAKEOFF:
                has_flown = self._crash.flies
                return self._apply(self._steps.take_off(telemetry, reason, setpoint, has_flown))
            case Phase.READY if self._policy.has_expired(self._entered, self._now):
                self._abort(f"no move from the policy for {self._policy.limit_s:g} s")
            case Phase.MOVING:
                return self._apply(self._steps.fly(telemetry, reason, setpoint, self._entered.vehicle_s))
            case Phase.LANDING:
                since_s = self._retry.waited_s(SetMode(Mode.RETURN))
                return self._apply(self._landing.update(now_s, telemetry, setpoint, since_s))
        return None

    def _apply(self, decision: Decision) -> Command | None:
        phase, self.setpoint = decision.phase, decision.setpoint
        if phase.is_over:
            lost = self.detector.link_lost(self._now.steady_s, self._telemetry)
            self._released |= self.phase in GROUND and not lost
            self._end(phase, decision.reason)
        elif phase is self.phase:
            self._set_reason(decision.reason)
        elif phase is Phase.LANDING:
            self._land(decision.landing_mode, decision.outcome, decision.reason)
            self._landing.requests += decision.landing_requested
        else:
            self._enter(phase, decision.reason)
        return decision.command

    # Transitions.

    def _land(self, mode: Mode, outcome: Phase, reason: str, blind_since_s: float | None = None) -> None:
        """Begin a landing; the setpoint is streamed until the vehicle changes its mode."""
        self._landing = Landing(
            self.progress, self.detector, self.fence, mode, outcome, reason, blind_since_s
        )
        self._landing.confirm(self._telemetry)  # it may land already
        self._enter(Phase.LANDING, reason)

    def _end(self, phase: Phase, reason: str) -> None:
        before, self.setpoint, self._fault_timer.fault = self.setpoint, None, None
        self._enter(phase, reason)
        if not self.is_over:  # an impossible transition
            self.setpoint = before

    def _enter(self, phase: Phase, reason: str) -> None:
        """Enter a phase; an impossible transition ends the mission, unless it lands or is over."""
        if (error := transition_error(self.phase, phase, self.step - self._entered_step)) is not None:
            if self.is_strict:
                raise error
            self._entered_step = self.step  # every phase may land or end then
            if self.phase in OFFBOARD:
                self._abort(f"an error of the bridge: {error}")
            elif self.phase in GROUND:
                self._end(Phase.ABORTED, f"an error of the bridge: {error}")
            return
        self.phase, self.reason = phase, reason
        self._entered, self._entered_step = self._now, self.step
        self._steps.reset()
        self._retry.reset()
        self._crash.begin(flies=phase in POLICY_CONTROLLED)
        self._policy.lost_since = None
        self._on_change()

    def _set_reason(self, reason: str) -> None:
        if reason != self.reason:
            self.reason = reason
            self._on_change()
