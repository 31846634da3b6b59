"""Align an autopilot's log with the bag of its flight: when, how exactly, and what happened."""

import argparse
from pathlib import Path

from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.messages import printable
from uav_dc_ros.recordings import step_reader
from uav_dc_ros.recordings.export.tables import check_new, write_table
from uav_dc_ros.recordings.flight_log import aligned
from uav_dc_ros.recordings.flight_log.aligned import AlignedLog

OFFSET = "--offset"
EVENTS_MAX = 200
EPILOG = """\
The log is shifted in time until its path explains most of the recorded one; the paths may have different
origins, but the same axes (east, north, up). Where the log has GPS time, its difference from the bag's clock
is printed, too. The verb `report` shows the same log with --log.
"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    parser.epilog, parser.formatter_class = EPILOG, argparse.RawDescriptionHelpFormatter
    add = parser.add_argument
    add("bag", type=Path, metavar="BAG", help="folder of a bag, or one of its files")
    add("log", type=Path, metavar="LOG", help=aligned.LOG_HELP)
    out = "write the log's path, battery and modes into a new table, .parquet (needs pyarrow) or .csv"
    add("--out", type=Path, metavar="FILE", help=out)
    aligned.add_offset(parser, OFFSET)
    add("--namespace", metavar="NAME", help="of the mission, for a bag with several")


def run(options: argparse.Namespace) -> int:
    """Align; the exit status. Raises BagError if the paths do not match."""
    out: Path | None = options.out
    if out is not None:
        check_new(out, ".parquet", ".csv")
    with BagReader(options.bag) as reader:
        namespace = step_reader.namespace(reader, options.namespace)
        found = aligned.load(reader, namespace, options.log, options.offset, OFFSET)
    print("\n".join(_lines(options.bag, found)))
    if out is not None:
        write_table(out, aligned.COLUMNS, found.rows())
        print(f"{out}: {len(found.log.position_s)} rows")
    return 0


def _lines(bag: Path, found: AlignedLog) -> list[str]:
    fit, events = found.fit, found.events()
    lines = [
        f"{found.path}: {found.log.autopilot}, started at {fit.offset_s:.3f} s of bag {bag}",
        f"  paths differ by {fit.rms_m:.2f} m (rms) over {fit.overlap_s:.1f} s: {fit.explained:.2%} of "
        "the recorded path is explained",
    ]
    if (ahead_s := found.ahead_of_gps_s) is not None:
        side = "ahead of" if ahead_s >= 0 else "behind"
        lines.append(f"  the bag's clock is {abs(ahead_s):.3f} s {side} GPS")
    lines += [f"  {at_s:10.3f} s  {printable(text)}" for at_s, text in events[:EVENTS_MAX]]
    if more := events[EVENTS_MAX:]:
        lines.append(f"  and {len(more)} events more")
    return lines
