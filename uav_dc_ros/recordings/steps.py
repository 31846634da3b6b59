"""The steps of recorded missions, brought together from the topics of one namespace, as a stream.

Messages of a step lie in a bag in any order, some are repeated (a lockstep that stood still), and some are
missing (a pose that was lost on the way). Each step is handed out once, with what there is of it.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from uav_dc_ros import messages, payloads, scenarios, topics
from uav_dc_ros.bags.definitions import TYPESTORE, is_defined_so
from uav_dc_ros.bags.read import BagMessage, BagReader, RecordedTopic
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.scenario import Scenario, from_values
from uav_dc_ros.errors import BagError, MessageError, ScenarioError

FRAME = "map"
STEP_TOPICS = ("pose", "users", "rates", "mission", "move")
OPEN_MAX = 3  # newest steps that may still get messages; older ones are handed out


@dataclass(kw_only=True)
class RecordedStep:
    """One step of a mission; None for what the bag does not have.

    Attributes:
        flight: counts from 0, one up whenever mission 0 begins again: two runs in one bag.
        mission, step: index of the mission in its flight, steps flown.
        position_m: x, y, altitude of the first pose of the step's own time, metres, `[3]`.
        users, rates, status, move: the payloads; of repeated ones the first.
        log_ns: when each was received, nanoseconds since the epoch, by topic.
        publish_ns: when each was published, by topic.
    """

    flight: int
    mission: int
    step: int
    position_m: Array | None = None
    users: messages.Users | None = None
    rates: messages.Rates | None = None
    status: messages.Mission | None = None
    move: messages.Move | None = None
    log_ns: dict[str, int] = field(default_factory=dict)
    publish_ns: dict[str, int] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The step in words."""
        flight = f" of flight {self.flight}" if self.flight else ""
        return f"mission {self.mission}, step {self.step}{flight}"


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

    Args:
        reader: of the bag.
        namespace: as `namespace` gives it.
        step_ns: duration of a step: a pose that is later than its step is none of it.

    Raises:
        BagError: a topic of that name is of another type.

    Attributes:
        rejected: messages that could not be read, by topic and reason.
        orphans: messages that came when their step was handed out already, by topic.
    """

    def __init__(self, reader: BagReader, namespace: str, step_ns: int = 2**63) -> None:
        self.rejected: Counter[tuple[str, str]] = Counter()
        self.orphans: Counter[str] = Counter()
        self._reader = reader
        self._step_ns = step_ns
        self._topics = {f"{namespace}/{name}": name for name in STEP_TOPICS}
        for full, name in self._topics.items():
            if full in reader.topics:
                _expect(reader, reader.topics[full], topics.TOPICS[name].type)
        self._open: dict[tuple[int, int, int], RecordedStep] = {}
        self._poses: list[tuple[int, Array, BagMessage]] = []  # stamp, position
        self._flight = 0
        self._done = (-1, -1, -1)  # the step handed out last
        self._last_log_ns = 0  # when its latest message was received

    def __iter__(self) -> Iterator[RecordedStep]:
        """Start at the beginning of the bag; once."""
        for message in self._reader.messages([name for name in self._topics if name in self._reader.topics]):
            topic = self._topics[message.topic]
            try:
                if topic == "pose":
                    position = _pose(message)
                    self._poses.append((*position, message))
                    continue
                payload = messages.decode(payloads.text_in_cdr(message.data), messages.PAYLOADS[topic])
            except MessageError as error:
                self.rejected[topic, error.reason] += 1
                continue
            assert isinstance(payload, messages.Stepped), "the topics of steps"
            if self._begins_again(payload, message):
                yield from self._hand_out(keep=0)
                self._poses = [pose for pose in self._poses if pose[2].log_time_ns > self._last_log_ns]
                self._flight += 1
            key = (self._flight, payload.mission, payload.step)
            if key <= self._done:
                self.orphans[topic] += 1
                continue
            self._enter(self._step(key), topic, payload, message)
            yield from self._hand_out(keep=OPEN_MAX)
        yield from self._hand_out(keep=0)

    def _step(self, key: tuple[int, int, int]) -> RecordedStep:
        if key not in self._open:
            flight, mission, step = key
            self._open[key] = RecordedStep(flight=flight, mission=mission, step=step)
        return self._open[key]

    def _enter(self, step: RecordedStep, topic: str, payload: Any, message: BagMessage) -> None:
        name = "status" if topic == "mission" else topic
        if getattr(step, name) is None:
            setattr(step, name, payload)
            step.log_ns[topic] = message.log_time_ns
            step.publish_ns[topic] = message.publish_time_ns

    def _begins_again(self, payload: messages.Stepped, message: BagMessage) -> bool:
        """Is it the first word of another flight: the vehicle is at the start, and had been further."""
        newest = max([*self._open, self._done])
        begins = isinstance(payload, messages.Users) and (payload.mission, payload.step) == (0, 0)
        return begins and newest[0] == self._flight and newest[1:] > (0, OPEN_MAX)

    def _hand_out(self, keep: int) -> Iterator[RecordedStep]:
        for key in sorted(self._open)[: max(0, len(self._open) - keep)]:
            step = self._open.pop(key)
            self._place(step)
            self._done = key
            self._last_log_ns = max(step.log_ns.values())
            yield step

    def _place(self, step: RecordedStep) -> None:
        """Find the pose of a step: the first one that is not older than its users, as the monitor does."""
        if step.users is None:
            return
        begun_ns = step.users.stamp_ns
        fitting = [pose for pose in self._poses if 0 <= pose[0] - begun_ns < self._step_ns]
        if not fitting:
            return
        _, position_m, message = min(fitting, key=lambda pose: pose[0])
        step.position_m = position_m
        step.log_ns["pose"], step.publish_ns["pose"] = message.log_time_ns, message.publish_time_ns
        self._poses = [pose for pose in self._poses if pose[0] > begun_ns]


def _expect(reader: BagReader, topic: RecordedTopic, type: str) -> None:
    """Raises BagError for a topic that is not of our type, as ROS 2 Jazzy defines it."""
    if (topic.type, topic.serialization) != (type, "cdr"):
        raise BagError(
            f"bag {reader.path}: topic {topic.name} is of type {topic.type or '(none)'} "
            f"({topic.serialization or 'no encoding'}); expected {type} (cdr)"
        )
    if not is_defined_so(type, topic.encoding, topic.definition):
        raise BagError(
            f"bag {reader.path}: topic {topic.name}: its definition of {type} is another one than that of "
            "ROS 2 Jazzy"
        )


def _pose(message: BagMessage) -> tuple[int, Array]:
    """Stamp and position of a pose.

    Raises:
        MessageError: no pose, or none in the frame `map`.
    """
    try:
        pose: Any = TYPESTORE.deserialize_cdr(message.data, topics.POSE)
    except Exception as error:  # of struct, numpy, rosbags: whatever the bytes make of it
        raise MessageError("malformed", str(error)) from None
    header, point = pose.header, pose.pose.position
    if header.frame_id != FRAME:
        raise MessageError("frame", f"frame {header.frame_id[:64]!r}; expected {FRAME!r}")
    position_m = np.asarray([point.x, point.y, point.z], dtype=np.float64)
    if not np.isfinite(position_m).all():
        raise MessageError("not_finite", f"position {position_m.tolist()}; expected finite metres")
    return header.stamp.sec * 10**9 + header.stamp.nanosec, position_m
