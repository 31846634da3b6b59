"""The vehicle of a mission with an autopilot: publishes its steps, flies the moves, and keeps it safe.

`uav_dc_ros.offboard` makes the decisions; `vehicles` has the transports. The bridge is a process of its own:
a policy that loads, hangs or dies disturbs no setpoint. A restarted bridge reads the mission's checkpoint in
its journal, and resumes the mission in the air; it never arms a second time.
"""

import dataclasses
import time
from collections import Counter

import msgspec
import numpy as np

from uav_dc_ros import cdr, messages, payloads, scenarios
from uav_dc_ros.core.grid import Action
from uav_dc_ros.errors import MessageError, NodeError, UavDcError
from uav_dc_ros.messages import Phase
from uav_dc_ros.nodes import vehicles
from uav_dc_ros.nodes.framework import node_main
from uav_dc_ros.nodes.framework.journal import Journal
from uav_dc_ros.nodes.framework.mission_node import MissionNode
from uav_dc_ros.nodes.ros import numeric_messages
from uav_dc_ros.nodes.ros.liveliness import LivelinessMonitor
from uav_dc_ros.offboard import datums, ground_station
from uav_dc_ros.offboard.frames import Enu, Geodetic
from uav_dc_ros.offboard.mission.controller import MissionController
from uav_dc_ros.offboard.mission.fault_detector import SafetySettings
from uav_dc_ros.offboard.mission.geofence import UPLOAD_MARGIN_M, Geofence
from uav_dc_ros.offboard.mission.keep_out import cell_conflict
from uav_dc_ros.offboard.mission.plausibility import PlausibilityFilter
from uav_dc_ros.offboard.mission.progress import Checkpoint
from uav_dc_ros.offboard.setpoint_stream import use_realtime_priority
from uav_dc_ros.offboard.vehicle import Mode, Telemetry, Vehicle
from uav_dc_ros.topics import TOPICS

TICK_S = 0.02  # vehicle time
MIN_TICK_S = 0.005  # steady time, for a simulated vehicle whose time is faster
NUMBERS_PERIOD_S = 0.2  # of battery and fix, for plots and maps
SPEED_OVER_S = 0.5  # steady time over which the speed of the vehicle's time is measured
STOP_TIMEOUT_S = 2.5  # for a vehicle to change its mode when the bridge stops


class SavedMission(msgspec.Struct, frozen=True, kw_only=True):
    """The journal's line; `system` is `Telemetry.system_id`."""

    fingerprint: str
    seed: int
    run: str
    checkpoint: Checkpoint
    grid_origin: str
    system: int | None


