"""The steps of recorded missions, brought together from the topics of one namespace, as a stream.

Messages of a step lie in a bag in any order, some are repeated (a lockstep that stood still), and some are
missing (a pose that was lost on the way). Each step is handed out once, with what there is of it.
"""

from bisect import insort
from collections import Counter, deque
from collections.abc import Iterator
from pathlib import Path
from typing import TypeAlias

import msgspec
import numpy as np

from uav_dc_ros import cdr, messages, scenarios, topics
from uav_dc_ros.bags.message_definitions import matches_jazzy
from uav_dc_ros.bags.read import BagMessage, BagReader, RecordedTopic
from uav_dc_ros.bags.unreadable import Unreadable
from uav_dc_ros.core.scenario import Scenario, from_values
from uav_dc_ros.errors import BagError, MessageError, ScenarioError
from uav_dc_ros.messages import Mission
from uav_dc_ros.phases import GROUND
from uav_dc_ros.recordings.recorded_step import (
    POSES_KEPT,
    RecordedPose,
    RecordedStep,
    is_later_only,
    is_same_status,
    outweighs,
)

STEP_TOPICS = ("pose", "users", "rates", "mission", "move")
NEWER_MIN = 3  # newest steps: they may still get messages, whole or not
OPEN_MAX = 256  # steps that are held while the oldest lacks something
OPEN_BYTES_MAX = 64 * 2**20  # of their messages
RECENT_MAX = 1000  # steps handed out, of which is known what they had: as many as a latched topic repeats
POSES_MAX = 10_000  # poses whose users have not come

Key: TypeAlias = tuple[int, int, int]  # flight, mission, step


def namespaces(reader: BagReader) -> list[str]:
    """Namespaces of the missions in a bag: those with a `mission` of our type. The root is the empty text."""
    ending = "/mission"
    return sorted(
        topic.name.removesuffix(ending)
        for topic in reader.topics.values()
        if topic.name.endswith(ending) and topic.type == topics.JSON
    )


def namespace(reader: BagReader, wanted: str | None = None) -> str:
    """The namespace to look at: the one wanted, or the only one.

    Raises:
        BagError: no mission was recorded there, or there are several and none was wanted.
    """
    found = namespaces(reader)
    told = ", ".join(name or "/" for name in found)
    if wanted is not None:
        name = "/" + wanted.strip("/") if wanted.strip("/") else ""
        if name not in found:
            raise BagError(f"bag {reader.path}: no mission in namespace {wanted!r}; expected {told or 'one'}")
        return name
    if not found:
        raise BagError(
            f"bag {reader.path} holds no mission: no topic `mission` of type {topics.JSON}; its topics are "
            f"{', '.join(sorted(reader.topics)) or '(none)'}"
        )
    if len(found) > 1:
        raise BagError(f"bag {reader.path} holds missions in {told}; expected one of them: --namespace")
    return found[0]


def scenario(reader: BagReader, name: str, wanted: str | Path | None = None) -> Scenario:
    """The world of the missions in namespace `name`: the one wanted, the bag's own, or a shipped one.

    Raises:
        BagError: the bag does not hold it, and no shipped one has the fingerprint that its missions tell.
        ScenarioError: the one wanted, or the bag's own, cannot be read.
    """
    if wanted is not None:
        return scenarios.load(wanted)
    values = reader.about.get("scenario_values")
    if values is not None:
        try:
            return from_values(msgspec.json.decode(values), f"bag {reader.path}: scenario_values")
        except msgspec.DecodeError as error:
            raise ScenarioError(f"bag {reader.path}: scenario_values: {error}") from None
    told = ""
    for step in Steps(reader, name):
        if step.status is not None:
            told = f", and its missions fly {step.status.scenario!r} ({step.status.fingerprint})"
            for shipped in map(scenarios.load, scenarios.names()):
                if shipped.fingerprint == step.status.fingerprint:
                    return shipped
            break
    raise BagError(f"bag {reader.path} does not tell its scenario{told}; expected --scenario NAME|FILE")


