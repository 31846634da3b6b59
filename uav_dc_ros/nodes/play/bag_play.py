"""The verb `play`: publishes a bag's messages again, with their QoS, in their order, at their times."""

import argparse
import contextlib
import gc
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
SWITCH_S = 0.0005  # the thread that reads ahead must not hold up a message for longer
LAST_WORDS_S = 0.5  # for what was published to arrive, after Ctrl-C
PRIORITY = -10  # niceness: on a busy machine others would make messages late by several milliseconds
LEAVE_S = 1.0  # for the middleware to leave


def add_options(parser: argparse.ArgumentParser) -> None:
    """The command line."""
    parser.add_argument("bag", type=Path, metavar="BAG", help="folder of the bag, or one of its files")
    parser.add_argument(
        "--rate",
        type=_rate,
        default=1.0,
        metavar="FACTOR|max",
        help="how many times faster than recorded; max: as fast as reliable subscribers keep up "
        "(default: %(default)g)",
    )
    parser.add_argument("--loop", action="store_true", help="begin again at the end, until stopped")
    parser.add_argument(
        "--start",
        type=_seconds(least=0.0),
        default=0.0,
        metavar="S",
        help="seconds from the bag's beginning; what was latched before is published at once",
    )
    parser.add_argument(
        "--duration", type=_seconds(), metavar="S", help="seconds of the bag to play (default: all)"
    )
    parser.add_argument(
        "--max-gap",
        type=_seconds(most=math.inf),
        default=MAX_GAP_S,
        metavar="S|inf",
        help="longest time without a message that is waited out, seconds of the bag; a longer one, as of a "
        "clock that was set forward, is skipped, with a note (default: %(default)g)",
    )
    parser.add_argument("--topics", type=_topics, metavar="A,B,...", help="full names of topics to play")
    parser.add_argument(
        "--exclude", type=_topics, metavar="A,B,...", help="full names of topics to leave out"
    )
    parser.add_argument(
        "--remap",
        type=_remap,
        action="append",
        default=[],
        metavar="FROM:=TO",
        help="publish a topic under another full name; may be repeated",
    )
    parser.add_argument(
        "--namespace",
        type=cli.namespace,
        default="/",
        metavar="NS",
        help="put a namespace in front of all topics that are not remapped",
    )
    parser.add_argument(
        "--clock",
        type=_clock_hz,
        nargs="?",
        const=CLOCK_HZ,
        metavar="HZ",
        help=f"publish the bag's time on {CLOCK_TOPIC}, so often a second (default: %(const)g), for nodes "
        "with use_sim_time; a recorded one is left out",
    )
    parser.add_argument("--paused", action="store_true", help="begin with a pause: a terminal's keys go on")
    parser.add_argument(
        "--wait-for-subscribers",
        type=_seconds(),
        nargs="?",
        const=math.inf,
        metavar="S",
        help="begin when every topic has a subscriber; fail after S seconds (default: never)",
    )


def run(options: argparse.Namespace) -> int:
    """Play.

    Raises:
        UavDcError: something that the user can mend.
        KeyboardInterrupt: Ctrl-C, or SIGTERM.
    """
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    # A bag with moves and poses must not reach a vehicle on the network by accident.
    environment.prepare(alone=True)
    with BagReader(options.bag) as reader:
        return _play(reader, _plan(reader, options))


