"""The vehicle between policy and autopilot, from connecting to landing: phases, steps, faults.

    idle -> connecting -> preflight -> takeoff -> ready <-> moving -> landing -> landed | timeout | aborted

It enters no phase that may not follow by the table `phases.TRANSITIONS`.
It decides, and does nothing itself: `tick` is called often with what is known of the vehicle, and returns
commands for the transport; `setpoint` is what the transport streams. Whatever goes wrong leads to *hold* (the
last good setpoint stays), then to *return* or *land*, and at last to `aborted` with its reason. A pilot who
changes the mode has the vehicle at once: from then on there are no setpoints and no commands. Where that mode
brings it down (an autopilot's failsafe does that, too), it is watched until it stands.
"""

from collections.abc import Callable
from typing import ClassVar

import msgspec

from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import PhaseError
from uav_dc_ros.messages import FaultKind, Phase
from uav_dc_ros.offboard.frames import Enu
from uav_dc_ros.offboard.mission.command_retry import CommandRetry
from uav_dc_ros.offboard.mission.crash_detector import CrashDetector
from uav_dc_ros.offboard.mission.fault_detector import FaultDetector, SafetySettings
from uav_dc_ros.offboard.mission.fault_timer import FaultTimer
from uav_dc_ros.offboard.mission.geofence import Geofence
from uav_dc_ros.offboard.mission.landing import DOWN, Landing, Next
from uav_dc_ros.offboard.mission.policy_timeout import PolicyTimeout
from uav_dc_ros.offboard.mission.preflight import Preflight, rival
from uav_dc_ros.offboard.mission.progress import Cell, Checkpoint, Dwell, MissionProgress
from uav_dc_ros.offboard.mission.stall_detector import StallDetector
from uav_dc_ros.offboard.vehicle import Command, Mode, SetMode, TakeOff, Telemetry
from uav_dc_ros.phases import FLYING, GROUND, OFFBOARD, POLICY_CONTROLLED, transition_error

POLICY_IS_GONE = "the policy is gone"


