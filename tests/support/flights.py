"""Bags of flights with a real vehicle: all is real but the vehicle, which is simulated, and so is time.

The bridge is the real one; who publishes what, and when, is what its node, the world around a vehicle from
outside, the channel monitor and a policy do. No aircraft can be had here, and no time is waited for.
"""

from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np

from tests.recordings.made import BEGUN_NS, about, bag_message, pose, write
from tests.support.fake_autopilot.common import way_home
from tests.support.fake_autopilot.simulated import Vehicle
from uav_dc_ros import cdr, messages, payloads
from uav_dc_ros.agents.policy import Policy
from uav_dc_ros.bags.read import BagMessage
from uav_dc_ros.core import world
from uav_dc_ros.core.grid import ACTION_LABELS, Action
from uav_dc_ros.core.mobility import WalkingUsers
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.messages import Phase
from uav_dc_ros.offboard.frames import Enu
from uav_dc_ros.offboard.mission.controller import MissionController
from uav_dc_ros.offboard.mission.fault_detector import SafetySettings
from uav_dc_ros.offboard.vehicle import Mode

TICK_S = 0.1  # from one position to the next: ten a second
LATENCY_NS = 700_000
DEAD_S = 2.0  # a bridge that was killed is missing for so long
LIMIT_S = 6000.0
ARRIVED = (Phase.READY, Phase.LANDING, Phase.LANDED, Phase.TIMEOUT, Phase.ABORTED)
SWAY_M = 0.4  # how far a vehicle is from where it is sent, at most


