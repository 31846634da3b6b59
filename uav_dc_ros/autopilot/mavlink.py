"""MAVLink with an autopilot: hears what it tells, passes wishes on, streams setpoints. It decides nothing.

A thread of its own reads and writes, before all others where the system allows that, so that the stream keeps
its pace. (Who holds Python's lock holds it up: the rest of the process should run when it is due, too.)
It is a sign of life of those who decide all the same: heartbeats and setpoints end `LIFE_S` after the last
call of `steer`, and then the autopilot's own failsafes take over, as they do when the process is gone.
"""

import contextlib
import dataclasses
import importlib
import math
import os
import select
import threading
import time
from collections import deque
from typing import Any, Self

from uav_dc_ros.autopilot.beat import LIFE_S, STREAM_S, STREAM_VEHICLE_S, Heartbeat, following
from uav_dc_ros.autopilot.frames import Enu, Geodetic
from uav_dc_ros.autopilot.hearing import ACCEPTED, HELPFUL_HZ, IN_PROGRESS, ONCE, Hearing
from uav_dc_ros.autopilot.links import Address, Link, LinkDown, load_serial
from uav_dc_ros.autopilot.priority import run_when_due
from uav_dc_ros.autopilot.systems import AUTOPILOT, COMPONENT, SYSTEM
from uav_dc_ros.autopilot.vehicle import Arm, Mode, SetMode, TakeOff, Telemetry, Wish
from uav_dc_ros.errors import VehicleError

ONBOARD_CONTROLLER, NO_AUTOPILOT, ACTIVE = 18, 8, 4  # MAV_TYPE, MAV_AUTOPILOT, MAV_STATE of this end
SET_MODE, ARM, TAKE_OFF, SET_INTERVAL, REQUEST = 176, 400, 22, 511, 512  # MAV_CMD
CUSTOM_MODE = 1.0  # MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
LOCAL_NED = 1  # MAV_FRAME; the one that ArduPilot and PX4 both take
POSITION_ONLY = 0xDF8  # POSITION_TARGET_TYPEMASK: ignore velocity, acceleration, yaw and its rate

ASK_S = 0.5  # between looks for messages and parameters that do not come
ASK_AGAIN_S, ASK_AGAIN_HELPFUL_S = 3.0, 10.0  # for a message that does not come; that nobody needs
OPEN_AGAIN_S = 0.5
SILENCE_S = 10.0  # after which a link that says nothing is opened anew

ORIGIN = Enu(0.0, 0.0, 0.0)
NAMES = {SET_MODE: "the change of mode", ARM: "arming", TAKE_OFF: "taking off"}  # as in "arming refused"


def load_codec() -> Any:
    """pymavlink's messages of ArduPilot's dialect, which has all of the common ones.

    Raises:
        VehicleError: pymavlink is not installed.
    """
    try:
        return importlib.import_module("pymavlink.dialects.v20.ardupilotmega")
    except ImportError:
        raise VehicleError(
            "a vehicle on MAVLink needs pymavlink; expected it installed: pip install 'uav_dc_ros[mavlink]'"
        ) from None


