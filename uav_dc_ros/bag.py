"""Record, play, recover, verify and explain bags.

python -m uav_dc_ros.bag VERB --help
"""

import importlib
import sys
from typing import NoReturn

from uav_dc_ros import cli

PROG = "python -m uav_dc_ros.bag"
DESCRIPTION = "Record, play, recover, verify and explain bags."
# Module and description by verb; the module has `add_options(parser)` and `run(options) -> exit status`.
VERBS = {
    "record": ("nodes.record.bag_record", "record topics into a new bag"),
    "mark": ("nodes.record.bag_mark", "put an annotation into a recording that runs"),
    "play": ("nodes.play.bag_play", "publish a bag's messages again, with their timing and QoS"),
    "info": ("recordings.info.command", "show what a bag holds, and whether it is complete"),
    "cut": ("recordings.cut", "copy a time, missions or steps of a bag into a new one"),
    "merge": ("bags.edit.merge", "make one bag of several"),
    "filter": ("bags.edit.filter", "copy some topics of a bag into a new one"),
    "convert": ("bags.edit.convert", "copy a bag with other compression or files, or with JSON channels"),
    "recover": ("bags.salvage.recover", "make a whole bag of what a killed recorder left"),
    "verify": ("recordings.verify.command", "recompute everything that a bag holds of its missions"),
    "report": ("recordings.report", "write a page about missions, or compare several bags"),
    "index": ("recordings.index", "make one table of the missions in many bags"),
    "log": ("recordings.flight_log.command", "align an autopilot's log with the bag of its flight"),
    "video": ("experiments.video", "draw a mission of a bag as GIF or MP4"),
    "export": ("recordings.export.command", "write missions as tables, or as transitions to learn from"),
}


def main(arguments: list[str] | None = None) -> NoReturn:
    """Run the command, and exit."""
    given = sys.argv[1:] if arguments is None else arguments
    verb = given[0] if given else "--help"

    def command() -> int:
        if verb not in VERBS:
            return cli.without_verb(verb, VERBS, PROG, DESCRIPTION)
        name, description = VERBS[verb]
        module = importlib.import_module(f"uav_dc_ros.{name}")
        sentence = f"{description[0].upper()}{description[1:]}."
        parser = cli.Parser(prog=f"{PROG} {verb}", description=sentence)
        module.add_options(parser)
        return int(module.run(parser.parse_args(given[1:])))

    cli.run(command, f"{PROG} {verb}" if verb in VERBS else PROG)


if __name__ == "__main__":
    main()