class MissionController:
    """One mission of one vehicle.

    Args:
        scenario: the world that is flown.
        settings: how carefully.
        on_change: called after each change of phase, step or reason, or of what is to be kept.
        standing: of a mission that is taken up again.
        fence: around targets and poses; None: the one around the scenario.

    Attributes:
        phase: where the mission stands.
        reason: why it is in this phase, in words.
        course: steps flown, the cell reached last, and the cell that it flies to.
        setpoint: where the vehicle is sent to, in the grid's ENU frame; None: nowhere. Always in the fence.
        policy_is_gone: to be set while nobody is there who would decide the next move: the vehicle stops.
        is_strict: raise PhaseError where a phase cannot follow (in tests); otherwise give up the mission.
    """

    is_strict: ClassVar[bool] = False

    def __init__(
        self,
        scenario: Scenario,
        settings: SafetySettings,
        on_change: Callable[[], None] = lambda: None,
        standing: Checkpoint | None = None,
        fence: Geofence | None = None,
    ) -> None:
        self.scenario, self.settings = scenario, settings
        self.fence = fence or Geofence.around(scenario)
        self.phase, self.reason = Phase.IDLE, "not started"
        self.course = MissionProgress(scenario, standing)
        self.setpoint: Enu | None = None
        self.policy_is_gone = False
        self._entered_step = self.step  # when the phase was entered
        self._on_change = on_change
        self._asked = CommandRetry(settings)
        self._since_s = 0.0  # vehicle time of the last change of phase
        self._dwell = Dwell(settings)
        self._patience = PolicyTimeout(settings, scenario.mission.step_s)
        self._now_s = 0.0  # vehicle time
        self._steady_s = self._since_steady_s = 0.0  # steady clock: last tick, last change of phase
        self._known = Telemetry()
        home = self.course.standing.home
        self._watched = FaultDetector(settings, self.course.standing.at_rest_v, Enu(*home) if home else None)
        self._descent = Landing(self.course, self._watched, settings.failsafe_action, Phase.ABORTED, "")
        self._hold = FaultTimer(settings.fault_timeout_s)
        self._crash = CrashDetector(settings)
        self._tracking = StallDetector(self.course, settings)
        self._finishes = self.course.standing.goal is not None  # the move that an earlier bridge had begun
        self._reported: str | None = None  # another system that commands the vehicle in flight
        self._taken = self.course.standing.released  # somebody else has the vehicle
        self._ground = Preflight(self.course, settings, self.fence, self._watched)
        self._kept = self._to_keep()

    @property
    def is_over(self) -> bool:
        """Is there nothing left to do."""
        return self.phase.is_over

    @property
    def step(self) -> int:
        """Steps flown."""
        return self.course.step

    @property
    def cell(self) -> Cell:
        """The cell that the vehicle reached last."""
        return self.course.cell

    @property
    def fault(self) -> str | None:
        """What keeps it from going on at the moment; None: nothing."""
        return self._hold.fault.why if self._hold.fault is not None else None

    @property
    def fault_kind(self) -> FaultKind | None:
        """The kind of the fault that holds the vehicle; None: nothing holds it."""
        if self.phase not in OFFBOARD:
            return None
        if self._hold.fault is not None:
            return self._hold.fault.kind
        return FaultKind.POLICY if self._patience.gone_since is not None else None

    @property
    def discarded(self) -> dict[str, int]:
        """Telemetry that could not be true and was left out, by reason; `Telemetry.discarded` has others."""
        return self._watched.discarded

    @property
    def warnings(self) -> list[str]:
        """What a user should know of the vehicle, though it is no reason not to fly."""
        return self._ground.warnings(self._known)

    @property
    def standing(self) -> Checkpoint:
        """Where the mission stands now."""
        kept = msgspec.structs.replace(
            self.course.standing,
            allowed_mode=self._ground.allowed_mode,
            is_a_pilots=self._ground.is_a_pilots,
            at_rest_v=self._watched.battery.at_rest_v,
            home=self._watched.home,
        )
        if self.phase in GROUND:
            return kept
        over = self.phase is Phase.LANDING or self.is_over
        return msgspec.structs.replace(
            kept,
            step=self.step,
            cell=self.cell,
            goal=self.course.goal if self._finishes or self.phase is Phase.MOVING else None,
            steps_not_reached=self.course.steps_not_reached,
            flies=True,
            released=self._taken or (self.is_over and not self._known.armed),
            outcome=(self.phase if self.is_over else self._descent.outcome) if over else None,
            reason=self.reason if over else "",
            down=self._descent.how if over else None,
            asked=over and self._descent.tries > 0,
            obeyed=over and self._descent.obeyed,
        )

    def move(self, step: int, action: Action) -> str | None:
        """Fly a move; or why not. A move for another step, or at another time, changes nothing."""
        if self.phase is not Phase.READY or self.fault is not None:
            return f"the vehicle is {self.phase.value} ({self.fault or self.reason}); expected it to be ready"
        if step != self.step:
            return f"a move for step {step}; expected {self.step}"
        cell = self.course.beyond(action)
        target = self.course.centre(cell)
        if (breach := self.fence.breach(target)) is not None:
            return f"the target is outside the fence: {breach}"
        self.course.goal, self.setpoint = cell, target
        self._enter(Phase.MOVING, f"{action.label} to cell {cell}")
        return None

    def stop(self, why: str, known: Telemetry | None = None) -> None:
        """End the mission, since nobody will set_setpoint any more; a vehicle that flies comes down.

        So does one that is armed in the commanded mode before it begins; in another mode it is a pilot's.

        Args:
            why: in words.
            known: of the vehicle, if no tick has told of it yet.
        """
        known = known or self._known
        if self.phase in OFFBOARD:
            self._give_up(why)
        elif self.phase in GROUND and self._is_to_come_down(known):
            self._known = known
            how = Mode.LAND if known.on_ground else self._watched.way_down(self._steady_s, known)
            self._descend(how, Phase.ABORTED, why)
        elif self.phase is not Phase.LANDING and not self.is_over:
            self._taken = True  # nothing was requested, and nothing will be
            self._end(Phase.ABORTED, why)

    def _is_to_come_down(self, known: Telemetry) -> bool:
        """Is a vehicle before its mission one that nobody would have then. Of several it may be anybody's."""
        return known.armed and known.is_selected and known.mode is Mode.COMMANDED and not self._taken

    def is_done_with(self, known: Telemetry) -> bool:
        """Does the vehicle come to its end without any further word."""
        return self.is_over or (self.phase is Phase.LANDING and self._descent.obeys(known))

    def tick(self, now_s: float, known: Telemetry) -> list[Command]:
        """Go on.

        Args:
            now_s: the steady clock that telemetry's times are of.
            known: of the vehicle.

        Returns:
            Commands to be passed on now, at most one of each kind.
        """
        if self.phase.is_over:
            return []
        self._known = known = self._watched.see(now_s, known)
        self._now_s, self._steady_s = known.vehicle_s, now_s
        self._asked.pass_time(known.vehicle_s, now_s, stands=self._watched.clock_stands(now_s))
        self._tracking.send(self.setpoint, now_s)
        if self.phase is Phase.IDLE:
            self._enter(Phase.CONNECTING, "waiting for a heartbeat and a position")
        if self.phase in FLYING:
            if self._taken_over(known):
                return []
            self._watch(now_s, known)
        elif not self.course.standing.flies and (why := self._ground.takeover(now_s, known)) is not None:
            self._taken = True
            self._end(Phase.ABORTED, why)
            return []
        if self._hold.fault is not None and self.phase in OFFBOARD:
            return []  # hold: the setpoint stays
        if self.phase in POLICY_CONTROLLED and not self._policy_lives(known):
            return []
        commands = {
            Phase.CONNECTING: self._connect,
            Phase.PREFLIGHT: self._prepare,
            Phase.TAKEOFF: self._take_off,
            Phase.READY: self._wait,
            Phase.MOVING: self._fly,
            Phase.LANDING: self._land,
        }[self.phase](now_s, known)
        sent = [command for command in commands if self._asked.may(command)]
        self._descent.tries += sum(isinstance(command, SetMode) for command in sent)
        if self._to_keep() != self._kept:
            self._kept = self._to_keep()
            self._on_change()
        return sent

    def _to_keep(self) -> tuple[object, ...]:
        """What a bridge that is started anew has to know before it is requested, or as soon as it is seen."""
        ground, descent = self._ground, self._descent
        return ground.allowed_mode, ground.is_a_pilots, descent.tries > 0, descent.obeyed

    # What goes wrong.

    def _taken_over(self, known: Telemetry) -> bool:
        """Has somebody else the vehicle now, who changed its mode or disarmed it."""
        landing = self.phase is Phase.LANDING
        if landing and not known.armed:
            return False  # it stands
        why = self.fault or (self.reason if landing else None) or known.refusal
        after = "".join(
            f" ({word}: {what})" for word, what in (("after", why), ("it says", known.status_text)) if what
        )
        moved = known.mode is not Mode.COMMANDED if not landing else not self._descent.is_ours(known.mode)
        self._taken |= moved or not known.armed
        if not known.armed:
            who = "disarmed by a pilot or by the autopilot itself"
            self._end(Phase.ABORTED, f"{who} while it was {self.phase.value}{after}")
        elif moved:
            mode = known.mode_name or known.mode.value
            changed = f"mode {mode}: changed by a pilot or by the autopilot's failsafe{after}"
            if not landing and known.mode in DOWN:
                self._descend(known.mode, Phase.ABORTED, changed)
            else:
                self._end(Phase.ABORTED, changed)
        return self.phase.is_over

    def _watch(self, now_s: float, known: Telemetry) -> None:
        """Find what keeps the vehicle from going on; what lasts too long ends the mission."""
        if self.phase is Phase.LANDING:
            return
        if (low := self._watched.battery_is_low(known)) is not None:
            self._give_up(low)
            return
        if (other := rival(known)) not in (None, self._reported):
            self._reported = other
            self._change(f"{self.reason}; {other}")
        lost = self._watched.link_is_lost(now_s, known)
        if not lost and (crash := self._crash.look(known, self.setpoint)) is not None:
            self._give_up(crash, Mode.LAND)
            return
        if known.position is not None and (breach := self.fence.breach(known.position)) is not None:
            self._give_up(f"the vehicle is outside the fence: {breach}")
            return
        fault = self._watched.fault(now_s, known)
        if fault is None and self.phase in POLICY_CONTROLLED:
            fault = self._tracking.fault(known, self.phase is Phase.MOVING and not self.policy_is_gone)
        match self._hold.look(now_s, known, fault):
            case "begins" | "turns":
                self._change(str(self.fault))
            case "passes" if self._patience.gone_since is not None:
                self._change(POLICY_IS_GONE)
            case "passes":
                self._change(f"goes on after: {self.reason}")
            case "ends" if (lasting := self._hold.fault) is not None:
                blind_since_s = self._hold.since_s[0] if lasting.kind is FaultKind.POSITION else None
                self._give_up(lasting.why, None, blind_since_s)

    def _policy_lives(self, known: Telemetry) -> bool:
        """Is there somebody who decides; until there is, the vehicle stops, and the step's time with it."""
        since, now = self._patience.gone_since, (self._now_s, self._steady_s)
        if self.policy_is_gone and since is None:
            self._patience.gone_since = now
            if self.phase is Phase.MOVING and known.position is not None:
                self.setpoint = known.position
            self._change(POLICY_IS_GONE)
        elif self.policy_is_gone and since is not None and self._patience.is_over(since, now):
            self._give_up(f"the policy has been gone for {self._patience.limit_s:g} s")
        elif not self.policy_is_gone and since is not None:
            self._patience.gone_since = None
            self._since_s += now[0] - since[0]
            self._tracking.resume()
            self.setpoint = self.course.target
            self._change(f"goes on after: {self.reason}")
        return not self.policy_is_gone

    def _give_up(self, why: str, how: Mode | None = None, blind_since_s: float | None = None) -> None:
        """End the mission: bring the vehicle down."""
        self._hold.fault = None
        why = why if self._reported is None else f"{why}; {self._reported}"  # which may be why
        how = how or self._watched.way_down(self._steady_s, self._known)
        self._descend(how, Phase.ABORTED, why, blind_since_s)

    # What is to be done in each phase.

    def _connect(self, now_s: float, known: Telemetry) -> list[Command]:
        return self._follow(self._ground.connect(now_s, known, now_s - self._since_steady_s))

    def _prepare(self, now_s: float, known: Telemetry) -> list[Command]:
        return self._follow(self._ground.prepare(now_s, known))

    def _follow(self, advice: Next) -> list[Command]:
        """Do what a look at a vehicle led to that is not steered."""
        self.setpoint = advice.setpoint
        if advice.phase.is_over:
            lost = self._watched.link_is_lost(self._steady_s, self._known)
            self._taken |= self.phase in GROUND and not lost  # it is left alone
            self._end(advice.phase, advice.why)
        elif advice.phase is self.phase:
            self._change(advice.why)
        elif advice.phase is Phase.LANDING:
            self._descend(advice.down, advice.outcome, advice.why)
            self._descent.tries += advice.asked
        elif advice.phase is Phase.TAKEOFF and self.course.is_done:
            self._finish("when the bridge came back")
        else:
            self._enter(advice.phase, advice.why)
        return [] if advice.command is None else [advice.command]

    def _take_off(self, now_s: float, known: Telemetry) -> list[Command]:
        start, position = self.course.target, known.position
        if known.vehicle_s - self._since_s > self.settings.takeoff_timeout_s:
            self._give_up(f"not at the start after {self.settings.takeoff_timeout_s:g} s")
            return []
        if position is not None and abs(position.up_m - start.up_m) <= self.settings.tolerance_m:
            self.setpoint = start  # at the altitude to fly across
        if self._dwell.is_there(start, known):
            self._arrive_first()
            return []
        return [TakeOff(start.up_m)] if known.on_ground is not False and not self._crash.flies else []

    def _arrive_first(self) -> None:
        """Be at the cell where the mission begins, or at that to which an earlier bridge had begun to fly."""
        if self._finishes:
            self._finishes = False
            self._arrive("there")
        else:
            self.course.cell = self.course.goal
            self._enter(Phase.READY, f"at the start, cell {self.cell}")

    def _wait(self, now_s: float, known: Telemetry) -> list[Command]:
        if self._patience.is_over((self._since_s, self._since_steady_s), (known.vehicle_s, now_s)):
            self._give_up(f"no move from the policy for {self._patience.limit_s:g} s")
        return []

    def _fly(self, now_s: float, known: Telemetry) -> list[Command]:
        there, step_s = self._dwell.is_there(self.course.target, known), self.scenario.mission.step_s
        if there:
            self._arrive("there")
        elif known.vehicle_s - self._since_s >= step_s and known.position is not None:
            away_m = self.course.distance_m(known.position)
            if away_m <= self.settings.tolerance_m:
                self._arrive("there")
            elif self.course.may_end_at(known.position, self.settings):
                self._arrive(f"not there after {step_s:g} s, which a step has, {away_m:.0f} m away", False)
            elif not self._tracking.is_late:
                self._tracking.is_late = True
                self._change(f"{self.reason}: {away_m:.0f} m away after {step_s:g} s, flies on")
        return []

    def _arrive(self, how: str, reached: bool = True) -> None:
        """End a step."""
        self.course.arrive(reached)
        if self.course.is_done:
            self._finish(how)
        else:
            self._enter(Phase.READY, f"step {self.step}: {how}")

    def _finish(self, how: str) -> None:
        """Come down after the last step."""
        if self.course.is_at_dock:
            self._descend(Mode.LAND, Phase.LANDED, f"step {self.step}: at the dock ({how})")
        else:
            why = f"step {self.step}: out of steps away from the dock ({how})"
            self._descend(self.settings.failsafe_action, Phase.TIMEOUT, why)

    def _land(self, now_s: float, known: Telemetry) -> list[Command]:
        waited_s = self._asked.waited_s(SetMode(Mode.RETURN))
        return self._follow(self._descent.look(now_s, known, self.setpoint, waited_s))

    # Small change.

    def _descend(self, how: Mode, outcome: Phase, why: str, blind_since_s: float | None = None) -> None:
        """Bring it down; until it obeys, the setpoint holds it where it is."""
        self._descent = Landing(self.course, self._watched, how, outcome, why, blind_since_s)
        self._descent.obeys(self._known)  # it may come down already
        self._enter(Phase.LANDING, why)

    def _end(self, phase: Phase, why: str) -> None:
        before, self.setpoint, self._hold.fault = self.setpoint, None, None
        self._enter(phase, why)
        if not self.is_over:
            self.setpoint = before

    def _enter(self, phase: Phase, why: str) -> None:
        if (error := transition_error(self.phase, phase, self.step - self._entered_step)) is not None:
            self._refuse(error)
            return
        self.phase, self._since_s, self._entered_step = phase, self._now_s, self.step
        self._dwell.begin()
        self._tracking.begin()
        self._crash.begin(flies=phase in POLICY_CONTROLLED)
        self._patience.gone_since = None
        self._since_steady_s = self._steady_s
        self._asked.begin()
        self.reason = why
        self._on_change()

    def _refuse(self, error: PhaseError) -> None:
        """Give up a mission whose phases went wrong; one that comes down, or is over, stays so."""
        if self.is_strict:
            raise error
        self._entered_step = self.step  # within a step, each phase may come down or end
        if self.phase in OFFBOARD:
            self._give_up(f"an error of the bridge: {error}")
        elif self.phase in GROUND:
            self._end(Phase.ABORTED, f"an error of the bridge: {error}")

    def _change(self, why: str) -> None:
        """Tell another reason within a phase."""
        if why != self.reason:
            self.reason = why
            self._on_change()
