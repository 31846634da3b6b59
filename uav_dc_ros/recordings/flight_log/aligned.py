"""An autopilot's log in the time and the frame of the bag of its flight."""

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from uav_dc_ros import cli
from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.errors import BagError, MessageError
from uav_dc_ros.recordings import step_reader
from uav_dc_ros.recordings.export.tables import Columns
from uav_dc_ros.recordings.flight_log.align import Alignment, align
from uav_dc_ros.recordings.flight_log.read import FlightLog, read

MIN_EXPLAINED = 0.9  # of the path's variance: below it is another flight
LOG_HELP = "log of ArduPilot (.bin) or PX4 (.ulg); needs the extra `log`"
COLUMNS: Columns = {
    "time_s": "float",  # after the bag's first message
    "log_s": "float",  # since the autopilot started
    "x_m": "float",
    "y_m": "float",
    "altitude_m": "float",  # the autopilot's estimate, in the frame of the bag
    "deviation_m": "float",  # its distance from the recorded pose at that time
    "battery_v": "float",
    "battery_a": "float",
    "mode": "text",
}


@dataclass(frozen=True, kw_only=True)
class AlignedLog:
    """A log, and how it fits the recorded path."""

    path: Path
    log: FlightLog
    fit: Alignment  # of the bag's time and frame, and the log's
    times_s: Array  # publish times of the recorded poses, after the bag's first message, `[N]`
    path_m: Array  # recorded positions, `[N, 3]`
    begun_s: float  # time of the bag's first message, since 1970

    @property
    def ahead_of_gps_s(self) -> float | None:
        """How far the bag's clock is ahead of GPS; None where the log has no GPS time."""
        starts_utc_s = self.log.starts_utc_s
        return None if starts_utc_s is None else self.begun_s + self.fit.offset_s - starts_utc_s

    def events(self) -> list[tuple[float, str]]:
        """Time after the bag's first message, and text, of modes, messages and errors."""
        return [(at_s + self.fit.offset_s, text) for at_s, text in self.log.events]

    def rows(self) -> dict[str, list[Any]]:
        """The log's positions, with what holds there, as `COLUMNS`; None is unknown."""
        log_s = np.asarray(self.log.position_s)
        position_m = np.asarray(self.log.position_m) + self.fit.shift_m
        at_s = log_s + self.fit.offset_s
        recorded_m = np.stack([np.interp(at_s, self.times_s, column) for column in self.path_m.T], axis=-1)
        deviation_m = np.linalg.norm(position_m - recorded_m, axis=-1)
        outside = (at_s < self.times_s[0]) | (at_s > self.times_s[-1])
        modes = [
            (since, text.partition(" ")[2]) for since, text in self.log.events if text.startswith("mode ")
        ]
        index = np.searchsorted([since_s for since_s, _ in modes], log_s, side="right")
        battery = self.log.battery_at(log_s)
        columns = {"time_s": at_s, "log_s": log_s, "deviation_m": np.where(outside, np.nan, deviation_m)}
        columns |= dict(zip(("x_m", "y_m", "altitude_m"), position_m.T, strict=True))
        columns |= dict(zip(("battery_v", "battery_a"), battery.T, strict=True))
        known = {name: [None if np.isnan(one) else one for one in v.tolist()] for name, v in columns.items()}
        return known | {"mode": [modes[i - 1][1] if i else None for i in index.tolist()]}


def add_offset(parser: argparse.ArgumentParser, option: str) -> None:
    """The option, such as `--offset`, for a log that no search finds."""
    seconds = cli.number(-1e9, 1e9, "seconds from -1e9 to 1e9")
    what = "time of the bag at which the autopilot started, seconds, instead of a search"
    parser.add_argument(option, type=seconds, metavar="S", help=what)


def load(reader: BagReader, namespace: str, path: Path, offset_s: float | None, option: str) -> AlignedLog:
    """Read a log and align it with the poses of a namespace; `offset_s` replaces the search.

    Raises:
        BagError: the bag has no path, the log cannot be read, or their paths do not match; the error names
            `option`, which gives the offset.
    """
    times_s, path_m = _path(reader, namespace)
    log = read(path)
    fit = align(times_s, path_m, np.asarray(log.position_s), np.asarray(log.position_m), offset_s)
    if fit is None or (offset_s is None and fit.explained < MIN_EXPLAINED):
        how = "nothing" if fit is None else f"{fit.explained:.0%}"
        raise BagError(
            f"{path} explains {how} of the path in bag {reader.path}; expected the log of the same flight, "
            f"or {option} S"
        )
    return AlignedLog(
        path=path, log=log, fit=fit, times_s=times_s, path_m=path_m, begun_s=reader.first_ns / 1e9
    )


def _path(reader: BagReader, namespace: str) -> tuple[Array, Array]:
    """Publish times of the poses, seconds after the bag's first message, and positions `[N, 3]`."""
    topic = f"{namespace}/pose"
    poses: dict[int, Array] = {}
    for message in reader.messages([topic]) if topic in reader.topics else ():
        try:
            pose = step_reader.read_pose(message)
        except MessageError:
            continue
        poses[pose.publish_ns] = pose.position_m
    if len(poses) < 2:
        raise BagError(f"bag {reader.path}: {len(poses)} poses on {topic}; expected the path of a flight")
    ordered = sorted(poses)
    times_s = (np.asarray(ordered) - reader.first_ns) / 1e9
    return times_s, np.stack([poses[at_ns] for at_ns in ordered])
