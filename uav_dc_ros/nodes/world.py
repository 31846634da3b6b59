"""The world: the simulated vehicle, and the users who walk.

The vehicle publishes in `mission` which step it is ready for, and flies the `move` for that step. In lockstep
the next step starts when the move has arrived; at a pace, a step lasts its seconds divided by the pace, and
without a move in time the vehicle hovers. Beside a bridge (`vehicle:=external`) the world only moves the
users: see `ExternalUsers`.

Time in messages, and on `clock`, is mission time: it starts at zero and grows by `step_s` a step, so equal
seeds give equal messages at any pace. With `use_sim_time` another node's clock ends the steps, and the world
publishes none.

A world that was killed restores its state from the seed and from the moves in its journal.
"""

import time
from collections import deque

import msgspec
import numpy as np
from rosgraph_msgs.msg import Clock

from uav_dc_ros import cdr, messages, payloads, scenarios
from uav_dc_ros.core import pace
from uav_dc_ros.core import world as core
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.mobility import WalkingUsers
from uav_dc_ros.core.propagation.stochastic import Seeds
from uav_dc_ros.errors import MessageError, NodeError
from uav_dc_ros.messages import Phase
from uav_dc_ros.nodes.framework import node_main
from uav_dc_ros.nodes.framework.acknowledgements import AcknowledgementWindow
from uav_dc_ros.nodes.framework.external_users import ExternalUsers
from uav_dc_ros.nodes.framework.journal import Journal
from uav_dc_ros.nodes.framework.mission_node import MissionNode
from uav_dc_ros.nodes.framework.node_table import NODES, WORLD_BESIDE_BRIDGE
from uav_dc_ros.nodes.framework.parameters import EXTERNAL
from uav_dc_ros.nodes.ros import convert

STALL_S = 1.0  # a lockstep without a step for so long publishes its last messages again
CLOCK_PERIOD_S = 0.05
POSE_AGE_MAX_S = 10.0  # of an external vehicle; an older pose was recorded
USER_BYTES = 40  # of `users`, for each of them
OVERRUN_S = 0.005  # a step that starts later than this after its time is an overrun
STOP_REASON, ABORT_REASON = "stopped by a service call", "aborted by a service call"
ABORTED = b"aborted"  # last line of the journal of a mission that a service ended


class JournalHeader(msgspec.Struct, frozen=True):
    """First line of the journal: the mission of the moves that follow."""

    mission: int
    seed: int
    fingerprint: str
    run: str


