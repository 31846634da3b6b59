"""The verb `play`: publishes a bag's messages again, with the recorded QoS, order and timing."""

import argparse
import contextlib
import gc
import math
import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from uav_dc_ros import cli
from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.errors import BagError, ParameterError
from uav_dc_ros.nodes.play.clock import CLOCK_TOPIC, RATE_MAX, RATE_MIN
from uav_dc_ros.nodes.ros import environment

if TYPE_CHECKING:
    from uav_dc_ros.nodes.play.player import PlaybackOptions

MAX_GAP_S = 600.0
CLOCK_HZ = 40.0  # rosbag2's default
CLOCK_HZ_MAX = 1000.0
SWITCH_S = 0.0005  # longest time for which the reading thread may delay a message
PRIORITY = -10  # niceness: on a busy machine other processes delay messages by several milliseconds
SHUTDOWN_S = 1.0  # for the middleware

_topics = cli.names("full names of topics, beginning with '/'", start="/")


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the verb."""
    add = parser.add_argument
    add("bag", type=Path, metavar="BAG", help="folder of the bag, or one of its files")
    add(
        "--rate",
        type=_rate,
        default=1.0,
        metavar="FACTOR|max",
        help="how many times faster than recorded; max: as fast as reliable subscribers keep up "
        "(default: %(default)g)",
    )
    add("--loop", action="store_true", help="begin again at the end, until stopped")
    add(
        "--start",
        type=cli.number(0.0, 2.0**31, "seconds, of at least 0"),
        default=0.0,
        metavar="S",
        help="seconds from the bag's beginning; earlier latched messages are published at once",
    )
    add("--duration", type=_seconds(), metavar="S", help="seconds of the bag to play (default: all)")
    add(
        "--max-gap",
        type=_seconds(maximum=math.inf),
        default=MAX_GAP_S,
        metavar="S|inf",
        help="longest time without a message, seconds of the bag; a longer one, as of a clock that was set "
        "forward, is skipped with a note (default: %(default)g)",
    )
    add("--topics", type=_topics, metavar="A,B,...", help="full names of topics to play")
    add("--exclude", type=_topics, metavar="A,B,...", help="full names of topics to leave out")
    add(
        "--remap",
        type=_remap,
        action="append",
        default=[],
        metavar="FROM:=TO",
        help="publish a topic under another full name; repeatable",
    )
    cli.add_namespace(parser, "namespace in front of all topics that are not remapped")
    add(
        "--clock",
        type=cli.number(1e-3, CLOCK_HZ_MAX, f"a number from 0.001 to {CLOCK_HZ_MAX:g}"),
        nargs="?",
        const=CLOCK_HZ,
        metavar="HZ",
        help=f"publish the bag's time on {CLOCK_TOPIC} at this rate (default: %(const)g), for nodes with "
        "use_sim_time, instead of a recorded one",
    )
    add("--paused", action="store_true", help="begin with a pause, which a key ends: needs a terminal")
    add(
        "--wait-for-subscribers",
        type=_seconds(),
        nargs="?",
        const=math.inf,
        metavar="S",
        help="begin when every topic has a subscriber; fail after S seconds (default: never)",
    )


def run(options: argparse.Namespace) -> int:
    """Play; raises UavDcError for invalid options or bags, KeyboardInterrupt for Ctrl-C or SIGTERM."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    # A bag with moves and poses must not reach a vehicle on the network by accident.
    environment.prepare(local_only=True)
    environment.select_shared_memory()
    with BagReader(options.bag) as reader:
        _play(reader, _playback_options(reader, options))
    return 0


def _playback_options(reader: BagReader, options: argparse.Namespace) -> "PlaybackOptions":
    """Check the options against the bag."""
    from uav_dc_ros.nodes.play.player import PlaybackOptions

    if not reader.message_count:
        raise BagError(f"bag {options.bag} holds no message; expected at least one to play")
    length_s = (reader.last_ns - reader.first_ns) * 1e-9
    if options.start > length_s:
        raise ParameterError(f"--start {options.start:g}: bag {options.bag} lasts {length_s:.3f} s")
    if options.paused and (sys.stdin is None or not sys.stdin.isatty()):
        raise ParameterError("--paused: standard input is no terminal, so no key could end the pause")
    return PlaybackOptions(
        names=_names(reader, options),
        start_s=options.start,
        duration_s=options.duration,
        max_gap_s=options.max_gap,
        rate=options.rate,
        loop=options.loop,
        paused=options.paused,
        clock_hz=options.clock,
        wait_s=options.wait_for_subscribers,
    )