class Flight:
    """One flight, told message by message.

    Args:
        scenario: the world.
        seed: of its users.
        beat: called before each tick, to do harm.
        settings: of the bridge.
        policy: decides; None: straight to the dock.
        patience_s: how long the policy thinks about a move.
        speed: how much faster than time the vehicle is.
        tick_s: vehicle time from one position to the next.
        begun_ns: when.

    Attributes:
        told: what was published.
        bridge: the one that lives now; None while none does.
        vehicle: the simulated one.
        executed: the step of each move that was begun.
    """

    def __init__(
        self,
        scenario: Scenario,
        *,
        seed: int = 0,
        beat: Callable[["Flight"], None] = lambda _: None,
        settings: SafetySettings | None = None,
        policy: Policy | None = None,
        patience_s: float = 0.0,
        speed: float = 1.0,
        tick_s: float = TICK_S,
        begun_ns: int = BEGUN_NS,
    ) -> None:
        self.scenario, self.seed, self.speed, self.tick_s = scenario, seed, speed, tick_s
        self.settings = settings or SafetySettings(arm=True)
        self.told: list[BagMessage] = []
        self.executed: list[int] = []
        x_m, y_m, _ = scenario.mission.start_m
        self.vehicle = Vehicle(position=Enu(x_m, y_m, 0.0))
        self.bridge: MissionController | None = self._bridge()
        self._beat, self._policy, self._begun_ns = beat, policy, begun_ns
        self._sent_ns = 0
        self._dead_until_s = 0.0
        self._patience_s, self._ready_since_s = patience_s, 0.0
        self._sway = np.random.default_rng(seed)
        self._last: messages.Mission | None = None
        self._users_due = False
        self._users_of = -1  # step
        self._crowd = WalkingUsers(scenario, seed)
        self._rates: messages.Rates | None = None
        self._data_bits = np.zeros(scenario.n_users)
        self._collected = np.zeros(scenario.n_users, dtype=bool)

    def fly(self, cut_s: float = np.inf) -> list[BagMessage]:
        """Fly until it is over, or the recorder is stopped."""
        while self.bridge is None or not self.bridge.is_over:
            if self.vehicle.now_s > cut_s:
                return self.told
            assert self.vehicle.now_s < LIMIT_S, self._last
            self._tick()
        self._tick()
        return self.told

    def kill_bridge(self) -> None:
        """SIGKILL it; another one comes after a while."""
        assert self.bridge is not None
        self._checkpoint, self._setpoint = self.bridge.checkpoint, self.bridge.setpoint
        self.bridge, self._dead_until_s = None, self.vehicle.now_s + DEAD_S

    def set_clock(self, by_s: float) -> None:
        """Set the clock of the machine forward, or back."""
        self._begun_ns += round(by_s * 1e9)
        self._sent_ns = 0

    @property
    def now_ns(self) -> int:
        """The time of the machine."""
        return self._begun_ns + round(self.vehicle.now_s / self.speed * 1e9)

    def _bridge(self, **checkpoint: object) -> MissionController:
        return MissionController(self.scenario, self.settings, self._tell, **checkpoint)  # type: ignore[arg-type]

    def _tick(self) -> None:
        self._beat(self)
        bridge, vehicle = self.bridge, self.vehicle
        if bridge is None:
            if vehicle.now_s >= self._dead_until_s:
                self.bridge = self._bridge(checkpoint=self._checkpoint)
            vehicle.pass_time(self.tick_s, self._setpoint)
            return
        for command in bridge.tick(vehicle.now_s, vehicle.telemetry):
            vehicle.send_command(command)
        if vehicle.telemetry.position is not None and vehicle.telemetry.position_s == vehicle.now_s:
            self._say_pose(vehicle.telemetry.position)
        self._decide(bridge)
        vehicle.pass_time(self.tick_s, bridge.setpoint)

    def _say(self, topic: str, payload: messages.Payload | bytes) -> None:
        sent_ns = self._sent_ns = max(self.now_ns, self._sent_ns + 1000)
        self.told.append(bag_message(topic, payload, sent_ns)._replace(log_time_ns=sent_ns + LATENCY_NS))

    def _tell(self) -> None:
        """What the bridge says at every change."""
        bridge = self.bridge
        assert bridge is not None
        status = messages.Mission(
            mission=0,
            step=bridge.step,
            phase=bridge.phase,
            reason=bridge.reason,
            held=bridge.fault_kind is not None,
            fault=bridge.fault_kind,
            cell=bridge.cell,
            remaining_steps=self.scenario.mission.max_steps - bridge.step,
            seed=self.seed,
            scenario=self.scenario.name,
            fingerprint=self.scenario.fingerprint,
            steps_not_reached=bridge.progress.steps_not_reached,
        )
        if status == self._last:
            return  # as the node does
        self._last = status
        self._say("mission", status)
        if bridge.phase is Phase.READY:
            self._ready_since_s = self.vehicle.now_s
        is_new = bridge.step != self._users_of
        if bridge.phase is Phase.READY or (bridge.phase in ARRIVED and is_new and bridge.step > 0):
            self._users_due = True

    def _say_pose(self, position: Enu) -> None:
        swayed = np.asarray(position) + (self._sway.random(3) * 2 - 1) * SWAY_M / 3**0.5
        stamp_ns = self.now_ns
        self._say("pose", pose(swayed.tolist(), stamp_ns))
        if not self._users_due or self._last is None:
            return
        self._users_due = False
        step = self._last.step
        self._users_of = step
        self._crowd.walk(step - self._crowd.step)
        users_m = self._crowd.positions_m
        at = {"mission": 0, "step": step}
        seeds = self._crowd.seeds
        users = payloads.users(self.scenario, users_m, time_ns=stamp_ns, seeds=seeds, **at)
        self._say("users", users)
        if self._rates is None or self._rates.step != step:
            drawn = payloads.realization(users, self.scenario)
            link = world.measure(self.scenario, swayed, users_m, self._collected, drawn=drawn)
            if step:
                self._data_bits, self._collected = world.collect(
                    self.scenario, link, self._data_bits, self._collected
                )
            self._rates = payloads.rates(link, self._data_bits, self._collected, **at)
        self._say("rates", self._rates)

    def _decide(self, bridge: MissionController) -> None:
        """The policy's answer to rates and a vehicle that is ready."""
        rates, status = self._rates, self._last
        if rates is None or status is None or rates.step != bridge.step:
            return
        if bridge.phase is not Phase.READY or bridge.fault is not None:
            return
        if self.vehicle.now_s - self._ready_since_s < self._patience_s:
            return
        self.vehicle.climb_to_m = None  # it has taken off, and may descend
        action = way_home(bridge) if self._policy is None else self._decided(status, rates)
        step = bridge.step
        self._say("move", messages.Move(mission=0, step=step, action=ACTION_LABELS[action]))
        if bridge.move(step, action) is None:
            self.executed.append(step)
            goal = bridge.scenario.grid.centre_m(np.asarray(bridge.progress.goal), like=np.zeros(1))
            self._say("target", pose(goal.tolist(), self.now_ns))

    def _decided(self, status: messages.Mission, rates: messages.Rates) -> Action:
        assert self._policy is not None
        observation = self._policy.observe(
            self.scenario,
            cell=np.asarray(status.cell),
            step=np.asarray(status.step),
            data_bits=np.asarray(rates.data_bits),
            collected=np.asarray(rates.collected),
        )
        return Action(int(self._policy.act(observation)))


