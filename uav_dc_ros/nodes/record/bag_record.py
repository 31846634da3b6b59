"""The verb `record`: records topics of any publisher into a bag, without a mission."""

import argparse
from collections.abc import Mapping
from pathlib import Path

import rclpy

from uav_dc_ros import __version__, cli
from uav_dc_ros.bags import COMPRESSIONS
from uav_dc_ros.nodes.framework import node_main
from uav_dc_ros.nodes.framework import parameters as p
from uav_dc_ros.nodes.record.recorder_base import RecorderBase
from uav_dc_ros.nodes.ros import environment

NODE = "bag_record"


class BagRecorder(RecorderBase):
    """Records until it is stopped; `values` are its parameters."""

    def __init__(self, values: Mapping[str, bool | int | float | str]) -> None:
        overrides = [rclpy.Parameter(name, value=value) for name, value in values.items()]
        super().__init__(NODE, [*overrides, rclpy.Parameter("peers", value=[NODE])])  # waits for no peer

    def about(self) -> Mapping[str, str]:
        """The version of this package."""
        return {"version": __version__}

    def activate(self) -> None:
        """Start recording, and log what is recorded."""
        super().activate()
        what = ", ".join(sorted(self.selected)) or f"everything in {self.get_namespace()}"
        self.get_logger().info(f"recording {what} into {self.values['bag']}; Ctrl-C ends it")

    def deactivate(self) -> None:
        """Close the bag, and log its size."""
        writer = self.writer
        super().deactivate()
        if writer is not None:
            self.get_logger().info(
                f"bag {writer.folder}: {writer.message_count} messages of {len(writer.topics)} topics, "
                f"in {writer.part_count} part{'s' * (writer.part_count != 1)}"
            )


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the verb."""
    size = cli.whole_number(0)
    add = parser.add_argument
    add("--out", type=Path, required=True, metavar="DIR", help="folder of the new bag")
    add("--resume", action="store_true", help="go on with the bag of a recorder that was killed")
    cli.add_namespace(parser, "whose topics to record (default: all of them)")
    add("--topics", default="", metavar="A,B", help=p.RECORDED_TOPICS.description)
    add("--split-bytes", type=size, default=0, metavar="N", help=p.SPLIT_BYTES.description)
    add("--split-s", type=float, default=0.0, metavar="S", help=p.SPLIT_S.description)
    add("--compression", choices=COMPRESSIONS, default="zstd", help=p.COMPRESSION.description)
    last = p.KEEP_LAST_S
    seconds = cli.number(0.0, last.max or 0.0, f"seconds, 0 to {last.max:g}")
    add("--keep-last", dest="keep_last_s", type=seconds, default=0.0, metavar="S", help=last.description)
    free = p.MIN_FREE_BYTES
    what = f"{free.description} (default: {free.default})"
    add("--min-free-bytes", type=size, default=free.default, metavar="N", help=what)


def run(options: argparse.Namespace) -> int:
    """Record until Ctrl-C or SIGTERM; exits the process, or raises ParameterError."""
    names = ("resume", "topics", "split_bytes", "compression", "min_free_bytes", "keep_last_s")
    values = {name: getattr(options, name) for name in names}
    values |= {"bag": str(options.out), "split_s": p.SPLIT_S.value(options.split_s)}
    environment.prepare(local_only=False)  # publishers may be on any host
    environment.select_shared_memory()
    remapped = ["--ros-args", "-r", f"__ns:={options.namespace}"]
    node_main.main(lambda: BagRecorder(values), arguments=remapped)