class WorldNode(MissionNode):
    """Simulates missions one after the other: seeds `seed`, `seed + 1`, ..."""

    def __init__(self) -> None:
        super().__init__("world")

    def configure(self) -> None:
        """Load the scenario and check that it can be flown at this pace."""
        self.scenario = scenarios.load(self.values["scenario"])
        self.pace: float | None = self.values["pace"]
        self.external: ExternalUsers | None = None
        self.row = NODES["world"]
        if self.values["vehicle"] == EXTERNAL:
            self.row = WORLD_BESIDE_BRIDGE
            self.external = ExternalUsers(self.scenario, self.values["seed"])
        else:
            pace.check(self.scenario, self.pace, self.values["missions"])
        self.message_bytes = {"users": USER_BYTES * self.scenario.n_users}
        self.journal = Journal(self.values["journal"])

    def activate(self) -> None:
        """Restore the state from the journal and wait for the peers."""
        self._is_flying = False
        self._mission, self._step = -1, 0
        self._phase: Phase | None = None  # None before the first mission
        self._reason = ""  # of an abort
        self._may_start = not self.values["wait_for_start"]
        self._stops_after_step = False
        self._energy_used_j: Array = np.asarray(0.0)
        self._action: Action | None = None  # received for this step
        self._step_at_tick: tuple[int, int] | None = None
        self._next_users: tuple[int, int, bytes] | None = None  # mission, step, encoded payload
        self._hovered = 0  # steps without a move in time
        reliable = [self.publishers_of[name] for name in ("users", "mission") if name in self.publishers_of]
        self._unacknowledged = AcknowledgementWindow(reliable)
        self._overruns, self._overruns_reported = 0, 0
        self._lateness_s: deque[float] = deque(maxlen=1000)
        if self.external is None:
            self._restore()

    def deactivate(self) -> None:
        """Log the hovered steps, and abort a mission that is not over."""
        self.journal.close()
        if self._hovered:
            self.get_logger().warning(f"{self._hovered} steps were hovered: no move came in time")
        if self._is_flying and self._phase is Phase.READY:
            self._phase, self._reason = Phase.ABORTED, "the vehicle was stopped before the end of the mission"
            self.publish_payload("mission", self._status())

    # Before the first mission.

    def on_ready(self, payload: messages.Ready) -> None:
        """Note that a peer is ready; one that was restarted receives the current step again."""
        super().on_ready(payload)
        if not self._is_flying:
            self._start_if_all_ready()
        elif payload.node in self.peers and self.rows[payload.node].needed:
            self._publish_step()

    def on_peers(self) -> None:
        """Start if all peers are ready, too."""
        super().on_peers()
        if self.external is None:
            self._start_if_all_ready()

    def _start_if_all_ready(self) -> None:
        if self._is_flying or not (self.all_ready and self._may_start):
            return
        if self._phase is None:
            self.check_other_publishers()
        self._is_flying = True
        if self._phase is None:
            self._begin(0)
        else:
            self._publish_step()
        use_sim_time = self.get_parameter("use_sim_time").value
        self._period_s = pace.period_s(self.scenario, self.pace)
        self._step_began_s = time.monotonic()
        self._due_s = self._step_began_s + self._period_s
        self.timer(self._period_s or STALL_S, self._tick, self.get_clock() if use_sim_time else None)
        if not use_sim_time:
            self.timer(
                CLOCK_PERIOD_S, lambda: self.publish("clock", Clock(clock=convert.stamp(self._now_ns())))
            )

    # Services.

    def call_start(self) -> str:
        """Begin the first mission."""
        if self._may_start:
            expected = "expected a first call, and the parameter wait_for_start"
            raise NodeError(f"the missions start without this call, or have started; {expected}")
        if not self.all_ready:
            raise NodeError(f"not all of {', '.join(self.peers)} are ready yet; expected a later call")
        self._may_start = True
        self._start_if_all_ready()
        return f"mission {self._mission} begins"

    def call_stop(self) -> str:
        """End the missions after the step in progress."""
        return self._end_missions(at_once=False)

    def call_abort(self) -> str:
        """End the missions at once, as Ctrl-C of run_all does."""
        return self._end_missions(at_once=True)

    def _end_missions(self, *, at_once: bool) -> str:
        if self._phase is not None and self._phase is not Phase.READY:
            raise NodeError(f"the missions are over ({self._phase.value}); expected one in progress")
        if self._phase is Phase.READY and not at_once:
            self._stops_after_step = True
            return f"mission {self._mission} ends after step {self._step}"
        if self._phase is None:
            self._open(0)
            self._is_flying = True  # no mission begins any more
        self._abort(ABORT_REASON if at_once else STOP_REASON)
        self.publish_payload("mission", self._status())
        return f"mission {self._mission} is aborted at step {self._step}"

    def _abort(self, reason: str) -> None:
        self.journal.append(ABORTED)
        self._phase, self._reason = Phase.ABORTED, reason

    # Missions.

    def _begin(self, mission: int) -> None:
        self._open(mission)
        self._publish_step()

    def _open(self, mission: int) -> None:
        header = JournalHeader(mission, self.values["seed"], self.scenario.fingerprint, self.run)
        self.journal.begin(msgspec.json.encode(header))
        self._reset(mission)

    def _reset(self, mission: int) -> None:
        """Put the vehicle and the users at the start of a mission."""
        self._mission, self._step = mission, 0
        self._users = WalkingUsers(self.scenario, self.values["seed"] + mission)
        self._cell = np.asarray(self.scenario.start_cell)
        self._energy_used_j = np.asarray(0.0)
        self._phase = Phase.READY
        self._action = None

    def _restore(self) -> None:
        """Repeat the moves of the journal, without publishing; NodeError: it is that of another flight."""
        first, *moves = self.journal.lines() or [b""]
        if not first:
            return
        try:
            header = msgspec.json.decode(first, type=JournalHeader)
            is_aborted = moves[-1:] == [ABORTED]
            actions = [Action(int(move)) for move in moves[: len(moves) - is_aborted]]
        except (msgspec.DecodeError, ValueError) as error:
            raise NodeError(f"journal {self.values['journal']}: not a world's: {error}") from None
        if (header.seed, header.fingerprint) != (self.values["seed"], self.scenario.fingerprint):
            raise NodeError(
                f"journal {self.values['journal']}: of another flight (seed {header.seed}, scenario "
                f"{header.fingerprint}); expected seed {self.values['seed']}, scenario "
                f"{self.scenario.fingerprint}, or a new file"
            )
        self.run = self.values["run"] or header.run
        self._reset(header.mission)
        for action in actions:
            self._move(action)
        self._may_start = True
        if is_aborted:
            self._phase, self._reason = Phase.ABORTED, "ended by a service call, before a restart"
        self.get_logger().warning(f"resumes mission {self._mission} at step {self._step}")

    def on_move(self, payload: messages.Move) -> None:
        """Fly a move, or keep it for the next tick."""
        expected = (self._mission, self._step)
        if self._phase is not Phase.READY or (payload.mission, payload.step) != expected:
            raise MessageError(
                "wrong_step",
                f"a move for mission {payload.mission}, step {payload.step}; expected {expected}",
            )
        self._action = Action[payload.action.upper()]
        if self.pace is None:
            self._fly()

    def _tick(self) -> None:
        if self._phase is not Phase.READY:
            return
        if self.pace is not None:
            late_s = time.monotonic() - self._due_s
            self._due_s += self._period_s
            self._lateness_s.append(late_s)
            self._overruns += late_s > OVERRUN_S
            self._fly()
            return
        before, self._step_at_tick = self._step_at_tick, (self._mission, self._step)
        if before == self._step_at_tick:
            self._publish_step()

    def _fly(self) -> None:
        if self._action is None:
            self._hovered += 1
        action = Action.HOVER if self._action is None else self._action
        self.journal.append(b"%d" % int(action))
        self._move(action)
        if self._stops_after_step and self._phase is Phase.READY:
            self._abort(STOP_REASON)
        self._step_began_s = time.monotonic()
        if self.pace is None:
            self._unacknowledged.step()
        self._publish_step()
        if self._phase in (Phase.LANDED, Phase.TIMEOUT) and self._mission + 1 < self.values["missions"]:
            self._begin(self._mission + 1)
            if self._stops_after_step:
                self._abort(STOP_REASON)
                self.publish_payload("mission", self._status())

    def _move(self, action: Action) -> None:
        """One step of the world."""
        before, self._cell = self._cell, core.move(self.scenario, self._cell, np.asarray(int(action)))
        self._energy_used_j = core.energy_after(self.scenario, self._energy_used_j, before, self._cell)
        self._users.walk()
        self._step += 1
        self._action = None
        terminated, truncated, landed = core.end_of_mission(
            self.scenario, np.asarray(self._step), self._cell, self._energy_used_j
        )
        if terminated or truncated:
            self._phase = Phase.LANDED if landed else Phase.TIMEOUT

    # Beside a bridge.

    def on_mission(self, payload: messages.Mission) -> None:
        """Follow the external vehicle's mission."""
        assert self.external is not None, "the topic of another row"
        self.external.update(payload)

    def on_pose(self, pose: cdr.Pose) -> None:
        """Publish the users of the step that the external vehicle has reached."""
        assert self.external is not None, "the topic of another row"
        age_s = (self.published_ns - pose.stamp_ns) * 1e-9
        if self.values["run"] and abs(age_s) > POSE_AGE_MAX_S:
            raise MessageError(
                "stale",
                f"its stamp is {age_s:.0f} s older than its publication; expected at most "
                f"{POSE_AGE_MAX_S:g} s: it was recorded, and is played",
            )
        if (users := self.external.users(pose.stamp_ns, self.run)) is not None:
            self.publish_payload("users", users)

    # What the node publishes.

    def _publish_step(self) -> None:
        """Publish the state of this step, first what the policy needs for its move."""
        position_m = self.scenario.grid.centre_m(self._cell, like=self._users.positions_m)
        pose = cdr.encode_pose(position_m, self.scenario.time_ns(self._mission, self._step))
        self.publish("pose", pose)
        if self._next_users is not None and self._next_users[:2] == (self._mission, self._step):
            self.publish_encoded("users", self._next_users[2])
        else:
            self.publish_encoded(
                "users", self._encode_users(self._step, self._users.positions_m, self._users.seeds)
            )
        self.publish_payload("mission", self._status())
        self.publish("target", pose)  # a simulated vehicle is at its target
        if self.pace is None and self._phase is Phase.READY:  # while the other nodes compute
            step = self._step + 1
            text = self._encode_users(step, self._users.next_m(), self._users.next_seeds)
            self._next_users = self._mission, step, text

    def _encode_users(self, step: int, users_m: Array, seeds: Seeds | None) -> bytes:
        """The encoded `users` of a step at `users_m`, metres, `[U, 2]`."""
        time_ns = self.scenario.time_ns(self._mission, step)
        users = payloads.users(
            self.scenario,
            users_m,
            mission=self._mission,
            step=step,
            time_ns=time_ns,
            run=self.run,
            seeds=seeds,
        )
        return messages.encode(users)

    def _status(self) -> messages.Mission:
        assert self._phase is not None, "a mission has begun"
        east, north, up = self._cell.tolist()
        return messages.Mission(
            run=self.run,
            mission=self._mission,
            step=self._step,
            phase=self._phase,
            reason=self._reason,
            cell=(east, north, up),
            remaining_steps=self.scenario.mission.max_steps - self._step,
            **payloads.battery(self.scenario, self._energy_used_j),
            seed=self.values["seed"] + self._mission,
            scenario=self.scenario.name,
            fingerprint=self.scenario.fingerprint,
        )

    def _now_ns(self) -> int:
        """Mission time now: at a pace it passes within a step, up to the next one."""
        passed_s = 0.0
        if self.pace is not None and self._phase is Phase.READY:
            passed_s = (time.monotonic() - self._step_began_s) * self.pace
        begun_ns = self.scenario.time_ns(self._mission, self._step)
        return begun_ns + round(min(passed_s, self.scenario.mission.step_s) * 1e9)

    def diagnose(self) -> tuple[list[str], dict[str, str]]:
        """Progress of the mission, and the lateness of its steps."""
        if self.state != "active":
            return [], {}
        if self.external is not None:
            status = self.external.status
            return [], {"vehicle": f"{status.phase}, step {status.step}" if status else "no message yet"}
        waits = "peers" if self._may_start or not self.all_ready else "the service start"
        warnings = ["steps start late"] if self._overruns > self._overruns_reported else []
        self._overruns_reported = self._overruns
        values = {
            "mission": str(self._mission),
            "step": str(self._step),
            "phase": self._phase.value if self._phase else f"waiting for {waits}",
            **payloads.battery_diagnostics(self.scenario, self._energy_used_j),
            "hovered steps": str(self._hovered),
            "step overruns": str(self._overruns),
        }
        if self._lateness_s:
            p50, p99 = np.percentile(np.asarray(self._lateness_s), (50, 99)) * 1e3
            values |= {"step lateness p50 [ms]": f"{p50:.3f}", "step lateness p99 [ms]": f"{p99:.3f}"}
        return warnings, values


if __name__ == "__main__":
    node_main.main(WorldNode)
