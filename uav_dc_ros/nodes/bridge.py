"""The vehicle beside an autopilot: tells the mission's steps, flies the moves that come, and keeps it safe.

What it decides is in `uav_dc_ros.offboard`; how it reaches the vehicle, in `vehicles`. It is a process of
its own: a policy that loads, hangs or dies disturbs no setpoint. A bridge that was killed finds in its
journal where the mission stood, and takes it up in the air; it never arms a second time.
"""

import dataclasses
import time
from collections import Counter
from contextlib import ExitStack

import msgspec
import numpy as np

from uav_dc_ros import cdr, messages, scenarios
from uav_dc_ros.core.grid import Action
from uav_dc_ros.errors import MessageError, NodeError, UavDcError
from uav_dc_ros.messages import Phase
from uav_dc_ros.nodes import vehicles
from uav_dc_ros.nodes.framework import node_main
from uav_dc_ros.nodes.framework.journal import Journal
from uav_dc_ros.nodes.framework.mission_node import MissionNode
from uav_dc_ros.nodes.ros.liveliness import LivelinessMonitor
from uav_dc_ros.offboard import datums
from uav_dc_ros.offboard.frames import Enu, Geodetic
from uav_dc_ros.offboard.mission.controller import MissionController
from uav_dc_ros.offboard.mission.fault_detector import SafetySettings
from uav_dc_ros.offboard.mission.geofence import Geofence
from uav_dc_ros.offboard.mission.plausibility import PlausibilityFilter
from uav_dc_ros.offboard.mission.progress import Checkpoint
from uav_dc_ros.offboard.realtime import use_realtime_priority
from uav_dc_ros.offboard.vehicle import Mode, Telemetry, Vehicle
from uav_dc_ros.topics import TOPICS

TICK_S = 0.02  # vehicle time
TICK_LEAST_S = 0.005  # steady time: a simulated vehicle may be faster than anybody can look
SPEED_OVER_S = 0.5  # steady time over which the speed of the vehicle's time is measured
OBEYS_S = 2.5  # for a vehicle to obey a bridge that stops


class Kept(msgspec.Struct, frozen=True, kw_only=True):
    """The journal's line: which mission it is, where it stands, where the grid lies, and which vehicle flies.

    Attributes:
        system: the vehicle's number on its link, as `Telemetry.system_id`; None: not known.
    """

    fingerprint: str
    seed: int
    run: str
    standing: Checkpoint
    anchor: str
    system: int | None


