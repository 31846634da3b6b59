"""The world: the vehicle in simulation, and the users who walk about.

The vehicle says in `mission` which step it is ready for, and flies the `move` that comes for it. In
lockstep the next step starts when the move has come; at a pace, a step lasts its seconds divided by
the pace, and no move in time means hover.

Time in messages is mission time: it starts at zero and grows by `step_s` a step, so that equal seeds
give equal messages at any pace.
"""

import numpy as np

from uav_dc_ros import messages
from uav_dc_ros.core import pace
from uav_dc_ros.core import world as core
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.grid import Action
from uav_dc_ros.errors import MessageError, NodeError, ParameterError
from uav_dc_ros.nodes import convert, runtime

STALL_S = 2.0  # a lockstep that stands still for so long repeats its last messages


class World(runtime.MissionNode):
    """Simulates missions one after the other: seeds `seed`, `seed + 1`, ..."""

    def __init__(self) -> None:
        super().__init__("world")
        self.scenario = self.scenario_parameter()
        self.seed = self.whole_number("seed", 0, 0, "seed of the first mission's users")
        self.missions = self.whole_number("missions", 1, 1, "missions to fly, one after the other")
        wanted = self.parameter("pace", pace.LOCKSTEP, "'lockstep', or how many times faster than real time")
        try:
            self.pace = pace.parse(wanted)
        except ParameterError as error:
            raise ParameterError(f"pace: {error}") from None
        pace.check(self.scenario, self.pace, self.missions)
        self._ready_peers: set[str] = set()
        self._peers_seen = False
        self._mission, self._step = -1, 0
        self._phase: messages.Phase | None = None  # none before the first mission
        self._action: Action | None = None  # that has come for this step
        self._hovered = 0  # steps without a move in time
        self._seen_by_tick: tuple[int, int] | None = None
        self.listen()

    # Before the first mission.

    def on_ready(self, payload: messages.Ready) -> None:
        """Note that a peer is ready."""
        self._ready_peers.add(payload.node)
        self._start_if_all_ready()

    def on_peers(self) -> None:
        """Note that all peers have been found."""
        self._peers_seen = True
        self._start_if_all_ready()

    def _start_if_all_ready(self) -> None:
        if self._mission < 0 and self._peers_seen and self._ready_peers.issuperset(self._peers):
            if self.count_publishers("mission") > 1:
                raise NodeError(runtime.ANOTHER_MISSION)
            self._begin(0)
            period_s = pace.period_s(self.scenario, self.pace) or STALL_S
            self._timer = self.create_timer(period_s, self._tick, clock=self.steady)

    # Missions.

    def _begin(self, mission: int) -> None:
        self._mission, self._step = mission, 0
        self._rng = np.random.default_rng(self.seed + mission)
        self._users_m = core.place_users(self.scenario, self._draw())
        self._cell = np.asarray(self.scenario.start_cell)
        self._phase = messages.Phase.READY
        self._action = None
        self._tell()

    def _draw(self) -> Array:
        """Random numbers in the order of the environment: one for the start, one for each step."""
        return self._rng.random((self.scenario.n_users, 2))

    def on_move(self, payload: messages.Move) -> None:
        """Fly a move, or keep it for the next tick."""
        awaited = (self._mission, self._step)
        if self._phase is not messages.Phase.READY or (payload.mission, payload.step) != awaited:
            raise MessageError(
                "wrong_step", f"a move for mission {payload.mission}, step {payload.step}; expected {awaited}"
            )
        self._action = Action[payload.action.upper()]
        if self.pace is None:
            self._fly()

    def _tick(self) -> None:
        if self._phase is not messages.Phase.READY:
            return
        if self.pace is not None:
            self._fly()
        elif self._stood_still():
            self._tell()

    def _stood_still(self) -> bool:
        before, self._seen_by_tick = self._seen_by_tick, (self._mission, self._step)
        return before == self._seen_by_tick

    def _fly(self) -> None:
        if self._action is None:
            self._hovered += 1
        action = Action.HOVER if self._action is None else self._action
        self._cell = self.scenario.grid.move(self._cell, np.asarray(int(action)))
        self._users_m = core.walk_users(self.scenario, self._users_m, self._draw())
        self._step += 1
        self._action = None
        terminated, truncated, landed = core.ends(self.scenario, np.asarray(self._step), self._cell)
        if terminated or truncated:
            self._phase = messages.Phase.LANDED if landed else messages.Phase.TIMEOUT
        self._tell()
        if self._phase is not messages.Phase.READY and self._mission + 1 < self.missions:
            self._begin(self._mission + 1)

    def on_stop(self) -> None:
        """Say that a mission was stopped before its end, and what happened for want of a move."""
        if self._hovered:
            self.get_logger().warning(f"{self._hovered} steps were hovered: no move came in time")
        if self._phase is messages.Phase.READY:
            self._phase = messages.Phase.ABORTED
            self.say("mission", self._status())

    # What the others hear.

    def _tell(self) -> None:
        """Publish the state of this step. The mission comes last: it asks for the move."""
        position_m = self.scenario.grid.centre_m(self._cell, like=self._users_m)
        time_ns = self._time_ns()
        self.publish("target", convert.pose(position_m, time_ns))
        self.publish("pose", convert.pose(position_m, time_ns))
        self.say(
            "users",
            convert.users(
                self.scenario, self._users_m, mission=self._mission, step=self._step, time_ns=time_ns
            ),
        )
        self.say("mission", self._status())

    def _status(self) -> messages.Mission:
        assert self._phase is not None, "a mission has begun"
        east, north, up = (int(index) for index in self._cell)
        return messages.Mission(
            mission=self._mission,
            step=self._step,
            phase=self._phase,
            cell=(east, north, up),
            remaining_steps=self.scenario.mission.max_steps - self._step,
            seed=self.seed + self._mission,
            scenario=self.scenario.name,
            fingerprint=self.scenario.fingerprint,
        )

    def _time_ns(self) -> int:
        """Mission time; missions follow each other one step apart."""
        steps = self._mission * (self.scenario.mission.max_steps + 1) + self._step
        return round(steps * self.scenario.mission.step_s * 1e9)


if __name__ == "__main__":
    runtime.main(World)