class Mavlink:
    """One vehicle on one link, from `with Mavlink(...) as vehicle` to the end of the block.

    Args:
        address: such as `tcp:127.0.0.1:5760`.
        datum: of the grid. None: the vehicle stands at `place` when its first position comes.
        place: in the grid's ENU frame, see `datum`.
        anchor: of the same transport before it was started again: takes the place of a datum.
        system: whom to talk to; None: to the only autopilot on the link.

    Raises:
        VehicleError: the address is none, or a package is missing.
    """

    def __init__(
        self,
        address: str,
        *,
        datum: Geodetic | None = None,
        place: Enu = ORIGIN,
        anchor: str = "",
        system: int | None = None,
    ) -> None:
        if anchor:
            datum = Geodetic.parse(anchor)
        self.address = Address.parse(address)
        self._codec = load_codec()
        if self.address.kind == "serial":
            load_serial(self.address)
        self._mav = self._codec.MAVLink(None, SYSTEM, COMPONENT)
        self._mav.robust_parsing = True  # skips bytes that are no message
        self._hearing = Hearing(datum, place, system, again=bool(anchor))
        self._lock = threading.Lock()  # of all below, and of `_hearing`
        self._setpoint: Enu | None = None
        self._alive_s = -math.inf  # last sign of life of those who decide
        self._wishes: deque[Wish] = deque()
        self._down: str | None = f"{self.address} is not open yet"
        self._failed: VehicleError | None = None
        self._link: Link | None = None
        self._met_s = math.inf  # when the link that is open was opened; wishes wait until it was heard on it
        self._asked_s: dict[str, float] = {}
        self._heartbeat = Heartbeat()
        self._wake_out, self._wake_in = os.pipe()
        os.set_blocking(self._wake_in, False)
        os.set_blocking(self._wake_out, False)
        self._ended = self._closed = False
        self._thread = threading.Thread(target=self._run, name="mavlink", daemon=True)

    def __enter__(self) -> Self:
        """Begin to listen."""
        self.open()
        return self

    def __exit__(self, *exception: object) -> None:
        """End the stream, and the link."""
        self.close()

    def open(self) -> None:
        """Begin to listen, and to send heartbeats: who opens it is alive."""
        self._alive_s = time.monotonic()
        self._thread.start()

    def close(self) -> None:
        """End the stream, and the link; more than once is as good as once."""
        if self._closed:
            return
        self._closed = self._ended = True
        self._wake()
        if self._thread.is_alive():
            self._thread.join()
        os.close(self._wake_in)
        os.close(self._wake_out)

    @property
    def anchor(self) -> str:
        """The grid's datum, as `Geodetic.parse` reads it; empty until it is known."""
        return str(self.datum or "")

    @property
    def datum(self) -> Geodetic | None:
        """Where on the Earth the grid's corner lies; None: not known."""
        with self._lock:
            return self._hearing.datum

    @property
    def kind(self) -> str:
        """Name of the autopilot; empty until it has spoken."""
        with self._lock:
            return self._hearing.dialect.name if self._hearing.dialect else ""

    def telemetry(self) -> Telemetry:
        """What is known of the vehicle now, times as of `time.monotonic`.

        Raises:
            VehicleError: this machine cannot open the link at all.
        """
        if self._failed is not None:
            raise self._failed
        with self._lock:
            known = self._hearing.telemetry(time.monotonic())
            if self._down is not None and known.missing is not None:
                known = dataclasses.replace(known, missing=self._down)
            return known

    def steer(self, setpoint: Enu | None) -> None:
        """Stream a setpoint, in the grid's ENU frame, from now on; or none. To be called at least at 2 Hz."""
        with self._lock:
            now_s = time.monotonic()
            news = setpoint != self._setpoint or now_s - self._alive_s > LIFE_S
            self._setpoint, self._alive_s = setpoint, now_s
        if news:
            self._wake()

    def ask(self, wish: Wish) -> None:
        """Pass a wish on, once; whether it was fulfilled, `telemetry` tells."""
        with self._lock:
            self._wishes.append(wish)
        self._wake()

    # The thread.

    def _wake(self) -> None:
        with contextlib.suppress(BlockingIOError):
            os.write(self._wake_in, b"\0")

    def _run(self) -> None:
        run_when_due()
        ask_s = stream_s = time.monotonic()
        streamed_vehicle_s, streamed, opened_s = 0.0, None, -math.inf
        heard_s = 0.0
        while not self._ended:
            now_s = time.monotonic()
            if self._link is None:
                if now_s - opened_s >= OPEN_AGAIN_S:
                    opened_s = heard_s = now_s
                    self._open()
                    now_s = stream_s = time.monotonic()
                if self._link is None:
                    self._pause(OPEN_AGAIN_S)
                    continue
            try:
                self._pause(max(0.0, stream_s - now_s), self._link)
                data = self._link.read()
                now_s = time.monotonic()
                heard_s = now_s if data else heard_s
                if now_s - heard_s > SILENCE_S:
                    raise LinkDown(f"{self.address} says nothing for {SILENCE_S:g} s")
                with self._lock:
                    for message in self._mav.parse_buffer(data) or () if data else ():
                        self._take(message, now_s)
                    vehicle_s, setpoint = self._hearing.vehicle_s, self._setpoint
                    alive = now_s - self._alive_s <= LIFE_S
                    wishes = list(self._wishes)
                    self._wishes.clear()
                if alive and self._heartbeat.is_due(now_s, vehicle_s):
                    self._send_heartbeat(now_s, vehicle_s)
                if now_s >= ask_s or self._hearing.wanted().keys() - self._asked_s.keys():
                    ask_s = following(ask_s, ASK_S, now_s)
                    self._ask_for_messages(now_s)
                for wish in wishes:
                    self._send_wish(wish)
                due = now_s >= stream_s or setpoint != streamed
                if due or vehicle_s - streamed_vehicle_s >= STREAM_VEHICLE_S:
                    stream_s = following(stream_s, STREAM_S, now_s) if now_s >= stream_s else stream_s
                    streamed_vehicle_s, streamed = vehicle_s, setpoint
                    if alive and setpoint is not None:
                        self._send_setpoint(setpoint, vehicle_s)
            except LinkDown as error:
                self._drop(str(error))
        self._drop("closed")

    def _pause(self, seconds: float, link: Link | None = None) -> None:
        """Wait for something to do, or a time."""
        files: list[Any] = [self._wake_out] if link is None else [self._wake_out, link]
        ready, _, _ = select.select(files, [], [], seconds)
        if self._wake_out in ready:
            os.read(self._wake_out, 4096)

    def _open(self) -> None:
        try:
            link = self.address.open()
        except LinkDown as error:
            self._drop(str(error))
        except VehicleError as error:
            self._failed, self._ended = error, True
        else:
            with self._lock:
                self._link, self._down, self._met_s = link, None, time.monotonic()
                self._wishes.clear()  # uttered to a vehicle that may be another's by now
                self._asked_s.clear()
                self._heartbeat.begin()

    def _drop(self, why: str) -> None:
        if self._link is not None:
            self._link.close()
        with self._lock:
            self._link, self._down = None, why

    # Hearing and sending.

    def _take(self, message: Any, now_s: float) -> None:
        if not self._hearing.hear(message, now_s) or message.get_type() != "COMMAND_ACK":
            return
        if (message.target_system or SYSTEM) != SYSTEM or (
            message.target_component or COMPONENT
        ) != COMPONENT:
            return  # the answer to somebody else
        self._hearing.rivals.answer(message.command, self._hearing.vehicle_s)
        name = NAMES.get(message.command)
        if name is None or message.result == IN_PROGRESS:
            return
        if message.result == ACCEPTED:
            self._hearing.granted(name)
        else:
            results = self._codec.enums["MAV_RESULT"]
            result = results[message.result].name if message.result in results else str(message.result)
            self._hearing.refused(name, result.removeprefix("MAV_RESULT_").lower().replace("_", " "), now_s)

    def _write(self, message: Any) -> bool:
        """Send a message; was there anybody to send it to."""
        if self._link is None or not self._link.write(message.pack(self._mav)):
            return False
        self._mav.seq = (self._mav.seq + 1) % 256
        return True

    def _send_heartbeat(self, now_s: float, vehicle_s: float) -> None:
        number = self._mav.seq
        if self._write(self._mav.heartbeat_encode(ONBOARD_CONTROLLER, NO_AUTOPILOT, 0, 0, ACTIVE)):
            self._heartbeat.sent(now_s, vehicle_s)
            self._hearing.rivals.sent_heartbeat(number)

    def _ask_for_messages(self, now_s: float) -> None:
        """Ask for messages that do not come: on a new link, or started anew, a vehicle sends none unasked."""
        with self._lock:
            heard, wanted = dict(self._hearing.heard), self._hearing.wanted()
            parameters = self._hearing.unanswered(now_s)
        for parameter in parameters:
            what = parameter.encode(), -1  # by name
            self._write(self._mav.param_request_read_encode(self._hearing.system, AUTOPILOT, *what))
        for name, rate_hz in wanted.items():
            again_s = ASK_AGAIN_HELPFUL_S if name in HELPFUL_HZ else ASK_AGAIN_S
            last_s = max(heard.get(name, -math.inf), self._asked_s.get(name, -math.inf))
            if now_s - last_s >= again_s or name not in self._asked_s:
                self._asked_s[name] = now_s
                number = getattr(self._codec, f"MAVLINK_MSG_ID_{name}")
                self._send_command(SET_INTERVAL, float(number), 1e6 / rate_hz)
                if name in ONCE:
                    self._send_command(REQUEST, float(number))

    def _send_command(self, command: int, *parameters: float) -> None:
        filled = [*parameters, *([0.0] * (7 - len(parameters)))]
        self._hearing.rivals.sent_command(command, self._hearing.vehicle_s)
        self._write(self._mav.command_long_encode(self._hearing.system, AUTOPILOT, command, 0, *filled))

    def _send_wish(self, wish: Wish) -> None:
        with self._lock:
            dialect, known = self._hearing.dialect, self._hearing.telemetry(time.monotonic())
        if dialect is None or (known.heartbeat_s or -math.inf) < self._met_s:
            return  # who knows what it does by now; a link may also keep things to deliver them late
        match wish:
            case SetMode(mode):
                self._send_command(SET_MODE, CUSTOM_MODE, *dialect.mode_parameters(Mode(mode)))
            case Arm():
                self._send_command(ARM, 1.0)
            case TakeOff(altitude_m) if not dialect.climbs_by_setpoint and known.position is not None:
                climb_m = altitude_m - known.position.up_m  # above home, which is where it stands
                self._send_command(TAKE_OFF, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, climb_m)

    def _send_setpoint(self, setpoint: Enu, vehicle_s: float) -> None:
        hearing = self._hearing
        if (
            hearing.dialect is None
            or hearing.frame is None
            or not hearing.dialect.may_steer(hearing.landed_state)
        ):
            return
        ned = hearing.frame.to_autopilot(setpoint)
        hearing.rivals.sent_setpoint(ned)
        self._write(
            self._mav.set_position_target_local_ned_encode(
                *(int(vehicle_s * 1e3) & 0xFFFFFFFF, hearing.system, AUTOPILOT, LOCAL_NED, POSITION_ONLY),
                *(*ned, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
            )
        )
