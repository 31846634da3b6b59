"""Steps of recorded missions, as a stream that is assembled from the topics of one namespace.

A bag holds the messages of a step in any order. Some are repeated (a lockstep that stands still), some are
missing. Each step is released once, with the messages that the bag holds of it.
"""

from bisect import insort
from collections import Counter, deque
from collections.abc import Iterator
from operator import attrgetter
from pathlib import Path
from typing import TypeAlias

import msgspec
import numpy as np
from msgspec.structs import replace

from uav_dc_ros import cdr, messages, scenarios, topics
from uav_dc_ros.bags.message_definitions import matches_jazzy
from uav_dc_ros.bags.read import BagMessage, BagReader, RecordedTopic
from uav_dc_ros.bags.unreadable import Unreadable
from uav_dc_ros.core.scenario import Scenario, from_values
from uav_dc_ros.errors import BagError, MessageError, ScenarioError
from uav_dc_ros.messages import Mission, Phase
from uav_dc_ros.phases import GROUND
from uav_dc_ros.recordings.recorded_step import (
    STEP_POSES_MAX,
    RecordedPose,
    RecordedStep,
    differ_in_time_only,
    supersedes,
    with_progress_of,
)

STEP_TOPICS = ("pose", "users", "rates", "mission", "move")
NEWER_MIN = 3  # newest steps: they may still get messages, complete or not
OPEN_MAX = 256  # steps that wait while the oldest one is incomplete
OPEN_BYTES_MAX = 64 * 2**20  # of their messages
RECENT_MAX = 1000  # released steps whose topics are remembered: as many as a latched topic repeats
POSES_MAX = 10_000  # poses that wait for their users
EXTERNAL = "external"  # a real vehicle; the bag does not name its interface

Key: TypeAlias = tuple[int, int, int]  # flight, mission, step


def namespaces(reader: BagReader) -> list[str]:
    """Namespaces with a `mission` topic of our type, sorted. The root is the empty text."""
    names = (topic.name for topic in reader.topics.values() if topic.type == topics.JSON)
    return sorted(name.removesuffix("/mission") for name in names if name.endswith("/mission"))


def namespace(reader: BagReader, wanted: str | None = None) -> str:
    """The namespace `wanted`, or the only one; raises BagError if there is none such."""
    found = namespaces(reader)
    listed = ", ".join(name or "/" for name in found)
    if wanted is not None:
        name = "/" + wanted.strip("/") if wanted.strip("/") else ""
        if name not in found:
            expected = listed or "one"
            raise BagError(f"bag {reader.path}: no mission in namespace {wanted!r}; expected {expected}")
        return name
    if not found:
        raise BagError(
            f"bag {reader.path} holds no mission: no topic `mission` of type {topics.JSON}; its topics are "
            f"{', '.join(sorted(reader.topics)) or '(none)'}"
        )
    if len(found) > 1:
        raise BagError(f"bag {reader.path} holds missions in {listed}; expected one of them: --namespace")
    return found[0]


def scenario(reader: BagReader, namespace: str, wanted: str | Path | None = None) -> Scenario:
    """The scenario `wanted`, or the one that the bag holds, or the shipped one of the missions' fingerprint.

    Raises BagError if there is none, and ScenarioError if it cannot be read.
    """
    if wanted is not None:
        return scenarios.load(wanted)
    values = reader.about.get("scenario_values")
    if values is not None:
        try:
            return from_values(msgspec.json.decode(values), f"bag {reader.path}: scenario_values")
        except msgspec.DecodeError as error:
            raise ScenarioError(f"bag {reader.path}: scenario_values: {error}") from None
    status = next((step.status for step in Steps(reader, namespace) if step.status is not None), None)
    flown = ""
    if status is not None:
        for shipped in map(scenarios.load, scenarios.names()):
            # Under another name in version 0.1.0.
            if (former := replace(shipped, name=status.scenario)).fingerprint == status.fingerprint:
                return former
        flown = f", and its missions fly {status.scenario!r} ({status.fingerprint})"
    raise BagError(f"bag {reader.path} holds no scenario{flown}; expected --scenario NAME|FILE")


def vehicle(reader: BagReader, namespace: str) -> str:
    """`simulated`, the interface of a real vehicle (`mavlink`, `mavros`, `px4`), or `external`.

    Our recorder writes it into the bag. Elsewhere the first readable status decides: a simulated vehicle
    reports `ready` or an end, without a reason. Without a status the vehicle counts as simulated.
    """
    if "vehicle" in reader.about:
        return reader.about["vehicle"]
    for message in reader.messages([f"{namespace}/mission"]):
        try:
            status = messages.decode(cdr.decode_string(message.data), Mission)
        except MessageError:
            continue
        simulated = not status.reason and (status.phase is Phase.READY or status.phase.is_over)
        return topics.SIMULATED if simulated else EXTERNAL
    return topics.SIMULATED


