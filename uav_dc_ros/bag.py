"""Record, play, recover, verify and explain bags.

python -m uav_dc_ros.bag VERB --help
"""

import importlib
import sys
from typing import NoReturn

from uav_dc_ros import __version__, cli
from uav_dc_ros.errors import ParameterError

PROG = "python -m uav_dc_ros.bag"
DESCRIPTION = "Record, play, recover, verify and explain bags."
# Module and description by verb; the module has `add_options(parser)` and `run(options) -> exit status`.
VERBS = {
    "record": ("uav_dc_ros.nodes.record.bag_record", "record topics into a new bag"),
    "play": ("uav_dc_ros.nodes.play.bag_play", "publish a bag's messages again, with their timing and QoS"),
    "info": ("uav_dc_ros.recordings.info.command", "show what a bag holds, and whether it is complete"),
    "recover": ("uav_dc_ros.bags.salvage.recover", "make a whole bag of what a killed recorder left"),
    "verify": (
        "uav_dc_ros.recordings.verify.command",
        "recompute everything that a bag holds of its missions",
    ),
    "report": ("uav_dc_ros.recordings.report", "write a page about missions, or compare several bags"),
    "export": (
        "uav_dc_ros.recordings.export.command",
        "write missions as tables, or as transitions to learn from",
    ),
}


def main(arguments: list[str] | None = None) -> NoReturn:
    """Run a verb, and exit with its status."""
    words = sys.argv[1:] if arguments is None else arguments
    verb = words[0] if words else "--help"

    def command() -> int:
        if verb == "--version":
            print(__version__)
            return 0
        if verb in ("-h", "--help"):
            print(_help())
            return 0
        if verb not in VERBS:
            raise ParameterError(f"{verb!r}; expected a verb: {', '.join(VERBS)}")
        module_name, does = VERBS[verb]
        module = importlib.import_module(module_name)
        parser = cli.Parser(prog=f"{PROG} {verb}", description=does[0].upper() + does[1:] + ".")
        module.add_options(parser)
        return int(module.run(parser.parse_args(words[1:])))

    cli.run(command, f"{PROG} {verb}" if verb in VERBS else PROG)


def _help() -> str:
    verbs = "\n".join(f"  {verb:<8} {does}" for verb, (_, does) in VERBS.items())
    return f"usage: {PROG} VERB ...\n\n{DESCRIPTION}\n\n{verbs}\n\n{PROG} VERB --help lists its options."


if __name__ == "__main__":
    main()
