"""Plays a bag: publishes every message as recorded, at its time. One thread also serves keys and display."""

import math
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import chain
from operator import itemgetter
from typing import Any

from rclpy.node import Node
from rosgraph_msgs.msg import Clock

from uav_dc_ros.bags.read import BagMessage, BagReader
from uav_dc_ros.bags.read_ahead import ReadAhead
from uav_dc_ros.errors import BagError, NodeError
from uav_dc_ros.nodes.framework.other_publishers import AnotherMissionError
from uav_dc_ros.nodes.play.clock import CLOCK_TOPIC, RATE_MAX, RATE_MIN, PlaybackClock
from uav_dc_ros.nodes.play.playback_publisher import PlaybackPublisher, SubscriberMonitor
from uav_dc_ros.nodes.play.terminal import HELP, Keyboard, PlaybackDisplay
from uav_dc_ros.nodes.ros import convert, qos
from uav_dc_ros.topics import TOPICS

TICK_S = 0.05  # longest time between two updates of keys, display and `/clock`
GRAPH_S = 1.0  # period of graph queries
GRAPH_IDLE_S = 0.02  # a graph query takes a while: it runs only if no message is due for so long
# Discovery of existing subscribers is complete after this time without a new one, or at the latest then.
QUIET_S, QUIET_MAX_S = 0.5, 3.0
ACKNOWLEDGE_POLL_S = 0.0002
CATCH_UP_S = 0.1  # longest delay by slow subscribers that later messages make up for
STUCK_S = 5.0  # wait for a slow subscriber until it is reported
FINISH_S = 0.5  # for acknowledgements, after a key or Ctrl-C ended the playback
CLOCK_MAX_NS = 2**31 * 10**9 - 1  # ROS 2 times end in 2038
RATE_FACTOR = 1.25  # per key; three times is about twice as fast


@dataclass(frozen=True, kw_only=True)
class PlaybackOptions:
    """What to play, and how. Times are seconds of the bag."""

    names: dict[str, str]  # full name of the topic to publish, by recorded topic
    start_s: float  # from the first message
    duration_s: float | None  # None: to the end
    max_gap_s: float  # longest time without a message that is not skipped
    rate: float  # seconds of the bag per second; infinite: as fast as reliable subscribers keep up
    loop: bool
    paused: bool
    clock_hz: float | None  # rate of `/clock` in wall time; None: it is not published
    wait_s: float | None  # timeout for a subscriber of every topic, wall time; None: do not wait