class Steps:
    """Iterates over the steps of all missions in a namespace, in order; a few are in memory at a time.

    A step is handed out when it is whole and newer ones have come. One that lacks something waits for it,
    since a message that was lost and sent again comes late, but not for ever: see `OPEN_MAX`.

    Args:
        reader: of the bag.
        namespace: as `namespace` gives it.
        step_ns: duration of a step: a pose that is later than its step is none of it.

    Raises:
        BagError: a topic of that name is of another type.

    Attributes:
        rejected: messages that could not be read, by topic and reason.
        orphans: messages that came when their step was handed out without them, by topic.
        repeated: messages that said once more what was said before, by topic. Poses are not counted.
    """

    def __init__(self, reader: BagReader, namespace: str, step_ns: int = 2**63) -> None:
        self.rejected = Unreadable()
        self.orphans: Counter[str] = Counter()
        self.repeated: Counter[str] = Counter()
        self._reader = reader
        self._step_ns = step_ns
        self._topics = {
            f"{namespace}/{name}": name for name in STEP_TOPICS if f"{namespace}/{name}" in reader.topics
        }
        for full, name in self._topics.items():
            _expect(reader, reader.topics[full], topics.TOPICS[name].type)
        self._awaited = [name for full, name in self._topics.items() if reader.topics[full].count]
        self._open: dict[Key, RecordedStep] = {}
        self._bytes: dict[Key, int] = {}  # of the messages of open steps
        self._recent: dict[Key, frozenset[str]] = {}  # what the steps handed out last had
        self._poses: deque[RecordedPose] = deque(maxlen=POSES_MAX)
        self._flight = 0
        # By topic: key, how often the clock had been set back, and publish time.
        self._newest: dict[str, tuple[Key, tuple[int, int], messages.Stepped]] = {}
        self._starts: set[tuple[str, int]] = (
            set()
        )  # topic and publish time of each word on the flight's start
        self._done: Key = (-1, -1, -1)  # the step handed out last
        self._done_over = True
        self._last_place = -1  # of the latest message of those handed out

    def __iter__(self) -> Iterator[RecordedStep]:
        """Start at the beginning of the bag; once."""
        for place, (clock, message) in enumerate(self._reader.received(list(self._topics))):
            topic = self._topics[message.topic]
            try:
                if topic == "pose":
                    self._hear_pose(read_pose(message)._replace(place=place))
                    continue
                payload = messages.decode(cdr.decode_string(message.data), messages.PAYLOADS[topic])
            except MessageError as error:
                self.rejected.add(topic, error)
                continue
            assert isinstance(payload, messages.Stepped), "the topics of steps"
            published = clock, message.publish_time_ns
            if self._begins_again(topic, payload, published):
                yield from self._hand_out(wait=False)
                late = [pose for pose in self._poses if pose.place > self._last_place]
                self._poses = deque(late, POSES_MAX)
                self._flight += 1
                self._starts.clear()
            key = (self._flight, payload.mission, payload.step)
            if key[1:] == (0, 0):
                self._starts.add((topic, message.publish_time_ns))
            if topic not in self._newest or key >= self._newest[topic][0]:
                self._newest[topic] = key, published, payload
            if key <= self._done:
                known = topic in self._recent.get(key, ())
                (self.repeated if known else self.orphans)[topic] += 1
                continue
            self._enter(key, topic, payload, message, place, clock)
            yield from self._hand_out(wait=True)
        yield from self._hand_out(wait=False)

    def _begins_again(self, topic: str, payload: messages.Stepped, published: tuple[int, int]) -> bool:
        """Whether it is the first word of another flight.

        Who tells steps goes forward. A start that is told after later steps, and was published later, is that
        of another flight; one that was published earlier is what a middleware repeats that lost its peer for
        a while. A policy may answer such a repetition, so moves tell nothing.
        """
        if topic == "move" or topic not in self._newest or (payload.mission, payload.step) != (0, 0):
            return False
        (flight, *last), newest, before = self._newest[topic]
        if flight < self._flight or published <= newest or (topic, published[1]) in self._starts:
            return False
        if last > [0, 0]:
            return True
        if isinstance(payload, Mission) and payload.phase in GROUND:
            # Of a real vehicle, and the flight before never left the ground.
            return isinstance(before, Mission) and before.phase.is_over
        return topic != "rates" and _start(payload) != _start(before)

    def _enter(
        self, key: Key, topic: str, payload: messages.Stepped, message: BagMessage, place: int, clock: int
    ) -> None:
        flight, mission, number = key
        step = self._open.setdefault(key, RecordedStep(flight=flight, mission=mission, step=number))
        self._bytes[key] = self._bytes.get(key, 0) + len(message.data)
        name = "status" if topic == "mission" else topic
        before = getattr(step, name)
        if before is not None:
            if isinstance(payload, Mission) and is_same_status(payload, before):
                if not step.tell(payload, message.log_time_ns, message.publish_time_ns, clock):
                    self.repeated[topic] += 1
                    return
                newer = step.told[-1].publish_ns == message.publish_time_ns
                if not outweighs(payload, before, newer):
                    return
            elif payload == before:
                self.repeated[topic] += 1
                return
            else:
                known = step.others.get(topic)
                if known is None or (is_later_only(known, before) and not is_later_only(payload, before)):
                    step.others[topic] = payload
                return
        elif isinstance(payload, Mission):
            step.tell(payload, message.log_time_ns, message.publish_time_ns, clock)
        setattr(step, name, payload)
        step.log_ns[topic], step.publish_ns[topic] = message.log_time_ns, message.publish_time_ns
        step.place = max(step.place, place)
        if topic == "users":
            step.clock = clock
            for pose in self._poses:
                self._offer(step, pose)

    def _hear_pose(self, pose: RecordedPose) -> None:
        self._poses.append(pose)
        for step in self._open.values():
            self._offer(step, pose)

    def _offer(self, step: RecordedStep, pose: RecordedPose) -> None:
        """Give a pose to a step, if it is of the step's own time, as the monitor has it."""
        if step.users is None or not 0 <= pose.stamp_ns - step.users.stamp_ns < self._step_ns:
            return
        if len(step.poses) == POSES_KEPT and pose.stamp_ns > step.poses[-1].stamp_ns:
            return  # a real vehicle tells twenty a second
        if any(p.stamp_ns == pose.stamp_ns and (p.position_m == pose.position_m).all() for p in step.poses):
            return
        insort(step.poses, pose, key=lambda one: one.stamp_ns)
        del step.poses[POSES_KEPT:]
        first = step.poses[0]
        step.position_m = first.position_m
        step.log_ns["pose"], step.publish_ns["pose"] = first.log_ns, first.publish_ns
        step.place = max(step.place, first.place)

    def _hand_out(self, *, wait: bool) -> Iterator[RecordedStep]:
        while self._open:
            key = min(self._open)
            if wait:
                if len(self._open) <= NEWER_MIN:
                    return
                full = len(self._open) > OPEN_MAX or sum(self._bytes.values()) > OPEN_BYTES_MAX
                if not full and not self._is_whole(key):
                    return
            step = self._open.pop(key)
            del self._bytes[key]
            self._recent[key] = frozenset(step.log_ns)
            if len(self._recent) > RECENT_MAX:
                del self._recent[next(iter(self._recent))]
            self._done, self._done_over = key, step.status is not None and step.status.phase.is_over
            self._last_place = max(self._last_place, step.place)
            if step.users is not None:
                self._forget_poses(step.users.stamp_ns, step.place)
            yield step

    def _forget_poses(self, begun_ns: int, place: int) -> None:
        """Drop poses up to a step's begin; one that was received after the step may be another flight's."""
        kept = (p for p in self._poses if p.stamp_ns > begun_ns or p.place > place)
        self._poses = deque(kept, POSES_MAX)

    def _is_whole(self, key: Key) -> bool:
        """Has a step all that it can have, and does it follow the one before."""
        flight, mission, number = self._done
        follows = key[0] != flight or key == (flight, mission, number + 1) or self._done_over
        step = self._open[key]
        over = step.status is not None and step.status.phase.is_over
        return follows and all(name in step.log_ns or (name == "move" and over) for name in self._awaited)


