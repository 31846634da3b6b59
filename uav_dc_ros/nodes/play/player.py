"""Plays a bag: every message as it was recorded, at its time, into the ROS network.

One thread does it all: it waits for what comes next, a message, a key, or something to show.
"""

import math
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

from rclpy.node import Node
from rosgraph_msgs.msg import Clock

from uav_dc_ros.bags.read import BagMessage, BagReader
from uav_dc_ros.bags.read_ahead import ReadAhead
from uav_dc_ros.errors import BagError, NodeError
from uav_dc_ros.nodes.framework.other_publishers import AnotherMissionError
from uav_dc_ros.nodes.play.clock import CLOCK_TOPIC, RATE_MAX, RATE_MIN, PlaybackClock
from uav_dc_ros.nodes.play.display import PlaybackDisplay
from uav_dc_ros.nodes.play.keyboard import HELP, Keyboard
from uav_dc_ros.nodes.play.playback_publisher import PlaybackPublisher
from uav_dc_ros.nodes.play.subscriber_monitor import SubscriberMonitor
from uav_dc_ros.nodes.ros import convert, qos
from uav_dc_ros.topics import TOPICS

TICK_S = 0.05  # keys, the bar and `/clock` are looked at as often, at least
GRAPH_S = 1.0  # so often it is looked for subscribers that do not match
GRAPH_IDLE_S = 0.02  # that takes a while, so it is done while no message is due
# Subscribers that are there already need a moment to be found: none came for so long, or at the latest then.
QUIET_S, QUIET_MAX_S = 0.5, 3.0
ROOM_S = 0.0002  # how soon it is seen that subscribers have caught up
HELD_S = 0.1  # that the schedule makes up for when subscribers had to be waited for
STUCK_S = 5.0  # until it is told that one does not
LAST_WORDS_S = 0.5  # for what was published to arrive, when a key ends the play
CLOCK_MAX_NS = 2**31 * 10**9 - 1
FASTER = 1.25  # three times is about twice as fast


@dataclass(frozen=True, kw_only=True)
class PlaybackOptions:
    """What is to be played, and how.

    Attributes:
        path: of the bag.
        names: full name of the topic to publish, by recorded topic.
        start_s: where to begin, seconds from the bag's first message.
        duration_s: how much of the bag to play, seconds; None: to its end.
        max_gap_s: longest time without a message that is waited out, seconds of the bag.
        rate: seconds of the bag in a second; infinite: as fast as subscribers keep up.
        loop: begin again at the end.
        paused: begin with a pause.
        clock_hz: how often `/clock` is published, per second of the wall; None: never.
        wait_s: how long to wait for a subscriber of every topic; None: for none.
    """

    path: Path
    names: dict[str, str]
    start_s: float = 0.0
    duration_s: float | None = None
    max_gap_s: float = math.inf
    rate: float = 1.0
    loop: bool = False
    paused: bool = False
    clock_hz: float | None = None
    wait_s: float | None = None


