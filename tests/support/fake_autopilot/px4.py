"""A vehicle like one with PX4, on PX4's topics: a process, as the uXRCE-DDS agent and what is behind it.

    fake_px4.py MESSAGES SPEED NAMESPACE

MESSAGES is a folder with px4_msgs in it (`px4_messages.py`); simulated time runs SPEED times faster than the
clock. It is a stand-in: no PX4 exists here. It prints events as lines of JSON, and reads commands from
standard input (`Px4.obey`).

Imitated, from PX4's sources: names of topics with the version of their definition; QoS; stamps of boot
time, and of the agent's clock once they agree; OFFBOARD only after a second of `offboard_control_mode` for
positions at more than 2 Hz, lost a second after it ended, then a return; commands for another system,
and answers; taking off by setpoint; landing and disarming. Not imitated: attitude, wind, noise, limits of
acceleration, what is not in fmu/. Unlike any real one, its time waits 2 s of ours at most for a
stream that was there lately: the machine that tests run on has other work to do.
"""

import json
import math
import sys
import threading
import time
from typing import Any

sys.path.insert(0, sys.argv[1])

import px4_msgs.msg as px4
import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from uav_dc_ros.nodes.ros import fastdds
from uav_dc_ros.nodes.ros.executor import DirectExecutor

State = px4.VehicleStatus
WALL_S, TICK_S = 0.01, 0.02
ACROSS_MPS, UP_MPS, DOWN_MPS = 20.0, 10.0, 10.0
GAP_S, PROOF_S, LOSS_S, DISARM_S = 0.5, 1.0, 1.0, 2.0
PATIENCE_S, AHEAD_S = 2.0, 0.4  # wall, simulated
STATUS_S, LEAP_S = 0.5, 3.0
AGENT_US = 1_700_000_000_000_000
HOME, SYSTEM, COPTER = (47.397742, 8.545594, 488.0), 1, 2
START = [3.0, -2.0, 0.5]  # NED: it has moved since its origin was set
SENT = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.BEST_EFFORT, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
HEARD = QoSProfile(depth=20, reliability=ReliabilityPolicy.BEST_EFFORT)


def emit(event: str, t_s: float, **more: Any) -> None:
    print(json.dumps({"event": event, "t_s": round(t_s, 3), **more}), flush=True)


def topic(name: str, kind: Any) -> str:
    """Written anew here: PX4's own rule must not come from what is tested against it."""
    text = getattr(kind, "MESSAGE_VERSION", None)
    return name if text in (None, 0) else f"{name}_v{text}"


