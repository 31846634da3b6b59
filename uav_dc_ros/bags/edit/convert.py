"""The verb `convert`: a bag with other compression or files, payloads as JSON, or of SQLite storage."""

import argparse
from dataclasses import replace
from pathlib import Path

from uav_dc_ros.bags.edit.copy import add_output, copying, output
from uav_dc_ros.bags.read import BagReader

EPILOG = """\
With --json-channels, the payloads of users, rates, mission and move are channels of encoding `json`, with
JSON Schemas: Foxglove and PlotJuggler plot their fields, such as /rates.sum_rate_bps. The commands of this
package read them as before; ROS 2 and rosbags do not read such bags. A conversion without the option makes
std_msgs/msg/String of them again, byte for byte.
"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    parser.epilog, parser.formatter_class = EPILOG, argparse.RawDescriptionHelpFormatter
    bag = "folder of a bag, or one of its files (MCAP or SQLite)"
    parser.add_argument("bag", type=Path, metavar="BAG", help=bag)
    json = "payloads as channels that viewers plot by field"
    parser.add_argument("--json-channels", action="store_true", help=json)
    add_output(parser)


def run(options: argparse.Namespace) -> int:
    """Write the new bag; the exit status."""
    to = replace(output(options), json_channels=options.json_channels)
    with (
        BagReader(options.bag, repeats=False) as reader,
        copying([reader], to, made_by="bag convert") as copy,
    ):
        copy.hold(reader.held())
        copy.write(reader.recorded())
    return 0