def _names(reader: BagReader, options: argparse.Namespace) -> dict[str, str]:
    """Full name of the topic to publish, by recorded topic."""
    from rclpy.exceptions import InvalidTopicNameException
    from rclpy.validate_full_topic_name import validate_full_topic_name

    remapped = dict(options.remap)
    given = {"--topics": options.topics or (), "--exclude": options.exclude or (), "--remap": remapped}
    for option, topics in given.items():
        for topic in topics:
            if topic not in reader.topics:
                known = ", ".join(sorted(reader.topics)) or "none"
                raise ParameterError(f"{option} {topic}: no such topic in bag {reader.path}; it has {known}")
    excluded = {*(options.exclude or ()), *([CLOCK_TOPIC] if options.clock else ())}
    prefix = options.namespace.rstrip("/")
    played = [topic for topic in options.topics or sorted(reader.topics) if topic not in excluded]
    names = {topic: remapped.get(topic, f"{prefix}{topic}") for topic in played}
    first_of: dict[str, str] = {}
    for topic, name in names.items():
        first = first_of.setdefault(name, topic)
        types = reader.topics[first].type, reader.topics[topic].type
        if types[0] != types[1]:
            raise ParameterError(
                f"topics {first} and {topic} would both be published as {name}, but are of the types "
                f"{' and '.join(types)}; expected one type"
            )
        try:
            validate_full_topic_name(name)
        except InvalidTopicNameException as error:
            reason = str(error).splitlines()[0].removesuffix(":")
            raise ParameterError(f"topic {topic} cannot be published as {name!r}: {reason}") from None
    if not names:
        option = "--exclude" if options.exclude else "--clock"
        raise ParameterError(f"{option} leaves no topic of bag {options.bag}; expected at least one to play")
    return names


def _play(reader: BagReader, options: "PlaybackOptions") -> None:
    import rclpy
    from rclpy.node import Node
    from rclpy.signals import SignalHandlerOptions

    from uav_dc_ros.nodes.play.player import Player
    from uav_dc_ros.nodes.play.terminal import PlaybackDisplay, rate_text
    from uav_dc_ros.nodes.ros.executor import shut_down

    length_s = (reader.last_ns - reader.first_ns) * 1e-9
    end_s = length_s if options.duration_s is None else min(length_s, options.start_s + options.duration_s)
    if not math.isinf(options.rate):
        with contextlib.suppress(PermissionError):
            os.setpriority(os.PRIO_PROCESS, 0, PRIORITY)
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    try:
        with PlaybackDisplay(options.start_s, end_s) as display:
            node = Node("player", start_parameter_services=False, enable_rosout=False)
            player = Player(node, options, display, reader)
            display.info(
                f"playing {reader.path}: {len(player.publishers)} topics, {end_s - options.start_s:.3f} s, "
                f"rate {rate_text(options.rate)}"
            )
            began_s = time.monotonic()
            try:
                gc.collect()
                gc.freeze()  # collections during playback skip all existing objects
                sys.setswitchinterval(SWITCH_S)
                player.play()
            except KeyboardInterrupt:
                player.finish()
                raise
            finally:
                took_s = time.monotonic() - began_s
                display.info(f"published {player.messages} messages in {took_s:.1f} s")
    finally:
        shut_down(rclpy.get_default_context(), SHUTDOWN_S)


def _rate(text: str) -> float:
    if text == "max":
        return math.inf
    expected = f"a number from {RATE_MIN:g} to {RATE_MAX:g}, or max"
    return cli.number(RATE_MIN, RATE_MAX, expected)(text)


def _seconds(maximum: float = 2.0**31) -> Callable[[str], float]:
    return cli.number(1e-9, maximum, "seconds, more than 0")


def _remap(text: str) -> tuple[str, str]:
    source, separator, target = text.partition(":=")
    if not (separator and source.startswith("/") and target.startswith("/")):
        raise argparse.ArgumentTypeError(f"{text!r}; expected FROM:=TO, two full names beginning with '/'")
    return source, target