def _plan(reader: BagReader, options: argparse.Namespace) -> "PlaybackOptions":
    """What is to be played.

    Raises:
        ParameterError: the bag does not hold it.
        BagError: the bag holds nothing.
    """
    from uav_dc_ros.nodes.play.player import PlaybackOptions

    if not reader.message_count:
        raise BagError(f"bag {options.bag} holds no message; expected at least one to play")
    length_s = (reader.last_ns - reader.first_ns) * 1e-9
    if options.start > length_s:
        raise ParameterError(f"--start {options.start:g}: bag {options.bag} lasts {length_s:.3f} s")
    if options.paused and (sys.stdin is None or not sys.stdin.isatty()):
        raise ParameterError("--paused: standard input is no terminal, so no key could end the pause")
    return PlaybackOptions(
        path=options.bag,
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
    """Full name of the topic to publish, by recorded topic.

    Raises:
        ParameterError: the bag has no such topic, or a name or a pair of topics cannot be published.
    """
    from rclpy.exceptions import InvalidTopicNameException
    from rclpy.validate_full_topic_name import validate_full_topic_name

    remapped = dict(options.remap)
    for option, given in (
        ("--topics", options.topics or ()),
        ("--exclude", options.exclude or ()),
        ("--remap", remapped),
    ):
        _check_known(reader, option, given)
    excluded = set(options.exclude or ()) | ({CLOCK_TOPIC} if options.clock else set())
    prefix = options.namespace.rstrip("/")
    names = {
        topic: remapped.get(topic, f"{prefix}{topic}")
        for topic in (options.topics or sorted(reader.topics))
        if topic not in excluded
    }
    types: dict[str, tuple[str, str]] = {}
    for topic, name in names.items():
        kind = reader.topics[topic].type
        first, first_kind = types.setdefault(name, (topic, kind))
        if kind != first_kind:
            raise ParameterError(
                f"topics {first} and {topic} would both be published as {name}, but are of the types "
                f"{first_kind} and {kind}; expected one type"
            )
        try:
            validate_full_topic_name(name)
        except InvalidTopicNameException as error:
            why = str(error).splitlines()[0].removesuffix(":")
            raise ParameterError(f"topic {topic} cannot be published as {name!r}: {why}") from None
    if not names:
        option = "--exclude" if options.exclude else "--clock"  # nothing else leaves one out
        raise ParameterError(f"{option} leaves no topic of bag {options.bag}; expected at least one to play")
    return names


def _check_known(reader: BagReader, option: str, given: Iterable[str]) -> None:
    for topic in given:
        if topic not in reader.topics:
            known = ", ".join(sorted(reader.topics)) or "none"
            raise ParameterError(f"{option} {topic}: no such topic in bag {reader.path}; it has {known}")


def _play(reader: BagReader, plan: "PlaybackOptions") -> int:
    """Play with a node of its own.

    Raises:
        UavDcError, KeyboardInterrupt: as `run`.
    """
    import rclpy
    from rclpy.node import Node
    from rclpy.signals import SignalHandlerOptions

    from uav_dc_ros.nodes.play.display import PlaybackDisplay, text_of
    from uav_dc_ros.nodes.play.player import Player

    length_s = (reader.last_ns - reader.first_ns) * 1e-9
    end_s = length_s if plan.duration_s is None else min(length_s, plan.start_s + plan.duration_s)
    if not math.isinf(plan.rate):
        with contextlib.suppress(PermissionError):  # root may, and who was allowed to
            os.setpriority(os.PRIO_PROCESS, 0, PRIORITY)
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    try:
        with PlaybackDisplay(plan.start_s, end_s) as display:
            node = Node("player", start_parameter_services=False, enable_rosout=False)
            player = Player(node, plan, display, reader)
            display.tell(
                f"playing {plan.path}: {len(player.outlets)} topics, {end_s - plan.start_s:.3f} s, "
                f"rate {text_of(plan.rate)}"
            )
            began_s = time.monotonic()
            try:
                gc.collect()
                gc.freeze()  # what is there by now stays: no need to look at it while messages are due
                sys.setswitchinterval(SWITCH_S)
                player.play()
            except KeyboardInterrupt:
                player.deliver(LAST_WORDS_S)
                raise
            finally:
                took_s = time.monotonic() - began_s
                display.tell(f"published {player.messages} messages in {took_s:.1f} s")
    finally:
        _leave(rclpy)
    return 0


def _leave(rclpy: Any) -> None:
    """Leave the network, or give it up: the middleware has been seen to hang when several leave at once."""
    leaving = threading.Thread(target=rclpy.try_shutdown, daemon=True)
    leaving.start()
    leaving.join(LEAVE_S)


def _rate(text: str) -> float:
    if text == "max":
        return math.inf
    return _number(text, f"a number from {RATE_MIN:g} to {RATE_MAX:g}, or max", RATE_MIN, RATE_MAX)


def _clock_hz(text: str) -> float:
    return _number(text, f"a number from 0.001 to {CLOCK_HZ_MAX:g}", 1e-3, CLOCK_HZ_MAX)


def _seconds(least: float = 1e-9, most: float = 2.0**31) -> Any:
    def seconds(text: str) -> float:
        expected = "seconds, of at least 0" if least == 0.0 else "seconds, more than 0"
        return _number(text, expected, least, most)

    return seconds


def _number(text: str, expected: str, least: float, most: float) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not least <= value <= most:
        raise argparse.ArgumentTypeError(f"{text!r}; expected {expected}")
    return value


def _topics(text: str) -> list[str]:
    names = [name.strip() for name in text.split(",")]
    if not all(name.startswith("/") for name in names) or len(set(names)) < len(names):
        raise argparse.ArgumentTypeError(
            f"{text!r}; expected full names of topics, beginning with '/', each once, with ',' between"
        )
    return names


def _remap(text: str) -> tuple[str, str]:
    source, separator, target = text.partition(":=")
    if not (separator and source.startswith("/") and target.startswith("/")):
        raise argparse.ArgumentTypeError(f"{text!r}; expected FROM:=TO, two full names beginning with '/'")
    return source, target