class Steps:
    """Iterates over the steps of all missions in a namespace, in order, in bounded memory.

    A step is released when it is complete and newer ones have come. An incomplete step waits for late
    messages, within `OPEN_MAX` and `OPEN_BYTES_MAX`. Poses later than `step_ns`, its duration, do not belong
    to a step.

    Raises:
        BagError: a topic has another type.
    """

    def __init__(self, reader: BagReader, namespace: str, step_ns: int = 2**63) -> None:
        self.rejected = Unreadable()  # messages that cannot be decoded, by topic and reason
        self.orphans: Counter[str] = Counter()  # messages that came too late for their step, by topic
        self.repeated: Counter[str] = Counter()  # repeated messages, by topic; poses are not counted
        self._reader, self._step_ns = reader, step_ns
        names = {f"{namespace}/{name}": name for name in STEP_TOPICS}
        self._topics = {full: name for full, name in names.items() if full in reader.topics}
        for full, name in self._topics.items():
            _check_type(reader, reader.topics[full], topics.TOPICS[name].type)
        self._expected = [name for full, name in self._topics.items() if reader.topics[full].count]
        self._open: dict[Key, RecordedStep] = {}
        self._bytes: dict[Key, int] = {}  # of the messages of open steps
        self._recent: dict[Key, frozenset[str]] = {}  # topics of the steps released last
        self._poses: deque[RecordedPose] = deque(maxlen=POSES_MAX)
        self._flight = 0
        # By topic: key, number of clock resets with publish time, and payload.
        self._newest: dict[str, tuple[Key, tuple[int, int], messages.Stepped]] = {}
        # Topic and publish time of each message of the flight's first step.
        self._starts: set[tuple[str, int]] = set()
        self._released: Key = (-1, -1, -1)  # the step released last
        self._released_over = True
        self._released_order = -1  # latest message of the released steps

    def __iter__(self) -> Iterator[RecordedStep]:
        """Start at the beginning of the bag; once."""
        for order, (clock_resets, message) in enumerate(self._reader.received(list(self._topics))):
            topic = self._topics[message.topic]
            try:
                if topic == "pose":
                    pose = read_pose(message)._replace(order=order)
                    self._poses.append(pose)
                    for step in self._open.values():
                        self._assign(step, pose)
                    continue
                payload = messages.decode(cdr.decode_string(message.data), messages.PAYLOADS[topic])
            except MessageError as error:
                self.rejected.add(topic, error)
                continue
            assert isinstance(payload, messages.Stepped), "the topics of steps"
            published = clock_resets, message.publish_time_ns
            if self._starts_flight(topic, payload, published):
                yield from self._release(wait=False)
                late = [pose for pose in self._poses if pose.order > self._released_order]
                self._poses = deque(late, POSES_MAX)
                self._flight += 1
                self._starts.clear()
            key = (self._flight, payload.mission, payload.step)
            if key[1:] == (0, 0):
                self._starts.add((topic, message.publish_time_ns))
            if topic not in self._newest or key >= self._newest[topic][0]:
                self._newest[topic] = key, published, payload
            if key <= self._released:
                known = topic in self._recent.get(key, ())
                (self.repeated if known else self.orphans)[topic] += 1
                continue
            self._add(key, topic, payload, message, order, clock_resets)
            yield from self._release(wait=True)
        yield from self._release(wait=False)

    def losses(self) -> Iterator[str]:
        """Messages that are part of no step, as text."""
        yield from self.rejected.lines()
        for topic, n in sorted(self.orphans.items()):
            yield f"{n:,} messages of {topic} came too late for their step"

    def _starts_flight(self, topic: str, payload: messages.Stepped, published: tuple[int, int]) -> bool:
        """Whether a message is the first one of another flight.

        Publishers go forward in steps. A first step after later ones starts a flight if it was published
        later. If it was published earlier, a middleware repeats it after a lost connection. A policy may
        answer such a repetition, so moves do not count.
        """
        if topic == "move" or topic not in self._newest or (payload.mission, payload.step) != (0, 0):
            return False
        (flight, *last), newest, before = self._newest[topic]
        if flight < self._flight or published <= newest or (topic, published[1]) in self._starts:
            return False
        if last > [0, 0]:
            return True
        if isinstance(payload, Mission) and payload.phase in GROUND:
            # A real vehicle, and the previous flight did not leave the ground.
            return isinstance(before, Mission) and before.phase.is_over
        return topic != "rates" and _identity(payload) != _identity(before)

    def _add(
        self, key: Key, topic: str, payload: messages.Stepped, message: BagMessage, order: int, resets: int
    ) -> None:
        """Add a payload to its open step, or count it as a repetition or conflict."""
        flight, mission, number = key
        step = self._open.setdefault(key, RecordedStep(flight=flight, mission=mission, step=number))
        self._bytes[key] = self._bytes.get(key, 0) + len(message.data)
        name = "status" if topic == "mission" else topic
        log_ns, publish_ns = message.log_time_ns, message.publish_time_ns
        before = getattr(step, name)
        if before is not None:
            if isinstance(payload, Mission) and with_progress_of(payload, before) == before:
                if not step.add_report(payload, log_ns, publish_ns, resets):
                    self.repeated[topic] += 1
                    return
                if not supersedes(payload, before, step.phase_reports[-1].publish_ns == publish_ns):
                    return
            elif payload == before:
                self.repeated[topic] += 1
                return
            else:
                known = step.conflicts.setdefault(topic, payload)
                if differ_in_time_only(known, before) and not differ_in_time_only(payload, before):
                    step.conflicts[topic] = payload
                return
        elif isinstance(payload, Mission):
            step.add_report(payload, log_ns, publish_ns, resets)
        setattr(step, name, payload)
        step.log_ns[topic], step.publish_ns[topic] = log_ns, publish_ns
        step.order = max(step.order, order)
        if topic == "users":
            step.clock_resets = resets
            for pose in self._poses:
                self._assign(step, pose)

    def _assign(self, step: RecordedStep, pose: RecordedPose) -> None:
        """Add a pose to a step if it is of the step's own time, by the rule of the channel monitor."""
        if step.users is None or not 0 <= pose.stamp_ns - step.users.stamp_ns < self._step_ns:
            return
        if len(step.poses) == STEP_POSES_MAX and pose.stamp_ns > step.poses[-1].stamp_ns:
            return  # a real vehicle publishes twenty a second
        if any(p.stamp_ns == pose.stamp_ns and (p.position_m == pose.position_m).all() for p in step.poses):
            return
        insort(step.poses, pose, key=attrgetter("stamp_ns"))
        del step.poses[STEP_POSES_MAX:]
        first = step.poses[0]
        step.position_m = first.position_m
        step.log_ns["pose"], step.publish_ns["pose"] = first.log_ns, first.publish_ns
        step.order = max(step.order, first.order)

    def _release(self, *, wait: bool) -> Iterator[RecordedStep]:
        while self._open:
            key = min(self._open)
            if wait:
                if len(self._open) <= NEWER_MIN:
                    return
                full = len(self._open) > OPEN_MAX or sum(self._bytes.values()) > OPEN_BYTES_MAX
                if not full and not self._is_complete(key):
                    return
            step = self._open.pop(key)
            del self._bytes[key]
            self._recent[key] = frozenset(step.log_ns)
            if len(self._recent) > RECENT_MAX:
                del self._recent[next(iter(self._recent))]
            self._released, self._released_over = key, _is_over(step)
            self._released_order = max(self._released_order, step.order)
            if step.users is not None:
                # A pose that was received after the step may be of another flight.
                start_ns, order = step.users.stamp_ns, step.order
                later = (pose for pose in self._poses if pose.stamp_ns > start_ns or pose.order > order)
                self._poses = deque(later, POSES_MAX)
            yield step

    def _is_complete(self, key: Key) -> bool:
        """Whether a step has a message of each topic and follows the step released last."""
        flight, mission, number = self._released
        follows = key[0] != flight or key == (flight, mission, number + 1) or self._released_over
        step = self._open[key]
        return follows and all(
            name in step.log_ns or (name == "move" and _is_over(step)) for name in self._expected
        )


