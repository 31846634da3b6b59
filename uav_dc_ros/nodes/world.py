"""The world: the vehicle in simulation, and the users who walk about.

Around a vehicle from outside (`vehicle:=external`) it is the users only: see `surroundings`.

The vehicle says in `mission` which step it is ready for, and flies the `move` that comes for it. In
lockstep the next step starts when the move has come; at a pace, a step lasts its seconds divided by
the pace, and no move in time means hover.

Time in messages, and on `clock`, is mission time: it starts at zero and grows by `step_s` a step, so that
equal seeds give equal messages at any pace. With `use_sim_time` somebody else's clock says when a step is
over, and this node publishes none.

A world that was killed goes on where it was: seed and moves tell all, and its journal holds the moves.
"""

import time
from collections import deque

import msgspec
import numpy as np
from rclpy.duration import Duration

from uav_dc_ros import cdr, messages, payloads, scenarios
from uav_dc_ros.core import pace
from uav_dc_ros.core import world as core
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.users import WalkingUsers
from uav_dc_ros.errors import MessageError, NodeError
from uav_dc_ros.messages import Phase
from uav_dc_ros.nodes.external_users import ExternalUsers
from uav_dc_ros.nodes.framework import node_main
from uav_dc_ros.nodes.framework.journal import Journal
from uav_dc_ros.nodes.framework.mission_node import MissionNode
from uav_dc_ros.nodes.framework.node_table import NODES, WORLD_BESIDE_BRIDGE
from uav_dc_ros.nodes.framework.parameters import EXTERNAL
from uav_dc_ros.nodes.ros import convert

STALL_S = 1.0  # a lockstep that stands still for so long repeats its last messages
CONFIRM_S = 1.0  # a lockstep waits for who hears of it no longer than so
UNCONFIRMED_S = 0.02  # and than so, as long as one does not answer: it may have been killed
CLOCK_PERIOD_S = 0.05
POSE_AGE_MAX_S = 10.0  # of a vehicle from outside: what is older was not measured now
USER_BYTES = 40  # of `users`, for each of them
OVERRUN_S = 0.005  # a step at a pace that starts later than this after its time


class Flown(msgspec.Struct, frozen=True):
    """First line of the journal: which mission its moves belong to."""

    mission: int
    seed: int
    fingerprint: str
    run: str


