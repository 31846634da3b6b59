"""Logs of autopilots: ArduPilot's .bin with pymavlink, PX4's .ulg with pyulog."""

import importlib
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.errors import BagError, ParameterError, UavDcError
from uav_dc_ros.messages import one_line

MISSING = 'is not installed; expected it from: pip install "uav_dc_ros[log]"'
GPS_EPOCH_S = 315_964_800  # of GPS weeks, in UTC since 1970
LEAP_S = 18  # GPS time is ahead of UTC, since 2017
WEEK_S = 604_800
PX4_MODES = {  # navigation states of VehicleStatus.msg
    0: "MANUAL",
    1: "ALTCTL",
    2: "POSCTL",
    3: "AUTO_MISSION",
    4: "AUTO_LOITER",
    5: "AUTO_RTL",
    10: "ACRO",
    12: "DESCEND",
    13: "TERMINATION",
    14: "OFFBOARD",
    15: "STAB",
    17: "AUTO_TAKEOFF",
    18: "AUTO_LAND",
}
FIX_3D = 3  # status of a GPS fix, of both autopilots


@dataclass(kw_only=True)
class FlightLog:
    """A log; its times are seconds since the autopilot started."""

    autopilot: str
    position_s: list[float] = field(default_factory=list)
    position_m: list[tuple[float, float, float]] = field(
        default_factory=list
    )  # east, north, up of its origin
    battery_s: list[float] = field(default_factory=list)
    battery: list[tuple[float, float]] = field(default_factory=list)  # volts, amperes
    utc: list[tuple[float, float]] = field(default_factory=list)  # time, and UTC by GPS, seconds since 1970
    events: list[tuple[float, str]] = field(default_factory=list)  # modes, messages, errors

    @property
    def starts_utc_s(self) -> float | None:
        """UTC when the autopilot started, by its GPS; None without a fix."""
        return float(np.median([utc_s - at_s for at_s, utc_s in self.utc])) if self.utc else None

    def battery_at(self, times_s: Array) -> Array:
        """Volts and amperes at times, `[N, 2]`; NaN without a battery."""
        if not self.battery:
            return np.full((len(times_s), 2), math.nan)
        values = np.asarray(self.battery).T
        return np.stack([np.interp(times_s, self.battery_s, column) for column in values], axis=-1)


def read(path: Path) -> FlightLog:
    """Read a log by its suffix; raises UavDcError if it cannot be read, or has no positions."""
    readers: dict[str, Callable[[Path], FlightLog]] = {".bin": _ardupilot, ".ulg": _px4}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise ParameterError(f"{path}: expected a log of ArduPilot (.bin) or PX4 (.ulg)")
    try:
        with path.open("rb") as file:
            if not file.read(1):
                raise BagError(f"{path} is empty; expected a log of ArduPilot (.bin) or PX4 (.ulg)")
        log = reader(path)
    except OSError as error:
        raise BagError(f"{path} cannot be read: {error.strerror or error}") from None
    except UavDcError:
        raise
    except Exception as error:  # of pymavlink, pyulog: damaged bytes
        raise BagError(
            f"{path} is damaged, or no log: {one_line(str(error) or type(error).__name__)}"
        ) from None
    if len(log.position_s) < 2:
        raise BagError(f"{path}: a log of {log.autopilot} without positions; expected some")
    return log


def _module(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        raise UavDcError(f"{name.partition('.')[0]} {MISSING}") from None


def _ardupilot(path: Path) -> FlightLog:
    log = FlightLog(autopilot="ArduPilot")
    names: dict[int, str] = _module("pymavlink.mavutil").mode_mapping_acm
    wanted = ["XKF1", "BAT", "GPS", "MODE", "MSG", "ERR"]
    with _module("pymavlink.DFReader").DFReader_binary(str(path)) as reader:
        for message in iter(lambda: reader.recv_match(type=wanted), None):
            at_s = message.TimeUS / 1e6
            match message.get_type():
                case "XKF1" if getattr(message, "C", 0) == 0:  # its first estimator
                    log.position_s.append(at_s)
                    log.position_m.append((message.PE, message.PN, -message.PD))
                case "BAT" if getattr(message, "Inst", getattr(message, "Instance", 0)) == 0:
                    log.battery_s.append(at_s)
                    log.battery.append((message.Volt, message.Curr))
                case "GPS" if message.Status >= FIX_3D:
                    log.utc.append((at_s, GPS_EPOCH_S + message.GWk * WEEK_S + message.GMS / 1e3 - LEAP_S))
                case "MODE":
                    number = int(message.ModeNum)
                    log.events.append((at_s, f"mode {names.get(number, number)}"))
                case "MSG":
                    log.events.append((at_s, one_line(message.Message)))
                case "ERR":
                    log.events.append((at_s, f"error: subsystem {message.Subsys}, code {message.ECode}"))
    return log


def _px4(path: Path) -> FlightLog:
    log = FlightLog(autopilot="PX4")
    gps = ("sensor_gps", "vehicle_gps_position")  # newer and older versions
    wanted = ["vehicle_local_position", "battery_status", "vehicle_status", *gps]
    with path.open("rb") as file:
        ulog = _module("pyulog").ULog(file, wanted)

    def rows(topic: str, *columns: str) -> Iterator[tuple[float, ...]]:
        for data in ulog.data_list:
            if data.name == topic and data.multi_id == 0 and all(name in data.data for name in columns):
                times_s = data.data["timestamp"] / 1e6
                yield from zip(times_s, *(data.data[name] for name in columns), strict=True)

    for at_s, north, east, down in rows("vehicle_local_position", "x", "y", "z"):
        log.position_s.append(float(at_s))
        log.position_m.append((float(east), float(north), -float(down)))
    for at_s, volts, amps in rows("battery_status", "voltage_v", "current_a"):
        log.battery_s.append(float(at_s))
        log.battery.append((float(volts), float(amps)))
    for topic in gps:
        for at_s, utc_us, fix in rows(topic, "time_utc_usec", "fix_type"):
            if fix >= FIX_3D and utc_us:
                log.utc.append((float(at_s), float(utc_us) / 1e6))
    last = None
    for at_s, state in rows("vehicle_status", "nav_state"):
        if state != last:
            log.events.append((float(at_s), f"mode {PX4_MODES.get(int(state), int(state))}"))
        last = state
    log.events += [(one.timestamp / 1e6, one_line(one.message)) for one in ulog.logged_messages]
    log.events.sort(key=itemgetter(0))
    return log