class AutopilotBridge(MissionNode):
    """Flies one mission of one vehicle."""

    def __init__(self) -> None:
        super().__init__("bridge")
        self._open = ExitStack()  # what is to be closed
        self._begun = False

    def configure(self) -> None:
        """Load the world, and what is left of a mission whose bridge was killed."""
        values = self.values
        self.scenario = scenarios.load(values["scenario"])
        names = [field.name for field in dataclasses.fields(SafetySettings)]
        settings = {name: values[name] for name in names}
        self.settings = SafetySettings(**settings | {"failsafe_action": Mode(values["failsafe_action"])})
        self.journal = Journal(values["journal"])
        self.fence = Geofence.around(self.scenario, values["fence_margin_m"])
        vehicles.check(*(values[name] for name in ("vehicle", "connect", "system", "arm")))
        self._restore()
        self._datum()

    def activate(self) -> None:
        """Reach for the vehicle; the mission begins when the peers are ready, or goes on at once."""
        kept = self._restore()
        standing, anchor = (None, "") if kept is None else (kept.standing, kept.anchor)
        # On the ground it is found anew: who was heard first there need not be the one that is meant.
        system = kept.system if kept is not None and kept.standing.airborne else None
        datum = self._datum()
        self.run = self.values["run"] or (self.run if kept is None else kept.run)
        self.bridge = MissionController(self.scenario, self.settings, self._on_change, standing, self.fence)
        way = self.scenario, datum, anchor, system, kept is not None
        self.vehicle: Vehicle = vehicles.make(self, self.values, *way)
        self._ready_peers: set[str] = set()
        self._peers_seen = False
        self._begun = standing is not None and standing.airborne
        self._forgets = False  # the journal cannot be written
        self._known = Telemetry(system_id=system)
        self._told: messages.Mission | None = None
        self._news: list[str] = []  # changes since the last diagnostics
        self._changes = 0
        self._plausible = PlausibilityFilter(self.settings.max_speed_mps, self.settings.max_position_jump_m)
        self._position_s: float | None = None  # of the pose published last
        self._last_stamp_ns = 0
        self._setpoint: Enu | None = None  # published last as `target`
        self._grid = ""  # where it lies, as logged last
        self._grid_is_kept, self._is_restarted = False, bool(anchor)
        self._pace_since: tuple[float, float] | None = None  # steady and vehicle time
        self._policy = LivelinessMonitor(self, TOPICS["move"])
        for close in (self._policy.close, self.journal.close, self.vehicle.close):
            self._open.callback(close)
        use_realtime_priority()  # this thread; those of the middleware stay as they are
        self.vehicle.open()
        self._timer = self.timer(TICK_S, self._tick)
        if self._begun:
            self.get_logger().warning(f"takes up a mission at step {self.bridge.step}")
        else:
            self._tell()

    def deactivate(self) -> None:
        """Bring a vehicle that flies down, and let go of it once it obeys."""
        if not self.bridge.is_over:
            self._begun = True  # a vehicle that flies already is brought down, too
            self.bridge.stop("the bridge was stopped", self._known)
            self._wait_until_it_obeys()
        self._publish_diagnostics()  # the last changes, too

    def _wait_until_it_obeys(self) -> None:
        """Go on as before: to see whether it obeys takes messages, and the timer of `_tick`."""
        deadline_s, failed = time.monotonic() + OBEYS_S, False
        while not self.bridge.can_be_released(self._known) and time.monotonic() < deadline_s:
            try:
                self.spin_once(TICK_LEAST_S)
            except Exception as error:  # whatever it was: the vehicle is asked again
                if not failed:
                    self.get_logger().error(f"while the vehicle is brought down: {error}")
                failed = True

    def _undo_activation(self) -> None:
        super()._undo_activation()
        self._open.close()

    # Before the start.

    def on_ready(self, payload: messages.Ready) -> None:
        """Note that a peer is ready."""
        self.check_peer(payload)
        self._ready_peers.add(payload.node)

    def on_peers(self) -> None:
        """Note that all peers have been found."""
        self._peers_seen = True

    def _begin_if_all_ready(self) -> None:
        if not self._peers_seen or not self._ready_peers.issuperset(self.peers):
            return
        self.check_other_publishers()
        self._begun = True

    def _datum(self) -> Geodetic | None:
        """Where the grid is to lie; None: under the vehicle, or where it lay before this start.

        Raises:
            UavDcError: there is no such place.
        """
        kept = self._restore()
        if kept is not None and kept.anchor:
            return None
        values = self.values
        return datums.parse(values["datum"], self.scenario, values["vehicle"], arm=values["arm"])

    def _restore(self) -> Kept | None:
        """What the journal tells of a mission.

        Raises:
            NodeError: it is that of another flight.
        """
        lines = self.journal.lines()
        if not lines:
            return None
        try:
            kept = msgspec.json.decode(lines[-1], type=Kept)
        except msgspec.DecodeError as error:
            raise NodeError(f"journal {self.values['journal']}: not a bridge's: {error}") from None
        if (kept.fingerprint, kept.seed) != (self.scenario.fingerprint, self.values["seed"]):
            raise NodeError(
                f"journal {self.values['journal']}: of another flight (seed {kept.seed}, scenario "
                f"{kept.fingerprint}); expected seed {self.values['seed']}, scenario "
                f"{self.scenario.fingerprint}, or a new file"
            )
        return kept

    # Flying.

    def on_move(self, payload: messages.Move) -> None:
        """Fly a move."""
        self._policy.reset()
        if payload.mission != 0:
            raise MessageError("wrong_step", f"a move for mission {payload.mission}; expected mission 0")
        if (why := self.bridge.move(payload.step, Action[payload.action.upper()])) is not None:
            raise MessageError("not_now", why)

    def _tick(self) -> None:
        """Look at the vehicle, decide, set_setpoint."""
        self._known = known = self.vehicle.telemetry()
        self._keep_pace(known)
        self._publish_pose(known)
        self._tell_grid()
        if not self._begun:
            self._begin_if_all_ready()
        if self._begun:
            self.bridge.policy_lost = self._policy.is_lost()
            for command in self.bridge.tick(time.monotonic(), known):
                self.vehicle.send_command(command)
        self.vehicle.set_setpoint(self.bridge.setpoint)
        self._publish_target()

    def _keep_pace(self, known: Telemetry) -> None:
        """Look as often as the vehicle's own time asks for."""
        now_s = time.monotonic()
        if self._pace_since is None or known.vehicle_s < self._pace_since[1]:
            self._pace_since = now_s, known.vehicle_s
        since_s, vehicle_since_s = self._pace_since
        if now_s - since_s < SPEED_OVER_S:
            return
        speed = (known.vehicle_s - vehicle_since_s) / (now_s - since_s)
        self._pace_since = now_s, known.vehicle_s
        period_s = min(TICK_S, max(TICK_LEAST_S, TICK_S / speed)) if speed > 0 else TICK_S
        if abs(period_s * 1e9 - self._timer.timer_period_ns) > 0.2 * self._timer.timer_period_ns:
            self._timer.timer_period_ns = round(period_s * 1e9)

    def _publish_pose(self, known: Telemetry) -> None:
        known = self._plausible.filter(time.monotonic(), known)
        if known.position is None or known.position_s is None or known.position_s == self._position_s:
            return
        self._position_s = known.position_s
        age_ns = round((time.monotonic() - known.position_s) * 1e9)
        now_ns: int = self.get_clock().now().nanoseconds
        stamp_ns = max(now_ns - age_ns, self._last_stamp_ns + 1)
        self._last_stamp_ns = stamp_ns
        self.publish("pose", cdr.encode_pose(np.asarray(known.position), stamp_ns))

    def _publish_target(self) -> None:
        setpoint = self.bridge.setpoint
        if setpoint is not None and setpoint != self._setpoint:
            now_ns: int = self.get_clock().now().nanoseconds
            self.publish("target", cdr.encode_pose(np.asarray(setpoint), now_ns))
        self._setpoint = setpoint

    # Where the grid lies.

    def _tell_grid(self) -> None:
        """Log where the grid lies, as soon as that is known, and how far from the last flight's."""
        datum, anchor = self.vehicle.datum, self.vehicle.grid_origin
        where = anchor if datum is None else str(datum)
        if where == self._grid:
            return
        self._grid, moved = where, True
        told = f"the grid lies at {anchor} of the vehicle's own frame; not compared with the last flight"
        if datum is not None:
            source = "" if self._is_restarted else self.values["datum"] or datums.HERE
            told, moved = datums.describe(datum, source, self.scenario)
        (self.get_logger().warning if moved else self.get_logger().info)(told)

    def _keep_grid(self) -> None:
        """Keep where the grid of a vehicle that takes off lies, for the next flight."""
        datum = self.vehicle.datum
        if self._grid_is_kept or self.bridge.phase is not Phase.TAKEOFF or datum is None:
            return
        self._grid_is_kept = True
        try:
            datums.save(self.scenario, datum, self.values["vehicle"])
        except UavDcError as error:  # no reason not to fly
            self.get_logger().warning(f"the next flight will not know where the grid lay ({datum}): {error}")

    def _on_change(self) -> None:
        """Keep where the mission stands, and say it: what others know is never forgotten."""
        kept = Kept(
            fingerprint=self.scenario.fingerprint,
            seed=self.values["seed"],
            run=self.run,
            standing=self.bridge.checkpoint,
            anchor=self.vehicle.grid_origin,
            system=self._known.system_id,
        )
        try:
            self.journal.begin(msgspec.json.encode(kept))
        except NodeError as error:  # no reason to let go of a vehicle that flies
            if not self._forgets:
                self.get_logger().error(f"a bridge that is killed now will not know where it was: {error}")
            self._forgets = True
        self._keep_grid()
        self._tell()

    def _tell(self) -> None:
        bridge = self.bridge
        waits = "" if self._begun else f"waits for {', '.join(self.peers)}"
        status = messages.Mission(
            run=self.run,
            mission=0,
            step=bridge.step,
            phase=bridge.phase,
            reason=messages.one_line(waits or bridge.reason),
            held=bridge.fault_kind is not None,
            fault=bridge.fault_kind,
            cell=bridge.cell,
            remaining_steps=self.scenario.mission.max_steps - bridge.step,
            steps_not_reached=bridge.progress.steps_not_reached,
            seed=self.values["seed"],
            scenario=self.scenario.name,
            fingerprint=self.scenario.fingerprint,
        )
        if status != self._told:
            self._told = status
            self._news.append(f"{status.state}, step {status.step}: {status.reason}")
            self.publish_payload("mission", status)
            if not self.is_supervised and bridge.phase not in (Phase.READY, Phase.MOVING):
                self.get_logger().info(f"{status.state}: {status.reason}")

    def diagnose(self) -> tuple[list[str], dict[str, str]]:
        """Where the mission and the vehicle stand."""
        if not self._is_active:
            return [], {}
        bridge, known, now_s = self.bridge, self._known, time.monotonic()
        aborted = bridge.phase is Phase.ABORTED
        warnings = [bridge.reason] if aborted or bridge.fault else []
        warnings += ["the journal cannot be written"] if self._forgets else []
        warnings += bridge.warnings
        discarded = Counter(known.discarded) + Counter(bridge.discarded)
        values = {
            "phase": bridge.phase.value,
            "reason": bridge.reason,
            "step": str(bridge.step),
            "autopilot": self.vehicle.kind or "not heard yet",
            "mode": known.mode_name,
            "armed": str(known.armed).lower(),
            "estimate": "good" if known.estimate_ok else "not good",
            "battery": "" if known.battery is None else f"{known.battery:.0%}",
            "grid": self._grid,
            "system": known.system,
            "other controller": known.other_controller or "",
            **{f"discarded: {why}": str(n) for why, n in discarded.items()},
        }
        for name, at_s in (("position", known.position_s), ("heartbeat", known.heartbeat_s)):
            values[f"{name} age [s]"] = "" if at_s is None else f"{now_s - at_s:.2f}"
        for news in self._news:
            self._changes += 1
            values[f"change {self._changes}"] = news
        self._news.clear()
        return warnings, values


if __name__ == "__main__":
    node_main.main(AutopilotBridge, batch_scheduling=False)  # the vehicle does not wait
