"""A vehicle on MAVLink: a connection, and a thread that reads and writes.

The thread has real-time priority where the system allows it, so that setpoints keep their rate. (A holder of
Python's global lock delays it: the rest of the process should have that priority, too.)
"""

import contextlib
import math
import os
import select
import threading
import time
from collections.abc import Mapping, Sequence
from typing import Any, Self

from uav_dc_ros.errors import VehicleError
from uav_dc_ros.offboard.extras import load
from uav_dc_ros.offboard.frames import Enu, Geodetic
from uav_dc_ros.offboard.ground_station import StatusText
from uav_dc_ros.offboard.mavlink.connection import Address, Connection, ConnectionLost, load_serial
from uav_dc_ros.offboard.mavlink.fence_upload import FenceUpload
from uav_dc_ros.offboard.mavlink.session import Session
from uav_dc_ros.offboard.mavlink.telemetry import MavlinkTelemetry
from uav_dc_ros.offboard.setpoint_stream import use_realtime_priority
from uav_dc_ros.offboard.vehicle import Command, Telemetry

RECONNECT_S = 0.5
SILENCE_S = 10.0  # after which a silent connection is opened anew

ORIGIN = Enu(0.0, 0.0, 0.0)


def load_codec() -> Any:
    """pymavlink's messages of ArduPilot's dialect, which includes the common ones; raises VehicleError."""
    return load("pymavlink.dialects.v20.ardupilotmega", "a vehicle on MAVLink needs pymavlink")


class MavlinkVehicle:
    """One vehicle on one link, see `Vehicle`; usable as a context manager.

    Raises VehicleError if the address is invalid, or a package is missing.
    """

    def __init__(
        self,
        address: str,  # such as `tcp:127.0.0.1:5760`
        *,
        datum: Geodetic | None = None,  # None: the vehicle stands at `start` when its first position comes
        start: Enu = ORIGIN,  # in the grid's ENU frame
        datum_deg: tuple[float, float] | None = None,  # without `datum`: its latitude and longitude
        grid_origin: str = "",  # of an earlier process in the same flight; replaces all three
        system: int | None = None,  # MAVLink system of the vehicle; None: the only autopilot on the link
        fence: Sequence[Enu] = (),  # corners of a polygon to upload, in the grid's ENU frame; empty: none
    ) -> None:
        if grid_origin:
            datum = Geodetic.parse(grid_origin)
        self.address = Address.parse(address)
        codec = load_codec()
        if self.address.kind == "serial":
            load_serial(self.address)
        upload = FenceUpload(fence) if fence else None
        self._telemetry = MavlinkTelemetry(
            datum, start, system, again=bool(grid_origin), datum_deg=datum_deg, fence=upload
        )
        self._session = Session(codec, self._telemetry, self._write)
        self._lock = threading.Lock()  # of both
        self._down: str | None = f"{self.address} is not open yet"  # why there is no connection
        self._failure: VehicleError | None = None
        self._connection: Connection | None = None
        self._wake_out, self._wake_in = os.pipe()
        os.set_blocking(self._wake_in, False)
        os.set_blocking(self._wake_out, False)
        self._ended = self._closed = False
        self._thread = threading.Thread(target=self._run, name="mavlink", daemon=True)

    def __enter__(self) -> Self:
        """Open the vehicle."""
        self.open()
        return self

    def __exit__(self, *exception: object) -> None:
        """Close the vehicle."""
        self.close()

    def open(self) -> None:
        """Start to receive, and to send heartbeats."""
        self._session.keep_alive(time.monotonic())
        self._thread.start()

    def close(self) -> None:
        """End the stream, and close the connection; idempotent."""
        if self._closed:
            return
        self._closed = self._ended = True
        self._wake()
        if self._thread.is_alive():
            self._thread.join()
        os.close(self._wake_in)
        os.close(self._wake_out)

    def telemetry(self) -> Telemetry:
        """The vehicle's state now, see `Vehicle`."""
        if self._failure is not None:
            raise self._failure
        with self._lock:
            telemetry = self._telemetry.snapshot(time.monotonic())
            if self._down is not None and telemetry.missing is not None:
                telemetry = telemetry.replace(missing=self._down)
            return telemetry

    def set_setpoint(self, setpoint: Enu | None) -> None:
        """Stream a setpoint, in the grid's ENU frame, from now on; or none. To be called at 2 Hz or more."""
        with self._lock:
            due = self._session.set_setpoint(setpoint, time.monotonic())
        if due:
            self._wake()

    def send_command(self, command: Command) -> None:
        """Send a command once; `telemetry` reports its effect."""
        with self._lock:
            self._session.queue_command(command)
        self._wake()

    def report_text(self, text: StatusText) -> None:
        """Send a text to ground stations."""
        with self._lock:
            self._session.report_text(text)
        self._wake()

    def report_values(self, values: Mapping[str, float]) -> None:
        """Send values to ground stations from now on."""
        with self._lock:
            self._session.report_values(values)

    # The thread.

    def _wake(self) -> None:
        with contextlib.suppress(BlockingIOError):
            os.write(self._wake_in, b"\0")

    def _run(self) -> None:
        use_realtime_priority()
        opened_s = received_s = -math.inf
        while not self._ended:
            now_s = time.monotonic()
            if self._connection is None:
                if now_s - opened_s >= RECONNECT_S:
                    opened_s = now_s
                    self._connect()
                    received_s = now_s = time.monotonic()
                if self._connection is None:
                    self._wait(RECONNECT_S)
                    continue
            try:
                self._wait(max(0.0, self._session.next_setpoint_s - now_s), self._connection)
                data = self._connection.read()
                now_s = time.monotonic()
                received_s = now_s if data else received_s
                if now_s - received_s > SILENCE_S:
                    raise ConnectionLost(f"{self.address}: nothing received for {SILENCE_S:g} s")
                with self._lock:
                    if self._session.receive(data, now_s):
                        self._connection.reply_to_sender()
                    self._session.send(now_s)
            except ConnectionLost as error:
                self._disconnect(str(error))
        self._disconnect("closed")

    def _write(self, data: bytes) -> bool:
        return self._connection is not None and self._connection.write(data)

    def _wait(self, seconds: float, connection: Connection | None = None) -> None:
        """Wait for data, a wake-up, or a time."""
        files: list[Any] = [self._wake_out] if connection is None else [self._wake_out, connection]
        ready, _, _ = select.select(files, [], [], seconds)
        if self._wake_out in ready:
            os.read(self._wake_out, 4096)

    def _connect(self) -> None:
        try:
            connection = self.address.open()
        except ConnectionLost as error:
            self._disconnect(str(error))
        except VehicleError as error:
            self._failure, self._ended = error, True
        else:
            with self._lock:
                self._connection, self._down = connection, None
                self._session.on_connected(time.monotonic())

    def _disconnect(self, why: str) -> None:
        if self._connection is not None:
            self._connection.close()
        with self._lock:
            self._connection, self._down = None, why