class Player:
    """Plays a bag once, or in a loop; raises BagError if no message can be played."""

    def __init__(
        self, node: Node, options: PlaybackOptions, display: PlaybackDisplay, reader: BagReader
    ) -> None:
        self.options, self.display, self.reader = options, display, reader
        self.publishers: dict[str, PlaybackPublisher] = {}  # by recorded topic
        self.messages = 0  # published
        length_s = max(1.0, (reader.last_ns - reader.first_ns) * 1e-9)
        for recorded, name in options.names.items():
            topic = reader.topics[recorded]
            first = next(reader.messages([recorded]), None) if topic.count else None
            per_s = options.rate * max(1, topic.count) / length_s
            try:
                self.publishers[recorded] = PlaybackPublisher(
                    node, name, topic, message_bytes=len(first.data) if first else 0, per_s=per_s
                )
            except NodeError as error:
                display.note(f"topic {recorded} is not played: {error}")
        if not any(reader.topics[recorded].count for recorded in self.publishers):
            raise BagError(f"bag {reader.path} holds no message that can be played")
        self._start_ns = reader.first_ns + round(options.start_s * 1e9)
        duration_s = options.duration_s
        self._end_ns = None if duration_s is None else self._start_ns + round(duration_s * 1e9)
        self.clock = PlaybackClock(options.rate, paused=options.paused)
        self._keyboard = Keyboard(self.clock.delay)
        self._steps = 0  # requested single steps
        self._quit = False
        self._is_waiting = False  # for subscribers, before the first message
        self._monitor = SubscriberMonitor(node, self.publishers.values())
        self._graph_at_s = self._tick_at_s = self._clock_at_s = 0.0
        self._clock_publisher: Any = None
        if options.clock_hz is not None:
            row = TOPICS[CLOCK_TOPIC.strip("/")]
            self._clock_publisher = node.create_publisher(Clock, CLOCK_TOPIC, qos.offered(row))

    def play(self) -> None:
        """Play to the end, or until the quit key.

        Raises BagError for a damaged bag, NodeError if a topic has no subscriber within the timeout, and
        AnotherMissionError if a running mission publishes a played topic.
        """
        self.clock.jump(self._start_ns)
        with self._keyboard:
            if self._keyboard.active:
                self.display.info(HELP)
            self._wait_for_subscribers()
            while not self._quit:
                before = self.messages
                self._play_once()
                if not self.options.loop:
                    break
                if self.messages == before:
                    raise BagError(f"bag {self.reader.path} holds no message there; a loop would never end")
            self.finish(FINISH_S if self._quit else math.inf)

    def finish(self, timeout_s: float = FINISH_S) -> None:
        """Wait until all reliable subscribers have acknowledged all messages."""
        deadline_s = time.monotonic() + timeout_s
        for publisher in self.publishers.values():
            self._wait_until(publisher.is_acknowledged, publisher.name, deadline_s)

    def _play_once(self) -> None:
        self.display.restart()
        for publisher in self.publishers.values():
            publisher.restart()
        self.clock.limit_ns = self._start_ns
        self.clock.jump(self._start_ns)
        for message in self._latched_before_start():
            self._publish(message)
        path, topics = self.reader.path, list(self.publishers)
        with ReadAhead(path, topics, start_ns=self._start_ns, end_ns=self._end_ns) as messages:
            self.clock.jump(self._start_ns)  # the first read took wall time
            before_ns = self._start_ns
            for message in messages:
                if self.publishers[message.topic].is_repeated(message):
                    continue
                self.clock.limit_ns = message.log_time_ns
                self._skip_gap(before_ns, message.log_time_ns)
                before_ns = message.log_time_ns
                if not self._wait_until_due(message.log_time_ns):
                    return
                self._publish(message)
                self.clock.follow(message.log_time_ns)
        self._show(math.inf)

    def _skip_gap(self, before_ns: int, next_ns: int) -> None:
        """Jump to the next message after a long time without one."""
        gap_s = (next_ns - before_ns) * 1e-9
        if gap_s <= self.options.max_gap_s or math.isinf(self.clock.rate):
            return
        at_s = (before_ns - self.reader.first_ns) * 1e-9
        self.clock.jump(next_ns)
        self.display.note(
            f"no message for {gap_s:,.0f} s after {at_s:,.1f} s: skipped, as it is longer than --max-gap "
            f"{self.options.max_gap_s:g}; the clock may have been set forward during the recording"
        )

    def _latched_before_start(self) -> Iterable[BagMessage]:
        """The latched messages that a subscriber at the start time would have received, in their order."""
        latched = {name: each for name, each in self.publishers.items() if each.latched}
        if self.options.start_s == 0.0 or not latched:
            return ()
        kept: dict[str, deque[tuple[int, BagMessage]]]
        kept = {name: deque(maxlen=publisher.depth) for name, publisher in latched.items()}
        path, first_ns = self.reader.path, self.reader.first_ns
        with ReadAhead(path, list(latched), start_ns=first_ns, end_ns=self._start_ns) as messages:
            for i, message in enumerate(messages):
                if not latched[message.topic].is_repeated(message):
                    kept[message.topic].append((i, message))
        return (message for _, message in sorted(chain(*kept.values()), key=itemgetter(0)))

    def _publish(self, message: BagMessage) -> None:
        publisher = self.publishers[message.topic]
        if not publisher.has_room():
            began_s = time.monotonic()
            self._wait_until(publisher.has_room, publisher.name)
            # A short wait delays no other message; a long one shifts the schedule.
            self.clock.delay(max(0.0, time.monotonic() - began_s - CATCH_UP_S))
        publisher.publish(message.data)
        self.messages += 1

    def _wait_until(self, condition: Callable[[], bool], topic: str, deadline_s: float = math.inf) -> None:
        """Wait for a topic's subscribers, up to a deadline, or without one up to the quit key."""
        report_at_s = time.monotonic() + STUCK_S
        while not condition():
            now_s = time.monotonic()
            if now_s >= deadline_s or (self._quit and math.isinf(deadline_s)):
                return
            if now_s >= report_at_s:
                report_at_s = math.inf
                self.display.note(
                    f"a reliable subscriber of {topic} acknowledges no more messages, and delays all others: "
                    f"one of {self._monitor.subscribers(topic)}"
                )
            self._tick(now_s, 0.0)
            time.sleep(ACKNOWLEDGE_POLL_S)

    def _check_no_mission(self) -> None:
        also = () if self._clock_publisher is None else (CLOCK_TOPIC,)
        if (mission := self._monitor.mission(also)) is not None:
            raise AnotherMissionError(mission)

    # Time.

    def _wait_until_due(self, log_time_ns: int) -> bool:
        """Wait for a message's time, or for a single step; False if the playback ends before."""
        while not self._quit:
            now_s = time.monotonic()
            due_s = self.clock.due_s(log_time_ns)
            if now_s >= self._tick_at_s:
                self._tick(now_s, due_s - now_s)
                continue
            if due_s <= now_s:
                return True
            if self._steps:
                self._steps -= 1
                return True
            self._handle_keys(min(due_s, self._tick_at_s) - now_s)
        return False

    def _tick(self, now_s: float, idle_s: float) -> None:
        """Do the periodic work; `idle_s` is the time until the next message."""
        period_s = TICK_S
        if self.options.clock_hz is not None:
            if now_s >= self._clock_at_s:
                stamp = convert.stamp(min(self.clock.position_ns(), CLOCK_MAX_NS))
                self._clock_publisher.publish(Clock(clock=stamp))
                self._clock_at_s = max(self._clock_at_s + 1.0 / self.options.clock_hz, now_s)
            period_s = min(period_s, max(0.0, self._clock_at_s - now_s))
        self._handle_keys(0.0)
        self._show(idle_s)
        if idle_s >= GRAPH_IDLE_S and now_s >= self._graph_at_s:
            self._graph_at_s = now_s + GRAPH_S
            self._check_no_mission()  # discovery on a busy machine may outlast the check at the start
            for note in self._monitor.incompatible_subscribers():
                self.display.note(note)
        self._tick_at_s = now_s + period_s

    def _show(self, idle_s: float) -> None:
        position_s = (self.clock.position_ns() - self.reader.first_ns) * 1e-9
        state = "waiting" if self._is_waiting else "paused" if self.clock.paused else "playing"
        self.display.progress(state, position_s, self.clock.rate, self.messages, idle_s)

    def _handle_keys(self, timeout_s: float) -> None:
        for key in self._keyboard.wait(timeout_s):
            if key == "quit":
                self._quit = True
            elif key == "pause":
                self.clock.toggle_pause()
                self._steps = 0
            elif key == "step":
                self._steps += self.clock.paused
            elif not math.isinf(self.clock.rate):
                factor = RATE_FACTOR if key == "faster" else 1.0 / RATE_FACTOR
                self.clock.rate = min(RATE_MAX, max(RATE_MIN, self.clock.rate * factor))

    def _wait_for_subscribers(self) -> None:
        """Wait for discovery and, if requested, for a subscriber of every topic; then check the graph."""
        began_s = changed_s = time.monotonic()
        counts: dict[str, int] = {}
        timeout_s = self.options.wait_s
        played = {each.name for name, each in self.publishers.items() if self.reader.topics[name].count}
        self._is_waiting = True
        while not self._quit:
            now_s = time.monotonic()
            found = self._monitor.counts()
            if found != counts:
                counts, changed_s = found, now_s
            missing = sorted(name for name in played if not counts[name])
            if timeout_s is not None and missing:
                if now_s - began_s > timeout_s:
                    raise NodeError(
                        f"no subscriber of {', '.join(missing)} within {timeout_s:g} s; expected one of "
                        "every played topic"
                    )
            elif now_s - changed_s > QUIET_S or now_s - began_s > QUIET_MAX_S:
                break
            self._tick(now_s, GRAPH_IDLE_S)
            self._handle_keys(TICK_S)
        self._is_waiting = False
        self._check_no_mission()
        for note in (*self._monitor.competing_publishers(), *self._monitor.incompatible_subscribers()):
            self.display.note(note)
