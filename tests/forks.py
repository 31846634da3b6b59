"""Runs modules as `python -m` does, each in a fork of one process that has imported what they need.

For commands that end at once: importing would take most of their time. Reads lines of JSON, with the module,
its arguments, environment and folder, and the file for its output; answers each with the exit status.
"""

import json
import os
import runpy
import signal
import sys
import traceback
from typing import Any

import uav_dc_ros.bag
import uav_dc_ros.nodes.channel_monitor
import uav_dc_ros.nodes.container
import uav_dc_ros.nodes.play.bag_play
import uav_dc_ros.nodes.policy
import uav_dc_ros.nodes.record.bag_record
import uav_dc_ros.nodes.recorder
import uav_dc_ros.nodes.world
import uav_dc_ros.run_all
import uav_dc_ros.runner.mission_runner  # noqa: F401

LIMIT_S = 90


def run(order: dict[str, Any]) -> int:
    """Become the process that was ordered, and run the module; its exit status."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.alarm(LIMIT_S)
    for file, flags, ends in ((os.devnull, os.O_RDONLY, (0,)), (order["output"], os.O_WRONLY, (1, 2))):
        for end in ends:
            os.dup2(os.open(file, flags | os.O_CREAT | os.O_APPEND), end)
    os.chdir(order["folder"])
    os.environ.clear()
    os.environ.update(order["environment"])
    sys.argv[1:] = order["arguments"]
    sys.modules.pop(order["module"], None)
    try:
        runpy.run_module(order["module"], run_name="__main__", alter_sys=True)
    except SystemExit as exit:
        return exit.code if isinstance(exit.code, int) else int(exit.code is not None)
    except BaseException:
        traceback.print_exc()
        return 1
    return 0


def main() -> None:
    """Serve until the input ends."""
    for line in sys.stdin:
        child = os.fork()
        if not child:
            status = run(json.loads(line))
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status)
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)


if __name__ == "__main__":
    main()