class AutopilotBridge(MissionNode):
    """Flies one mission of one vehicle."""

    def __init__(self) -> None:
        super().__init__("bridge")
        self._started = False

    def configure(self) -> None:
        """Load the world, and check parameters, journal and datum."""
        values = self.values
        self.scenario = scenarios.load(values["scenario"])
        settings = {field.name: values[field.name] for field in dataclasses.fields(SafetySettings)}
        self.settings = SafetySettings(**settings | {"failsafe_action": Mode(values["failsafe_action"])})
        self.journal = Journal(values["journal"])
        self.fence = Geofence.around(self.scenario, values["fence_margin_m"])
        if (conflict := cell_conflict(self.scenario, self.fence, self.settings)) is not None:
            raise NodeError(conflict)
        names = "vehicle", "connect", "system", "arm", "upload_fence"
        vehicles.check(*(values[name] for name in names))
        self._datum(self._restore())

    def activate(self) -> None:
        """Open the vehicle; the mission starts when the peers are ready, or is resumed at once."""
        saved = self._restore()
        checkpoint, grid_origin, system = None, "", None
        if saved is not None:
            checkpoint, grid_origin = saved.checkpoint, saved.grid_origin
            # On the ground the vehicle is selected anew: the one received first may be another.
            system = saved.system if checkpoint.airborne else None
        datum = self._datum(saved)
        self.run = self.values["run"] or (self.run if saved is None else saved.run)
        self.bridge = MissionController(self.scenario, self.settings, self._on_change, checkpoint, self.fence)
        self._started = checkpoint is not None and checkpoint.airborne
        self._may_start = not self.values["wait_for_start"] or saved is not None
        uploads = self.values["upload_fence"] and not self._started
        outline = self.fence.outline(UPLOAD_MARGIN_M) if uploads else ()
        self.vehicle: Vehicle = vehicles.make(
            self, self.values, self.scenario, datum, grid_origin, system, saved is not None, outline
        )
        self._station = self.vehicle if isinstance(self.vehicle, ground_station.GroundStationLink) else None
        self._texts = ground_station.MissionTexts()
        self._journal_failed = False
        self._telemetry = Telemetry(system_id=system, grid_origin=grid_origin)
        self._status: messages.Mission | None = None  # published last
        self._changes: list[str] = []  # since the last diagnostics
        self._n_changes = 0
        settings = self.settings
        self._plausibility = PlausibilityFilter(settings.max_speed_mps, settings.max_position_jump_m)
        self._position_s: float | None = None  # of the pose published last
        self._last_stamp_ns = 0
        self._numbers_s = 0.0  # time of the next battery and fix
        self._setpoint: Enu | None = None  # published last as `target`
        self._grid = ""  # its position, as logged last
        self._datum_saved, self._is_restarted = False, bool(grid_origin)
        self._speed_since: tuple[float, float] | None = None  # steady and vehicle time
        self._policy = LivelinessMonitor(self, TOPICS["move"])
        for close in (self._policy.close, self.journal.close, self.vehicle.close):
            self._until_inactive.callback(close)
        use_realtime_priority()  # this thread, not those of the middleware
        self.vehicle.open()
        self._timer = self.timer(TICK_S, self._tick)
        if self._started:
            self.get_logger().warning(f"resumes a mission at step {self.bridge.step}")
        else:
            self._publish_mission()

    def deactivate(self) -> None:
        """Stop the mission: request a landing or return of a vehicle in the air, and wait until it obeys."""
        if not self.bridge.is_over:
            self._started = True  # also for a vehicle that flies before the mission has started
            self.bridge.stop("the bridge was stopped", self._telemetry)
            self._wait_for_mode()
        self._publish_diagnostics()  # with the last changes

    def _wait_for_mode(self) -> None:
        """Handle callbacks (telemetry, and the timer of `_tick`) until the vehicle can be released."""
        deadline_s, failed = time.monotonic() + STOP_TIMEOUT_S, False
        while not self.bridge.can_be_released(self._telemetry) and time.monotonic() < deadline_s:
            try:
                self.spin_once(MIN_TICK_S)
            except Exception as error:  # whatever it was: the request is repeated
                if not failed:
                    self.get_logger().error(f"while the vehicle is brought down: {error}")
                failed = True

    # Before the start.

    def _datum(self, saved: SavedMission | None) -> Geodetic | None:
        """Datum of the grid; None: the vehicle's position, or the saved grid origin, gives it."""
        if saved is not None and saved.grid_origin:
            return None
        values = self.values
        return datums.parse(values["datum"], self.scenario, values["vehicle"], arm=values["arm"])

    def _restore(self) -> SavedMission | None:
        """The mission in the journal; raises NodeError if the journal belongs to another mission."""
        lines = self.journal.lines()
        if not lines:
            return None
        path, seed, fingerprint = self.values["journal"], self.values["seed"], self.scenario.fingerprint
        try:
            saved = msgspec.json.decode(lines[-1], type=SavedMission)
        except msgspec.DecodeError as error:
            raise NodeError(f"journal {path}: not a bridge's: {error}") from None
        if (saved.fingerprint, saved.seed) != (fingerprint, seed):
            raise NodeError(
                f"journal {path}: of another mission (seed {saved.seed}, scenario {saved.fingerprint}); "
                f"expected seed {seed}, scenario {fingerprint}, or a new file"
            )
        return saved

    # Services.

    def call_start(self) -> str:
        """Begin the mission: with `arm`, the bridge arms and takes off from here on."""
        if self._may_start or self._started:
            expected = "expected a first call, and the parameter wait_for_start"
            raise NodeError(f"the mission starts without this call, or has started; {expected}")
        if not self.all_ready:
            raise NodeError(f"not all of {', '.join(self.peers)} are ready yet; expected a later call")
        self._may_start = True
        return "the mission begins"

    def call_stop(self) -> str:
        """End the mission as `abort` does, but first complete the move in progress."""
        return self._end_mission("stopped by a service call", at_once=False)

    def call_abort(self) -> str:
        """Request return or land at once, as Ctrl-C of run_all does."""
        return self._end_mission("aborted by a service call", at_once=True)

    def _end_mission(self, reason: str, *, at_once: bool) -> str:
        bridge = self.bridge
        if bridge.is_over:
            raise NodeError(f"the mission is over ({bridge.phase.value}: {bridge.reason})")
        if bridge.phase is not Phase.LANDING:
            self._started = True  # also for a vehicle that flies before the mission has started
            (bridge.stop if at_once else bridge.stop_after_step)(reason, self._telemetry)
        return f"{bridge.phase.value}: {bridge.reason}"

    # In flight.

    def on_move(self, payload: messages.Move) -> None:
        """Fly a move."""
        self._policy.reset()
        if payload.mission != 0:
            raise MessageError("wrong_step", f"a move for mission {payload.mission}; expected mission 0")
        if (why := self.bridge.move(payload.step, Action[payload.action.upper()])) is not None:
            raise MessageError("not_now", why)

    def on_rates(self, payload: messages.Rates) -> None:
        """Show the data collection to ground stations."""
        payloads.check(payload, self.scenario)
        if self._station is not None:
            self._station.report_values(ground_station.values(payload))

    def _tick(self) -> None:
        """Update telemetry, decide, and send commands and setpoint."""
        self._telemetry = self.vehicle.telemetry()
        self._adapt_rate()
        self._publish_pose()
        self._publish_numbers()
        self._log_grid()
        if not self._started and self.all_ready:
            if self._may_start:
                self.check_other_publishers()
                self._started = True
            else:
                self._publish_mission()  # it shows what the mission waits for
        if self._started:
            self.bridge.policy_lost = self._policy.is_lost()
            for command in self.bridge.tick(time.monotonic(), self._telemetry):
                self.vehicle.send_command(command)
        setpoint = self.bridge.setpoint
        self.vehicle.set_setpoint(setpoint)
        if setpoint is not None and setpoint != self._setpoint:
            now_ns: int = self.get_clock().now().nanoseconds
            self.publish("target", cdr.encode_pose(np.asarray(setpoint), now_ns))
        self._setpoint = setpoint

    def _adapt_rate(self) -> None:
        """Set the timer's period to `TICK_S` of the vehicle's time."""
        now_s, vehicle_s = time.monotonic(), self._telemetry.vehicle_s
        if self._speed_since is None or vehicle_s < self._speed_since[1]:
            self._speed_since = now_s, vehicle_s
        since_s, vehicle_since_s = self._speed_since
        if now_s - since_s < SPEED_OVER_S:
            return
        speed = (vehicle_s - vehicle_since_s) / (now_s - since_s)
        self._speed_since = now_s, vehicle_s
        period_s = min(TICK_S, max(MIN_TICK_S, TICK_S / speed)) if speed > 0 else TICK_S
        if abs(period_s * 1e9 - self._timer.timer_period_ns) > 0.2 * self._timer.timer_period_ns:
            self._timer.timer_period_ns = round(period_s * 1e9)

    def _publish_pose(self) -> None:
        telemetry = self._plausibility.filter(time.monotonic(), self._telemetry)
        position, position_s = telemetry.position, telemetry.position_s
        if position is None or position_s is None or position_s == self._position_s:
            return
        self._position_s = position_s
        age_ns = round((time.monotonic() - position_s) * 1e9)
        now_ns: int = self.get_clock().now().nanoseconds
        self._last_stamp_ns = max(now_ns - age_ns, self._last_stamp_ns + 1)
        self.publish("pose", cdr.encode_pose(np.asarray(position), self._last_stamp_ns))

    def _publish_numbers(self) -> None:
        """Publish what the vehicle reports of its battery, and its position on the Earth."""
        now_s, telemetry = time.monotonic(), self._telemetry
        if now_s < self._numbers_s:
            return
        self._numbers_s = now_s + NUMBERS_PERIOD_S
        now_ns: int = self.get_clock().now().nanoseconds
        if telemetry.battery is not None:
            charge = numeric_messages.battery(telemetry.battery, now_ns, telemetry.battery_v)
            self.publish("battery", charge)
        if telemetry.position is not None and telemetry.datum is not None:
            latitude_deg, longitude_deg, _ = telemetry.datum.at(telemetry.position)
            self.publish("fix", numeric_messages.fix(latitude_deg, longitude_deg, now_ns))

    def _log_grid(self) -> None:
        """Log the grid's position once it is known, and its distance from that of the last flight."""
        datum, grid_origin = self._telemetry.datum, self._telemetry.grid_origin
        grid = grid_origin if datum is None else str(datum)
        if grid == self._grid:
            return
        self._grid, moved = grid, True
        text = f"the grid lies at {grid} of the vehicle's own frame; not compared with the last flight"
        if datum is not None:
            source = datums.RESTART if self._is_restarted else self.values["datum"]
            text, moved = datums.describe(datum, source, self.scenario)
        (self.get_logger().warning if moved else self.get_logger().info)(text)

    def _save_datum(self) -> None:
        """Save the datum at take-off, for the next flight."""
        datum = self._telemetry.datum
        if self._datum_saved or self.bridge.phase is not Phase.TAKEOFF or datum is None:
            return
        self._datum_saved = True
        try:
            datums.save(self.scenario, datum, self.values["vehicle"])
        except UavDcError as error:  # no reason not to fly
            self.get_logger().warning(f"the datum is not saved for the next flight ({datum}): {error}")

    def _on_change(self) -> None:
        """Save the mission, then publish it: what was published is never lost."""
        saved = SavedMission(
            fingerprint=self.scenario.fingerprint,
            seed=self.values["seed"],
            run=self.run,
            checkpoint=self.bridge.checkpoint,
            grid_origin=self._telemetry.grid_origin,
            system=self._telemetry.system_id,
        )
        try:
            self.journal.begin(msgspec.json.encode(saved))
        except NodeError as error:  # no reason to release a vehicle in the air
            if not self._journal_failed:
                self.get_logger().error(f"a bridge that is restarted now cannot resume the mission: {error}")
            self._journal_failed = True
        self._save_datum()
        self._publish_mission()

    def _publish_mission(self) -> None:
        bridge = self.bridge
        waits = "the service start" if self._peers_found and not self._may_start else ", ".join(self.peers)
        waits = "" if self._started else f"waits for {waits}"
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
            **payloads.battery(self.scenario, bridge.progress.energy_used_j),
            seed=self.values["seed"],
            scenario=self.scenario.name,
            fingerprint=self.scenario.fingerprint,
        )
        if status != self._status:
            self._status = status
            self._changes.append(f"{status.state}, step {status.step}: {status.reason}")
            self.publish_payload("mission", status)
            text = self._texts.update(status, bridge.checkpoint.outcome)
            if self._station is not None and text is not None:
                self._station.report_text(text)
            if not self.is_supervised and bridge.phase not in (Phase.READY, Phase.MOVING):
                self.get_logger().info(f"{status.state}: {status.reason}")

    def diagnose(self) -> tuple[list[str], dict[str, str]]:
        """State of mission and vehicle."""
        if not self._is_active:
            return [], {}
        bridge, telemetry, now_s = self.bridge, self._telemetry, time.monotonic()
        warnings = [bridge.reason] if bridge.phase is Phase.ABORTED or bridge.fault else []
        warnings += ["the journal cannot be written"] if self._journal_failed else []
        warnings += bridge.warnings
        values = {
            "phase": bridge.phase.value,
            "reason": bridge.reason,
            "step": str(bridge.step),
            "autopilot": telemetry.autopilot or "not known yet",
            "mode": telemetry.mode_name,
            "armed": str(telemetry.armed).lower(),
            "estimate": "good" if telemetry.estimate_ok else "not good",
            "battery": "" if telemetry.battery is None else f"{telemetry.battery:.0%}",
            **payloads.battery_diagnostics(self.scenario, bridge.progress.energy_used_j),
            "grid": self._grid,
            "system": telemetry.system,
            "other controller": telemetry.other_controller or "",
        }
        for reason, n in (Counter(telemetry.discarded) + Counter(bridge.detector.discarded)).items():
            values[f"discarded: {reason}"] = str(n)
        for name, at_s in (("position", telemetry.position_s), ("heartbeat", telemetry.heartbeat_s)):
            values[f"{name} age [s]"] = "" if at_s is None else f"{now_s - at_s:.2f}"
        for change in self._changes:
            self._n_changes += 1
            values[f"change {self._n_changes}"] = change
        self._changes.clear()
        return warnings, values


if __name__ == "__main__":
    node_main.main(AutopilotBridge, batch_scheduling=False)  # the vehicle does not wait