class WorldNode(MissionNode):
    """Simulates missions one after the other: seeds `seed`, `seed + 1`, ..."""

    def __init__(self) -> None:
        super().__init__("world")

    def configure(self) -> None:
        """Load the world, and see whether it can be flown at this pace."""
        self.scenario = scenarios.load(self.values["scenario"])
        self.pace: float | None = self.values["pace"]
        self.surroundings: ExternalUsers | None = None
        is_around = self.values["vehicle"] == EXTERNAL
        self.row = WORLD_BESIDE_BRIDGE if is_around else NODES["world"]
        if is_around:
            self.surroundings = ExternalUsers(self.scenario, self.values["seed"])
        else:
            pace.check(self.scenario, self.pace, self.values["missions"])
        self.message_bytes = {"users": USER_BYTES * self.scenario.n_users}
        self.journal = Journal(self.values["journal"])

    def activate(self) -> None:
        """Wait for the peers; a journal tells where to go on."""
        self._ready_peers: set[str] = set()
        self._peers_seen = False
        self._flying = False
        self._mission, self._step = -1, 0
        self._phase: Phase | None = None  # none before the first mission
        self._action: Action | None = None  # that has come for this step
        self._seen_by_tick: tuple[int, int] | None = None
        self._ahead: tuple[int, int, bytes] | None = None  # mission, step, and its `users`, encoded
        self._hovered = 0  # steps without a move in time
        self._unconfirmed = 0  # steps since all who hear of them were known to have got them
        self._all_confirm = True  # did they, the last time
        said = (self.publishers_of[topic] for topic in ("users", "mission") if topic in self.publishers_of)
        self._unconfirmed_max = min(publisher.qos_profile.depth for publisher in said) // 2
        self._overruns, self._overruns_told = 0, 0
        self._lateness_s: deque[float] = deque(maxlen=1000)
        if self.surroundings is None:
            self._restore()

    def deactivate(self) -> None:
        """Say that a mission was stopped before its end, and what happened for want of a move."""
        self.journal.close()
        if self._hovered:
            self.get_logger().warning(f"{self._hovered} steps were hovered: no move came in time")
        if self._flying and self._phase is Phase.READY:
            self._phase = Phase.ABORTED
            self.publish_payload(
                "mission", self._status("the vehicle was stopped before the end of the mission")
            )

    # Before the first mission.

    def on_ready(self, payload: messages.Ready) -> None:
        """Note that a peer is ready; one that came back is told where the mission stands."""
        self.check_peer(payload)
        self._ready_peers.add(payload.node)
        if not self._flying:
            self._start_if_all_ready()
        elif payload.node in self.peers and self.rows[payload.node].needed:
            self._tell()

    def on_peers(self) -> None:
        """Note that all peers have been found."""
        super().on_peers()
        self._peers_seen = True
        if self.surroundings is None:
            self._start_if_all_ready()

    def _start_if_all_ready(self) -> None:
        if self._flying or not self._peers_seen or not self._ready_peers.issuperset(self.peers):
            return
        if self._phase is None:
            self.check_other_publishers()
        self._flying = True
        if self._phase is None:
            self._begin(0)
        else:
            self._tell()
        self._start_clocks()

    def _start_clocks(self) -> None:
        """Time begins to pass: by this machine's steady clock, or by the one of `use_sim_time`."""
        follows = self.get_parameter("use_sim_time").value
        self._period_s = pace.period_s(self.scenario, self.pace)
        self._step_began_s = time.monotonic()
        self._due_s = self._step_began_s + self._period_s
        self.timer(self._period_s or STALL_S, self._tick, self.get_clock() if follows else None)
        if not follows:
            self.timer(CLOCK_PERIOD_S, lambda: self.publish("clock", convert.clock(self._now_ns())))

    # Missions.

    def _begin(self, mission: int) -> None:
        flown = Flown(mission, self.values["seed"], self.scenario.fingerprint, self.run)
        self.journal.begin(msgspec.json.encode(flown))
        self._place(mission)
        self._tell()

    def _place(self, mission: int) -> None:
        """Put the vehicle and the users where a mission starts."""
        self._mission, self._step = mission, 0
        self._crowd = WalkingUsers(self.scenario, self.values["seed"] + mission)
        self._cell = np.asarray(self.scenario.start_cell)
        self._phase = Phase.READY
        self._action = None

    def _restore(self) -> None:
        """Fly again, silently, what the journal of a killed world holds.

        Raises:
            NodeError: it is the journal of another flight.
        """
        head, *moves = self.journal.lines() or [b""]
        if not head:
            return
        try:
            flown = msgspec.json.decode(head, type=Flown)
            actions = [Action(int(move)) for move in moves]
        except (msgspec.DecodeError, ValueError) as error:
            raise NodeError(f"journal {self.values['journal']}: not a world's: {error}") from None
        if (flown.seed, flown.fingerprint) != (self.values["seed"], self.scenario.fingerprint):
            raise NodeError(
                f"journal {self.values['journal']}: of another flight (seed {flown.seed}, scenario "
                f"{flown.fingerprint}); expected seed {self.values['seed']}, scenario "
                f"{self.scenario.fingerprint}, or a new file"
            )
        self.run = self.values["run"] or flown.run
        self._place(flown.mission)
        for action in actions:
            self._move(action)
        self.get_logger().warning(f"goes on with mission {self._mission} at step {self._step}")

    def on_move(self, payload: messages.Move) -> None:
        """Fly a move, or keep it for the next tick."""
        awaited = (self._mission, self._step)
        if self._phase is not Phase.READY or (payload.mission, payload.step) != awaited:
            raise MessageError(
                "wrong_step", f"a move for mission {payload.mission}, step {payload.step}; expected {awaited}"
            )
        self._action = Action[payload.action.upper()]
        if self.pace is None:
            self._fly()

    def _tick(self) -> None:
        if self._phase is not Phase.READY:
            return
        if self.pace is not None:
            self._measure_lateness()
            self._fly()
        elif self._stood_still():
            self._tell()

    def _measure_lateness(self) -> None:
        late_s = time.monotonic() - self._due_s
        self._due_s += self._period_s
        self._lateness_s.append(late_s)
        self._overruns += late_s > OVERRUN_S

    def _stood_still(self) -> bool:
        before, self._seen_by_tick = self._seen_by_tick, (self._mission, self._step)
        return before == self._seen_by_tick

    def _fly(self) -> None:
        if self._action is None:
            self._hovered += 1
        action = Action.HOVER if self._action is None else self._action
        self.journal.append(b"%d" % int(action))
        self._move(action)
        self._step_began_s = time.monotonic()
        if self.pace is None:
            self._wait_for_the_slowest()
        self._tell()
        if self._phase is not Phase.READY and self._mission + 1 < self.values["missions"]:
            self._begin(self._mission + 1)

    def _wait_for_the_slowest(self) -> None:
        """Fly no further ahead of who hears of the steps than messages are kept for them: in lockstep only.

        It knows of no time, and would leave behind whom a busy computer gives too little.
        """
        self._unconfirmed += 1
        if self._unconfirmed > self._unconfirmed_max:
            patience = Duration(seconds=CONFIRM_S if self._all_confirm else UNCONFIRMED_S)
            self._all_confirm = self.publishers_of["mission"].wait_for_all_acked(patience)
            self._unconfirmed = 0

    def _move(self, action: Action) -> None:
        """One step of the world."""
        self._cell = self.scenario.grid.move(self._cell, np.asarray(int(action)))
        self._crowd.walk()
        self._step += 1
        self._action = None
        terminated, truncated, landed = core.ends(self.scenario, np.asarray(self._step), self._cell)
        if terminated or truncated:
            self._phase = Phase.LANDED if landed else Phase.TIMEOUT

    # Around a vehicle from outside.

    def on_mission(self, payload: messages.Mission) -> None:
        """Note where the vehicle's mission stands."""
        assert self.surroundings is not None, "otherwise it is this node that says it"
        self.surroundings.hear(payload)

    def on_pose(self, pose: cdr.Pose) -> None:
        """Publish the users of a step that the vehicle has come to."""
        assert self.surroundings is not None, "otherwise it is this node that says it"
        age_s = (self.published_ns - pose.stamp_ns) * 1e-9
        if self.values["run"] and abs(age_s) > POSE_AGE_MAX_S:
            raise MessageError(
                "stale",
                f"its stamp is {age_s:.0f} s older than its publication; expected at most "
                f"{POSE_AGE_MAX_S:g} s: it was recorded, and is played",
            )
        if (users := self.surroundings.users(pose.stamp_ns, self.run)) is not None:
            self.publish_payload("users", users)

    # What the others hear.

    def _tell(self) -> None:
        """Publish the state of this step. What the move waits for comes first."""
        position_m = self.scenario.grid.centre_m(self._cell, like=self._crowd.positions_m)
        pose = cdr.encode_pose(position_m, self.scenario.time_ns(self._mission, self._step))
        self.publish("pose", pose)
        if self._ahead is not None and self._ahead[:2] == (self._mission, self._step):
            self.publish_encoded("users", self._ahead[2])
        else:
            self.publish_encoded("users", self._users(self._step, self._crowd.positions_m))
        self.publish_payload("mission", self._status())
        self.publish("target", pose)  # a simulated vehicle is where it was sent to
        if self.pace is None and self._phase is Phase.READY:  # while the others are at work
            self._ahead = self._mission, self._step + 1, self._users(self._step + 1, self._crowd.ahead_m())

    def _users(self, step: int, users_m: Array) -> bytes:
        """The users of a step, metres `[U, 2]`, as they are said."""
        time_ns = self.scenario.time_ns(self._mission, step)
        return messages.encode(
            payloads.users(
                self.scenario, users_m, mission=self._mission, step=step, time_ns=time_ns, run=self.run
            )
        )

    def _status(self, reason: str = "") -> messages.Mission:
        assert self._phase is not None, "a mission has begun"
        east, north, up = self._cell.tolist()
        return messages.Mission(
            run=self.run,
            mission=self._mission,
            step=self._step,
            phase=self._phase,
            reason=reason,
            cell=(east, north, up),
            remaining_steps=self.scenario.mission.max_steps - self._step,
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
        """Where the mission stands, and whether its steps keep their time."""
        if self.state != "active":
            return [], {}
        if self.surroundings is not None:
            status = self.surroundings.status
            return [], {"vehicle": f"{status.phase}, step {status.step}" if status else "not heard yet"}
        late, self._overruns_told = self._overruns > self._overruns_told, self._overruns
        values = {
            "mission": str(self._mission),
            "step": str(self._step),
            "phase": self._phase.value if self._phase else "waiting for peers",
            "hovered steps": str(self._hovered),
            "step overruns": str(self._overruns),
        }
        if self._lateness_s:
            p50, p99 = np.percentile(np.asarray(self._lateness_s), (50, 99)) * 1e3
            values |= {"step lateness p50 [ms]": f"{p50:.3f}", "step lateness p99 [ms]": f"{p99:.3f}"}
        return (["steps start late"] if late else []), values


if __name__ == "__main__":
    node_main.main(WorldNode)