def once(when: Callable[[Flight], bool], do: Callable[[Flight], None]) -> Callable[[Flight], None]:
    """Do something at the first tick at which something is so."""
    done: list[Flight] = []

    def beat(flight: Flight) -> None:
        if flight not in done and flight.bridge is not None and when(flight):
            done.append(flight)
            do(flight)

    return beat


def in_phase(phase: Phase, step: int, seconds: float = 0.0) -> Callable[[Flight], bool]:
    """Whether it is in a phase of a step, for some time already."""
    since: list[float] = []

    def is_so(flight: Flight) -> bool:
        if flight.bridge is None or (flight.bridge.phase, flight.bridge.step) != (phase, step):
            return False
        since.append(flight.vehicle.now_s)
        return flight.vehicle.now_s - since[0] >= seconds

    return is_so


def setting(**attributes: object) -> Callable[[Flight], None]:
    """Sets attributes of the vehicle."""

    def do(flight: Flight) -> None:
        for name, value in attributes.items():
            setattr(flight.vehicle, name, value)

    return do


def all_of(*beats: Callable[[Flight], None]) -> Callable[[Flight], None]:
    """Several beats, one after the other."""

    def beat(flight: Flight) -> None:
        for one in beats:
            one(flight)

    return beat


def frozen_for(seconds: float, step: int) -> Callable[[Flight], None]:
    """Its position does not come for a while, on its way from a step's cell."""
    return all_of(
        once(in_phase(Phase.MOVING, step, 2.0), setting(frozen=True)),
        once(in_phase(Phase.MOVING, step, 2.0 + seconds), setting(frozen=False)),
    )


def disarmed_on_ground(flight: Flight) -> None:
    """A pilot disarms it before it leaves the ground."""
    if flight.bridge is not None and flight.bridge.phase is Phase.TAKEOFF:
        flight.vehicle.armed = False


FAULTS: dict[str, tuple[Callable[[Flight], None], Phase]] = {  # what happens, and how the mission ends
    "none": (lambda _: None, Phase.LANDED),
    "hold": (frozen_for(2.0, 2), Phase.LANDED),
    "frozen": (frozen_for(60.0, 2), Phase.ABORTED),
    "pilot": (
        once(in_phase(Phase.MOVING, 3, 3.0), setting(mode=Mode.OTHER)),
        Phase.ABORTED,
    ),
    "restart": (once(in_phase(Phase.MOVING, 3, 3.0), Flight.kill_bridge), Phase.LANDED),
    "battery": (once(in_phase(Phase.MOVING, 3, 3.0), setting(battery=0.18)), Phase.ABORTED),
    "ground": (disarmed_on_ground, Phase.ABORTED),
}


def at_random(seed: int) -> Callable[[Flight], None]:
    """One to three faults, each at any moment of a flight, the bridge's death among them."""
    rng = np.random.default_rng(seed)
    faults = (
        Flight.kill_bridge,
        setting(frozen=True), setting(frozen=False), setting(silent=True), setting(silent=False),
        setting(estimate_ok=False), setting(estimate_ok=True), setting(battery=0.1),
        setting(mode=Mode.OTHER), setting(armed=False), setting(offset=(300.0, 0.0, 0.0)),
    )  # fmt: skip
    beats = []
    for _ in range(int(rng.integers(1, 4))):
        when_s, fault = float(rng.random() * 150.0), faults[int(rng.integers(len(faults)))]
        beats.append(once(lambda flight, when_s=when_s: flight.vehicle.now_s >= when_s, fault))  # type: ignore[misc]
    return all_of(*beats)


def bag(folder: Path, scenario: Scenario, fault: str = "none", **how: object) -> Path:
    """A bag of a flight with a fault."""
    flight = Flight(scenario, beat=FAULTS[fault][0], **how)  # type: ignore[arg-type]
    return write(folder, flight.fly(), flown_about(scenario, flight.seed))


def flown_about(scenario: Scenario, seed: int = 0, **values: str) -> dict[str, str]:
    """What the recorder writes about it."""
    told = about(scenario, seed, vehicle="mavlink", missions="1", **values)
    del told["pace"]  # a real vehicle has its own
    return told


def phases(told: list[BagMessage]) -> list[tuple[int, Phase, str]]:
    """Step, phase and reason of each word of the vehicle."""
    found = [
        msgspec.json.decode(cdr.decode_string(message.data), type=messages.Mission)
        for message in told
        if message.topic == "/mission"
    ]
    return [(one.step, one.phase, one.reason) for one in found]