class Px4:
    """Where it is, and what it does. NED metres."""

    def __init__(self, node: Any) -> None:
        self.t_s, self.owed_s, self.speed, self.ned = 0.0, 0.0, float(sys.argv[2]), list(START)
        self.mode, self.armed, self.landed, self.failsafe = State.NAVIGATION_STATE_POSCTL, False, True, False
        self.target: list[float] | None = None
        self.since_s, self.streamed_s, self.heard_wall_s = math.inf, -math.inf, -math.inf
        self.ground_s, self.status_s = 0.0, -math.inf
        self.frozen, self.refuses, self.lost, self.lost_s = False, False, False, math.inf
        self.told: Any = None
        self.last: Any = None
        self.out = {}
        for name, kind in (
            ("vehicle_status", px4.VehicleStatus),
            ("vehicle_local_position", px4.VehicleLocalPosition),
            ("vehicle_land_detected", px4.VehicleLandDetected),
            ("battery_status", px4.BatteryStatus),
            ("failsafe_flags", px4.FailsafeFlags),
            ("vehicle_command_ack", px4.VehicleCommandAck),
        ):
            self.out[name] = node.create_publisher(kind, topic(f"fmu/out/{name}", kind), SENT)
        for name, kind, take in (
            ("offboard_control_mode", px4.OffboardControlMode, self.on_heartbeat),
            ("trajectory_setpoint", px4.TrajectorySetpoint, self.on_setpoint),
            ("vehicle_command", px4.VehicleCommand, self.on_command),
        ):
            node.create_subscription(kind, topic(f"fmu/in/{name}", kind), take, HEARD)

    # What comes.

    @property
    def offboard(self) -> bool:
        """Is there a stream to be followed."""
        return self.t_s - self.streamed_s < LOSS_S and self.t_s - self.lost_s < LOSS_S

    def on_heartbeat(self, message: Any) -> None:
        asked = [name for name in message.get_fields_and_field_types() if getattr(message, name)]
        if asked != ["position"]:  # a stamp that is not 0 would be seen here, too
            emit("odd", self.t_s, heartbeat=asked)
            return
        if self.t_s - self.streamed_s > GAP_S:
            self.since_s = self.t_s
        self.streamed_s, self.heard_wall_s = self.t_s, time.monotonic()

    def on_setpoint(self, message: Any) -> None:
        unused = [*message.velocity, *message.acceleration, *message.jerk, message.yaw, message.yawspeed]
        ned = [float(value) for value in message.position]
        if message.timestamp or not all(map(math.isnan, unused)) or not all(map(math.isfinite, ned)):
            emit("odd", self.t_s, setpoint=str(message))
            return
        self.target = ned
        if ned != self.last:
            self.last = ned
            emit("setpoint", self.t_s, ned=ned)

    def on_command(self, message: Any) -> None:
        ours = message.target_system == SYSTEM and message.target_component in (0, 1)
        if not ours or message.timestamp or not message.from_external:
            emit("odd", self.t_s, command=str(message))
            return
        done = not self.refuses and self.do(message)
        emit("command", self.t_s, command=message.command, done=done)
        for component in (message.source_component, 190):  # another sender was rejected, too
            answer = px4.VehicleCommandAck(command=message.command, timestamp=self.stamp())
            answer.result = 0 if done and component == message.source_component else 1
            answer.target_system, answer.target_component = message.source_system, component
            self.out["vehicle_command_ack"].publish(answer)

    def do(self, message: Any) -> bool:
        match message.command:
            case px4.VehicleCommand.VEHICLE_CMD_COMPONENT_ARM_DISARM if message.param1 == 1.0:
                self.armed, self.ground_s = self.armed or not self.lost, self.t_s
                return self.armed
            case px4.VehicleCommand.VEHICLE_CMD_NAV_LAND:
                return self.switch(State.NAVIGATION_STATE_AUTO_LAND, "command")
            case px4.VehicleCommand.VEHICLE_CMD_NAV_RETURN_TO_LAUNCH:
                return self.switch(State.NAVIGATION_STATE_AUTO_RTL, "command")
            case px4.VehicleCommand.VEHICLE_CMD_DO_SET_MODE if message.param1 == 1.0:
                if (message.param2, message.param3) == (6.0, 0.0):
                    proven = self.offboard and self.t_s - self.since_s > PROOF_S
                    return proven and self.switch(State.NAVIGATION_STATE_OFFBOARD, "command")
        return False

    def switch(self, mode: int, why: str) -> bool:
        self.failsafe = why == "failsafe"
        if mode != self.mode:
            self.mode = mode
            emit("mode", self.t_s, mode=mode, why=why, ned=self.ned)
        return True

    def obey(self, line: str) -> None:
        """freeze 0|1, lose 1, refuse 0|1, speed TIMES, mode NAV_STATE (as a pilot)."""
        what, value = line.split()[0], float(line.split()[1])
        match what:
            case "freeze":
                self.frozen = bool(value)
            case "lose":
                self.lost, self.lost_s = True, self.t_s
            case "refuse":
                self.refuses = bool(value)
            case "speed":
                self.speed = value
            case "mode":
                self.switch(int(value), "pilot")
        emit("obeyed", self.t_s, line=line, streamed_wall_s=self.heard_wall_s)

    # What it does.

    def turn(self) -> None:
        """Let simulated time pass for one turn, then publish the state."""
        self.owed_s += WALL_S * self.speed
        while self.owed_s >= TICK_S:
            self.owed_s -= TICK_S
            late = self.t_s - self.streamed_s > AHEAD_S
            if not late or time.monotonic() - self.heard_wall_s >= PATIENCE_S:
                self.tick()
        self.publish()

    def tick(self) -> None:
        self.t_s += TICK_S
        if self.mode == State.NAVIGATION_STATE_OFFBOARD and self.armed and not self.offboard:
            blind = self.lost and State.NAVIGATION_STATE_DESCEND
            self.switch(blind or State.NAVIGATION_STATE_AUTO_RTL, "failsafe")
        if not self.armed:
            return
        if self.landed and self.mode == State.NAVIGATION_STATE_OFFBOARD and self.target is not None:
            self.landed = self.target[2] > self.ned[2] - 0.5
        if self.landed:
            if self.t_s - self.ground_s > (
                DISARM_S if self.mode != State.NAVIGATION_STATE_OFFBOARD else 10.0
            ):
                self.armed = False
                emit("disarmed", self.t_s, ned=self.ned)
            return
        self.fly(self.goal())

    def goal(self) -> list[float]:
        ground_m = START[2]
        if self.mode == State.NAVIGATION_STATE_OFFBOARD and self.target is not None:
            return self.target
        if self.mode in (State.NAVIGATION_STATE_AUTO_LAND, State.NAVIGATION_STATE_DESCEND):
            return [*self.ned[:2], ground_m]
        if self.mode == State.NAVIGATION_STATE_AUTO_RTL:
            home = math.dist(self.ned[:2], START[:2]) < 0.1
            return [*START[:2], ground_m if home else self.ned[2]]
        return self.ned  # a pilot holds it

    def fly(self, goal: list[float]) -> None:
        north, east, down = (g - n for g, n in zip(goal, self.ned, strict=True))
        across = math.hypot(north, east)
        share = min(1.0, ACROSS_MPS * TICK_S / across) if across else 0.0
        self.ned[0] += north * share
        self.ned[1] += east * share
        self.ned[2] += max(-UP_MPS * TICK_S, min(DOWN_MPS * TICK_S, down))
        if self.ned[2] >= START[2] and goal[2] >= START[2]:
            self.ned[2], self.landed, self.ground_s = START[2], True, self.t_s
            emit("landed", self.t_s, ned=self.ned)

    # Out.

    def stamp(self) -> int:
        return round(self.t_s * 1e6) + (AGENT_US if self.t_s > LEAP_S else 0)

    def publish(self) -> None:
        stamp = self.stamp()
        if not self.frozen:
            where = px4.VehicleLocalPosition(timestamp=stamp, timestamp_sample=stamp)
            where.x, where.y, where.z = self.ned
            where.xy_valid = where.v_xy_valid = not self.lost
            where.z_valid = where.v_z_valid = where.xy_global = where.z_global = True
            where.ref_lat, where.ref_lon, where.ref_alt = HOME
            self.out["vehicle_local_position"].publish(where)
        now = (self.mode, self.armed, self.landed, self.failsafe)
        if now == self.told and self.t_s - self.status_s < STATUS_S:
            return
        self.told, self.status_s = now, self.t_s
        state = px4.VehicleStatus(timestamp=stamp, nav_state=self.mode, failsafe=self.failsafe)
        state.arming_state = State.ARMING_STATE_ARMED if self.armed else State.ARMING_STATE_DISARMED
        state.system_id, state.component_id, state.system_type = SYSTEM, 1, COPTER
        state.pre_flight_checks_pass = not self.lost
        self.out["vehicle_status"].publish(state)
        self.out["vehicle_land_detected"].publish(
            px4.VehicleLandDetected(timestamp=stamp, landed=self.landed)
        )
        battery = px4.BatteryStatus(timestamp=stamp, id=1, connected=True, remaining=0.9)
        self.out["battery_status"].publish(battery)
        flags = px4.FailsafeFlags(timestamp=stamp, offboard_control_signal_lost=not self.offboard)
        self.out["failsafe_flags"].publish(flags)


def main() -> None:
    fastdds.select_transports()
    rclpy.init(args=[])
    node = rclpy.create_node("fake_px4", namespace=sys.argv[3])
    vehicle = Px4(node)
    executor = DirectExecutor()
    executor.add_node(node)
    lines: list[str] = []
    closed = threading.Event()

    def listen() -> None:
        for line in sys.stdin:
            lines.append(line)
        closed.set()

    threading.Thread(target=listen, daemon=True).start()
    emit("there", 0.0)
    due_s = time.monotonic()
    while not closed.is_set():
        executor.spin_once(max(0.0, due_s - time.monotonic()))
        while lines:
            vehicle.obey(lines.pop(0))
        if time.monotonic() >= due_s:
            vehicle.turn()
            due_s = max(due_s + WALL_S, time.monotonic() - WALL_S)
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
