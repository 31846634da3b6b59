"""MAVLink with an autopilot: a link, and a thread that reads and writes, as `session` says.

The thread runs before all others where the system allows that, so that the stream keeps its pace. (Who holds
Python's lock holds it up: the rest of the process should run when it is due, too.)
"""

import contextlib
import dataclasses
import importlib
import math
import os
import select
import threading
import time
from typing import Any, Self

from uav_dc_ros.errors import VehicleError
from uav_dc_ros.offboard.frames import Enu, Geodetic
from uav_dc_ros.offboard.mavlink.connection import Address, Connection, ConnectionLost, load_serial
from uav_dc_ros.offboard.mavlink.session import Session
from uav_dc_ros.offboard.mavlink.telemetry import MavlinkTelemetry
from uav_dc_ros.offboard.realtime import use_realtime_priority
from uav_dc_ros.offboard.vehicle import Command, Telemetry

OPEN_AGAIN_S = 0.5
SILENCE_S = 10.0  # after which a link that says nothing is opened anew

ORIGIN = Enu(0.0, 0.0, 0.0)


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


class MavlinkVehicle:
    """One vehicle on one link, from `with Mavlink(...) as vehicle` to the end of the block.

    Args:
        address: such as `tcp:127.0.0.1:5760`.
        datum: of the grid. None: the vehicle stands at `place` when its first position comes.
        place: in the grid's ENU frame, see `datum`.
        grid_origin: of the same transport before it was started again: takes the place of a datum.
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
        grid_origin: str = "",
        system: int | None = None,
    ) -> None:
        if grid_origin:
            datum = Geodetic.parse(grid_origin)
        self.address = Address.parse(address)
        codec = load_codec()
        if self.address.kind == "serial":
            load_serial(self.address)
        self._hearing = MavlinkTelemetry(datum, place, system, again=bool(grid_origin))
        self._session = Session(codec, self._hearing, self._write)
        self._lock = threading.Lock()  # of both
        self._down: str | None = f"{self.address} is not open yet"
        self._failed: VehicleError | None = None
        self._link: Connection | None = None
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
        self._session.live(time.monotonic())
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
    def grid_origin(self) -> str:
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

    def set_setpoint(self, setpoint: Enu | None) -> None:
        """Stream a setpoint, in the grid's ENU frame, from now on; or none. To be called at least at 2 Hz."""
        with self._lock:
            news = self._session.set_setpoint(setpoint, time.monotonic())
        if news:
            self._wake()

    def send_command(self, command: Command) -> None:
        """Pass a command on, once; whether it was fulfilled, `telemetry` tells."""
        with self._lock:
            self._session.queue_command(command)
        self._wake()

    # The thread.

    def _wake(self) -> None:
        with contextlib.suppress(BlockingIOError):
            os.write(self._wake_in, b"\0")

    def _run(self) -> None:
        use_realtime_priority()
        opened_s = heard_s = -math.inf
        while not self._ended:
            now_s = time.monotonic()
            if self._link is None:
                if now_s - opened_s >= OPEN_AGAIN_S:
                    opened_s = now_s
                    self._open()
                    heard_s = now_s = time.monotonic()
                if self._link is None:
                    self._pause(OPEN_AGAIN_S)
                    continue
            try:
                self._pause(max(0.0, self._session.stream_s - now_s), self._link)
                data = self._link.read()
                now_s = time.monotonic()
                heard_s = now_s if data else heard_s
                if now_s - heard_s > SILENCE_S:
                    raise ConnectionLost(f"{self.address} says nothing for {SILENCE_S:g} s")
                with self._lock:
                    if self._session.receive(data, now_s):
                        self._link.answer_here()
                    self._session.send(now_s)
            except ConnectionLost as error:
                self._drop(str(error))
        self._drop("closed")

    def _write(self, data: bytes) -> bool:
        return self._link is not None and self._link.write(data)

    def _pause(self, seconds: float, link: Connection | None = None) -> None:
        """Wait for something to do, or a time."""
        files: list[Any] = [self._wake_out] if link is None else [self._wake_out, link]
        ready, _, _ = select.select(files, [], [], seconds)
        if self._wake_out in ready:
            os.read(self._wake_out, 4096)

    def _open(self) -> None:
        try:
            link = self.address.open()
        except ConnectionLost as error:
            self._drop(str(error))
        except VehicleError as error:
            self._failed, self._ended = error, True
        else:
            with self._lock:
                self._link, self._down = link, None
                self._session.begin(time.monotonic())

    def _drop(self, why: str) -> None:
        if self._link is not None:
            self._link.close()
        with self._lock:
            self._link, self._down = None, why
