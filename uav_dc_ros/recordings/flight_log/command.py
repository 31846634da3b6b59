"""Align an autopilot's log with the bag of its flight: when, how exactly, and what happened."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from uav_dc_ros import cli
from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.errors import BagError, MessageError
from uav_dc_ros.messages import printable
from uav_dc_ros.recordings import step_reader
from uav_dc_ros.recordings.export.tables import Columns, check_new, write_table
from uav_dc_ros.recordings.flight_log.align import Alignment, align
from uav_dc_ros.recordings.flight_log.read import FlightLog, read

MIN_EXPLAINED = 0.9  # of the path's variance: below it is another flight
EVENTS_MAX = 200
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
EPILOG = """\
The log is shifted in time until its path explains most of the recorded one; the paths may have different
origins, but the same axes (east, north, up). Where the log has GPS time, its difference from the bag's clock
is printed, too.
"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    parser.epilog, parser.formatter_class = EPILOG, argparse.RawDescriptionHelpFormatter
    add = parser.add_argument
    add("bag", type=Path, metavar="BAG", help="folder of a bag, or one of its files")
    add("log", type=Path, metavar="LOG", help="log of ArduPilot (.bin) or PX4 (.ulg); needs the extra `log`")
    out = "write the log's path, battery and modes into a new table, .parquet (needs pyarrow) or .csv"
    add("--out", type=Path, metavar="FILE", help=out)
    seconds = cli.number(-1e9, 1e9, "seconds from -1e9 to 1e9")
    what = "time of the bag at which the autopilot started, seconds, instead of a search"
    add("--offset", type=seconds, metavar="S", help=what)
    add("--namespace", metavar="NAME", help="of the mission, for a bag with several")


def run(options: argparse.Namespace) -> int:
    """Align; the exit status. Raises BagError if the paths do not match."""
    out: Path | None = options.out
    if out is not None:
        check_new(out, ".parquet", ".csv")
    with BagReader(options.bag) as reader:
        times_s, path_m = _path(reader, step_reader.namespace(reader, options.namespace))
        start_s = reader.first_ns / 1e9
    log = read(options.log)
    found = align(times_s, path_m, np.asarray(log.position_s), np.asarray(log.position_m), options.offset)
    if found is None or (options.offset is None and found.explained < MIN_EXPLAINED):
        how = "nothing" if found is None else f"{found.explained:.0%}"
        raise BagError(
            f"{options.log} explains {how} of the path in bag {options.bag}; expected the log of the same "
            "flight, or --offset S"
        )
    print("\n".join(_lines(options, log, found, start_s)))
    if out is not None:
        write_table(out, COLUMNS, _rows(log, found, times_s, path_m))
        print(f"{out}: {len(log.position_s)} rows")
    return 0


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


def _lines(options: argparse.Namespace, log: FlightLog, found: Alignment, start_s: float) -> list[str]:
    lines = [
        f"{options.log}: {log.autopilot}, started at {found.offset_s:.3f} s of bag {options.bag}",
        f"  paths differ by {found.rms_m:.2f} m (rms) over {found.overlap_s:.1f} s: {found.explained:.2%} of "
        "the recorded path is explained",
    ]
    if log.starts_utc_s is not None:
        ahead_s = start_s + found.offset_s - log.starts_utc_s
        lines.append(
            f"  the bag's clock is {abs(ahead_s):.3f} s {'ahead of' if ahead_s >= 0 else 'behind'} GPS"
        )
    lines += [
        f"  {at_s + found.offset_s:10.3f} s  {printable(text)}" for at_s, text in log.events[:EVENTS_MAX]
    ]
    if more := log.events[EVENTS_MAX:]:
        lines.append(f"  and {len(more)} events more")
    return lines


def _rows(log: FlightLog, found: Alignment, times_s: Array, path_m: Array) -> dict[str, list[Any]]:
    log_s, position_m = np.asarray(log.position_s), np.asarray(log.position_m) + found.shift_m
    at_s = log_s + found.offset_s
    recorded_m = np.stack([np.interp(at_s, times_s, column) for column in path_m.T], axis=-1)
    deviation_m = np.linalg.norm(position_m - recorded_m, axis=-1)
    outside = (at_s < times_s[0]) | (at_s > times_s[-1])
    modes = [(since_s, text.partition(" ")[2]) for since_s, text in log.events if text.startswith("mode ")]
    index = np.searchsorted([since_s for since_s, _ in modes], log_s, side="right")
    battery = log.battery_at(log_s)
    columns = {"time_s": at_s, "log_s": log_s, "deviation_m": np.where(outside, np.nan, deviation_m)}
    columns |= dict(zip(("x_m", "y_m", "altitude_m"), position_m.T, strict=True))
    columns |= dict(zip(("battery_v", "battery_a"), battery.T, strict=True))
    known = {
        name: [None if np.isnan(one) else one for one in column.tolist()] for name, column in columns.items()
    }
    return known | {"mode": [modes[i - 1][1] if i else None for i in index.tolist()]}