def _start(payload: messages.Stepped) -> object:
    """What stays the same when a flight tells its start again."""
    if isinstance(payload, messages.Users):  # a real vehicle's have the time of a pose
        return msgspec.structs.replace(payload, stamp_ns=0)
    return payload.seed if isinstance(payload, Mission) else payload


def _expect(reader: BagReader, topic: RecordedTopic, type: str) -> None:
    """Raises BagError for a topic that is not of our type, as ROS 2 Jazzy defines it."""
    if topic.other_types:
        types = ", ".join(sorted((topic.type, *topic.other_types)))
        raise BagError(f"bag {reader.path}: topic {topic.name} is of the types {types}; expected {type} only")
    if (topic.type, topic.serialization) != (type, "cdr"):
        raise BagError(
            f"bag {reader.path}: topic {topic.name} is of type {topic.type or '(none)'} "
            f"({topic.serialization or 'no encoding'}); expected {type} (cdr)"
        )
    if not matches_jazzy(type, topic.encoding, topic.definition):
        raise BagError(
            f"bag {reader.path}: topic {topic.name}: its definition of {type} is another one than that of "
            "ROS 2 Jazzy"
        )


def read_pose(message: BagMessage) -> RecordedPose:
    """The pose in a message.

    Raises:
        MessageError: no pose, or none in the frame `map`.
    """
    pose = cdr.Pose(message.data)
    position_m = np.asarray(pose.position_m, dtype=np.float64)
    return RecordedPose(pose.stamp_ns, position_m, message.log_time_ns, message.publish_time_ns)