def _is_over(step: RecordedStep) -> bool:
    return step.status is not None and step.status.phase.is_over


def _identity(payload: messages.Stepped) -> object:
    """What is equal in all repetitions of a flight's first step."""
    if isinstance(payload, messages.Users):  # a real vehicle's have the time of a pose
        return msgspec.structs.replace(payload, stamp_ns=0)
    return payload.seed if isinstance(payload, Mission) else payload


def _check_type(reader: BagReader, topic: RecordedTopic, type: str) -> None:
    """Raises BagError for a topic that does not have our type as ROS 2 Jazzy defines it."""
    where = f"bag {reader.path}: topic {topic.name}"
    if topic.other_types:
        types = ", ".join(sorted((topic.type, *topic.other_types)))
        raise BagError(f"{where} has the types {types}; expected {type} only")
    if (topic.type, topic.serialization) != (type, "cdr"):
        encoding = topic.serialization or "no encoding"
        raise BagError(f"{where} is of type {topic.type or '(none)'} ({encoding}); expected {type} (cdr)")
    if not matches_jazzy(type, topic.encoding, topic.definition):
        raise BagError(f"{where}: its definition of {type} differs from that of ROS 2 Jazzy")


def read_pose(message: BagMessage) -> RecordedPose:
    """Read a pose; raises MessageError if the message holds none in the frame `map`."""
    pose = cdr.Pose(message.data)
    position_m = np.asarray(pose.position_m, dtype=np.float64)
    return RecordedPose(pose.stamp_ns, position_m, message.log_time_ns, message.publish_time_ns)