class Player:
    """Plays a bag once, or in a loop; publishers are there from the start.

    Args:
        node: that publishes.
        plan: what to play.
        display: to show it on.
        reader: of the bag.

    Attributes:
        outlets: what publishes, by recorded topic.
        clock: the time of the bag.
        messages: published so far.

    Raises:
        BagError: nothing of the bag can be played, or its QoS makes no sense.
    """

    def __init__(
        self, node: Node, plan: PlaybackOptions, display: PlaybackDisplay, reader: BagReader
    ) -> None:
        self.node, self.plan, self.display, self.reader = node, plan, display, reader
        self.outlets: dict[str, PlaybackPublisher] = {}
        self.messages = 0
        length_s = max(1.0, (reader.last_ns - reader.first_ns) * 1e-9)
        for recorded, name in plan.names.items():
            topic = reader.topics[recorded]
            first = next(reader.messages([recorded]), None) if topic.count else None
            per_s = plan.rate * max(1, topic.count) / length_s
            try:
                self.outlets[recorded] = PlaybackPublisher(
                    node, name, topic, message_bytes=len(first.data) if first else 0, per_s=per_s
                )
            except NodeError as error:
                display.note(f"topic {recorded} is not played: {error}")
        if not any(reader.topics[recorded].count for recorded in self.outlets):
            raise BagError(f"bag {plan.path} holds no message that can be played")
        self._start_ns = self.reader.first_ns + round(self.plan.start_s * 1e9)
        duration_s = self.plan.duration_s
        self._end_ns = None if duration_s is None else self._start_ns + round(duration_s * 1e9)
        self.clock = PlaybackClock(self.plan.rate, paused=self.plan.paused)
        self._keys = Keyboard(self.clock.hold)
        self._steps = 0  # messages that keys asked for
        self._quit = False
        self._waits = False  # for subscribers, before anything is played
        self._audience = SubscriberMonitor(node, self.outlets.values())
        self._graph_at_s = self._tick_at_s = self._clock_at_s = 0.0
        self._clock_publisher: Any = None
        if self.plan.clock_hz is not None:
            row = TOPICS[CLOCK_TOPIC.strip("/")]
            self._clock_publisher = self.node.create_publisher(Clock, CLOCK_TOPIC, qos.offered(row))

    def play(self) -> None:
        """Play until the end, or until a key says so.

        Raises:
            BagError: the bag is damaged somewhere.
            NodeError: a topic got no subscriber in time.
            AnotherMissionError: a mission is being flown on topics that are played, also once it plays.
        """
        self.clock.jump(self._start_ns)
        with self._keys:
            if self._keys.active:
                self.display.tell(HELP)
            self._wait_for_subscribers()
            while not self._quit:
                before = self.messages
                self._play_once()
                if not self.plan.loop:
                    break
                if self.messages == before:
                    raise BagError(f"bag {self.plan.path} holds no message there; a loop would never end")
            self.deliver(LAST_WORDS_S if self._quit else math.inf)

    def deliver(self, patience_s: float) -> None:
        """Wait until all that was published has arrived at every reliable subscriber."""
        deadline_s = time.monotonic() + patience_s
        for outlet in self.outlets.values():
            self._wait_for(outlet.delivered, outlet, deadline_s)

    def _play_once(self) -> None:
        self.display.begin()
        for outlet in self.outlets.values():
            outlet.begin()
        self.clock.limit_ns = self._start_ns
        self.clock.jump(self._start_ns)
        for message in self._latched_before():
            self._publish(message)
        with ReadAhead(
            self.plan.path, list(self.outlets), start_ns=self._start_ns, end_ns=self._end_ns
        ) as messages:
            self.clock.jump(self._start_ns)  # reading the beginning took no time of the bag
            before_ns = self._start_ns
            for message in messages:
                if self.outlets[message.topic].repeats(message):
                    continue
                self.clock.limit_ns = message.log_time_ns
                self._skip_gap(before_ns, message.log_time_ns)
                before_ns = message.log_time_ns
                if not self._wait_until_due(message.log_time_ns):
                    return
                self._publish(message)
                self.clock.played(message.log_time_ns)
        self._show(math.inf)

    def _skip_gap(self, before_ns: int, next_ns: int) -> None:
        """Go on at once after a long time without a message; nobody waits for that at `--rate max`."""
        gap_s = (next_ns - before_ns) * 1e-9
        if gap_s <= self.plan.max_gap_s or math.isinf(self.clock.rate):
            return
        at_s = (before_ns - self.reader.first_ns) * 1e-9
        self.clock.jump(next_ns)
        self.display.note(
            f"no message for {gap_s:,.0f} s after {at_s:,.1f} s: skipped, as it is longer than --max-gap "
            f"{self.plan.max_gap_s:g}; the clock may have been set forward while this was recorded"
        )

    def _latched_before(self) -> Iterator[BagMessage]:
        """What somebody who joins at the start would have got of latched topics, in its order."""
        latched = {name: outlet for name, outlet in self.outlets.items() if outlet.latched}
        if self.plan.start_s == 0.0 or not latched:
            return iter(())
        kept: dict[str, deque[tuple[int, BagMessage]]] = {
            name: deque(maxlen=outlet.depth) for name, outlet in latched.items()
        }
        with ReadAhead(
            self.plan.path, list(latched), start_ns=self.reader.first_ns, end_ns=self._start_ns
        ) as messages:
            for at, message in enumerate(messages):
                if not latched[message.topic].repeats(message):
                    kept[message.topic].append((at, message))
        return (message for _, message in sorted(chain(*kept.values()), key=lambda each: each[0]))

    def _publish(self, message: BagMessage) -> None:
        outlet = self.outlets[message.topic]
        if not outlet.has_room():
            began_s = time.monotonic()
            self._wait_for(outlet.has_room, outlet)
            # A short wait delays no other message; after a long one the bag goes on as it was.
            self.clock.hold(max(0.0, time.monotonic() - began_s - HELD_S))
        outlet.publish(message.data)
        self.messages += 1

    def _wait_for(
        self, there: Callable[[], bool], outlet: PlaybackPublisher, deadline_s: float = math.inf
    ) -> None:
        """Wait for subscribers of an outlet, up to a deadline, or until a key ends the play."""
        tell_at_s = time.monotonic() + STUCK_S
        while not there():
            now_s = time.monotonic()
            if now_s >= deadline_s or (self._quit and math.isinf(deadline_s)):
                return
            if now_s >= tell_at_s:
                tell_at_s = math.inf
                self.display.note(
                    f"waiting for a subscriber of {outlet.name} that is reliable, and takes no more: "
                    f"one of {self._audience.subscribers(outlet)}"
                )
            self._tick(now_s, 0.0)
            time.sleep(ROOM_S)

    def _check_no_mission(self) -> None:
        """Refuse to play on the topics of a mission.

        Raises:
            AnotherMissionError: one is being flown on topics that are played.
        """
        beside = () if self.plan.clock_hz is None else (CLOCK_TOPIC,)
        if (mission := self._audience.mission(beside)) is not None:
            raise AnotherMissionError(mission)

    # Time.

    def _wait_until_due(self, log_time_ns: int) -> bool:
        """Wait for a message's time, or for the key that asks for it; False, if play ends before."""
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
            self._heed(self._keys.wait(min(due_s, self._tick_at_s) - now_s))
        return False

    def _tick(self, now_s: float, idle_s: float) -> None:
        """What is to be done now and then. `idle_s`: until the next message."""
        period_s = TICK_S
        if self._clock_publisher is not None and self.plan.clock_hz is not None:
            if now_s >= self._clock_at_s:
                self._publish_clock()
                self._clock_at_s = max(self._clock_at_s + 1.0 / self.plan.clock_hz, now_s)
            period_s = min(period_s, max(0.0, self._clock_at_s - now_s))
        self._heed(self._keys.wait(0.0))
        self._show(idle_s)
        if idle_s >= GRAPH_IDLE_S and now_s >= self._graph_at_s:
            self._graph_at_s = now_s + GRAPH_S
            self._check_no_mission()  # on a busy computer the first look may have come too early
            for told in self._audience.deaf():
                self.display.note(told)
        self._tick_at_s = now_s + period_s

    def _publish_clock(self) -> None:
        """Publish the bag's time; ROS 2 counts seconds up to 2038 only, where it stands still then."""
        stamp = convert.stamp(min(self.clock.position_ns(), CLOCK_MAX_NS))
        self._clock_publisher.publish(Clock(clock=stamp))

    def _show(self, idle_s: float) -> None:
        at_s = (self.clock.position_ns() - self.reader.first_ns) * 1e-9
        state = "waiting" if self._waits else "paused" if self.clock.paused else "playing"
        self.display.progress(state, at_s, self.clock.rate, self.messages, idle_s)

    def _heed(self, keys: list[str]) -> None:
        for key in keys:
            if key == "quit":
                self._quit = True
            elif key == "pause":
                self.clock.pause()
                self._steps = 0
            elif key == "step":
                self._steps += self.clock.paused
            elif not math.isinf(self.clock.rate):
                factor = FASTER if key == "faster" else 1.0 / FASTER
                self.clock.rate = min(RATE_MAX, max(RATE_MIN, self.clock.rate * factor))

    # Who else is there.

    def _wait_for_subscribers(self) -> None:
        """Wait for those of every topic, if asked to; and in any case until those that are there are found.

        Raises:
            NodeError: a topic got none in time.
        """
        began_s = changed_s = time.monotonic()
        counts: dict[str, int] = {}
        patience_s = self.plan.wait_s
        speaking = {outlet.name for name, outlet in self.outlets.items() if self.reader.topics[name].count}
        self._waits = True
        while not self._quit:
            now_s = time.monotonic()
            found = self._audience.counts()
            if found != counts:
                counts, changed_s = found, now_s
            missing = sorted(name for name in speaking if not counts[name])
            if patience_s is not None and missing:
                if now_s - began_s > patience_s:
                    raise NodeError(
                        f"no subscriber of {', '.join(missing)} within {patience_s:g} s; expected one of "
                        "every topic that is played"
                    )
            elif now_s - changed_s > QUIET_S or now_s - began_s > QUIET_MAX_S:
                break
            self._tick(now_s, GRAPH_IDLE_S)
            self._heed(self._keys.wait(TICK_S))
        self._waits = False
        self._check_no_mission()
        for told in (*self._audience.others(), *self._audience.deaf()):
            self.display.note(told)
