"""Content of a bag: its topics, its missions, and what is missing.

Bags of any recorder, torn ones included, in two passes: one over all messages, one over the steps.
"""

from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from uav_dc_ros import topics
from uav_dc_ros.bags.message_definitions import typestore
from uav_dc_ros.bags.metadata import LOST_BYTES_KEY, METADATA_FILE, Part, matches_metadata, read_metadata
from uav_dc_ros.bags.read import BagMessage, BagReader
from uav_dc_ros.bags.records import TIME_MAX_NS
from uav_dc_ros.bags.storage import Storage
from uav_dc_ros.errors import BagDamagedError, BagError, UavDcError
from uav_dc_ros.messages import printable
from uav_dc_ros.recordings.marks import Mark, read_marks
from uav_dc_ros.recordings.recorded_step import MissionTotals, RecordedStep, mission_name
from uav_dc_ros.recordings.step_reader import STEP_TOPICS, Steps, namespaces, scenario

HARDWARE_ID = "uav_dc_ros"  # of our nodes' diagnostics
DAMAGES_MAX = 3  # damaged places of a file that are listed one by one


@dataclass(kw_only=True)
class TopicSurvey:
    """A topic; None where it has too few messages."""

    name: str
    type: str
    other_types: list[str]  # further types of its messages; ROS 2 allows one only
    messages: int = 0
    dropped: int  # messages that the recorder received and lost, by its own count
    first_s: float | None = None  # log times after the bag's first message
    last_s: float | None = None
    mean_hz: float | None = None  # between the first and the last message
    gap_s: float | None = None  # longest time between two messages
    gap_at_s: float | None = None  # start of that gap


@dataclass(kw_only=True)
class PartSurvey:
    """A file of a bag."""

    name: str
    messages: int  # all messages in the file
    repeated: int  # messages that repeat latched ones of earlier parts; not counted in the bag
    library: str  # the writer, as it names itself
    has_end: bool  # whether the file is finished
    has_index: bool  # whether the file has an index of its messages; optional in MCAP
    lost_bytes: int  # unusable bytes


@dataclass(kw_only=True)
class MissionSurvey(MissionTotals):
    """A mission. Before its end, `reason` is that of the latest phase report."""

    namespace: str  # without a slash at its end
    flight: int  # counts runs in the bag from 0
    mission: int
    missing: Counter[str] = field(default_factory=Counter)  # messages that the bag lacks, by topic
    # Users not collected at the last rates, by name or number; null where users have no names
    not_collected: list[str] | None = None


@dataclass(kw_only=True)
class Survey:
    """A bag."""

    path: str
    complete: bool  # whether nothing is known to be missing
    problems: list[str]  # what is missing, a line each
    recoverable: bool  # whether `recover` makes a whole bag of it
    size_bytes: int
    start_ns: int  # log time of the first message, since the epoch
    duration_s: float
    set_back_s: float  # largest step back of the recorder's clock; 0: none
    compressed: list[str]  # topics whose messages rosbag2 compressed one by one
    json_channels: list[str]  # topics whose payloads are recorded as JSON
    messages: int
    parts: list[PartSurvey]
    topics: list[TopicSurvey]
    missions: list[MissionSurvey]
    restarts: dict[str, int]  # restarts of nodes during the recording
    marks: list[Mark]  # annotations
    ros_distro: str | None  # of metadata.yaml
    about: dict[str, str]  # metadata that our recorder wrote


def survey(path: Path) -> Survey:
    """Survey a bag; raises BagError if there is none, or nothing in it can be read."""
    try:
        with BagReader(path) as reader:
            return _survey(reader, None)
    except BagDamagedError as error:
        with BagReader(path, torn=True) as reader:
            if not (reader.topics or reader.about):
                raise
            return _survey(reader, error)


def _survey(reader: BagReader, error: BagDamagedError | None) -> Survey:
    """Survey an open bag; `error`: why it is opened as a torn one."""
    problems = [problem for storage in reader.storages for problem in _damages(storage)]
    recoverable = bool(problems) or error is not None
    if error is not None and not problems:
        problems.append(str(error))
    metadata: dict[str, Any] = {}
    if reader.path.is_dir():
        try:
            metadata = read_metadata(reader.path) or {}
            problems += _metadata_problems(reader, bool(metadata))
        except BagError as unreadable:
            problems.append(str(unreadable))
    for storage in reader.storages:
        if LOST_BYTES_KEY in storage.about:
            lost = f"without {storage.about[LOST_BYTES_KEY][:40]} bytes of its source"
            problems.append(f"{storage.path.name} was recovered, {lost}")
    dropped = reader.dropped or {}
    problems += [f"{n:,} messages of {topic} were dropped" for topic, n in sorted(dropped.items()) if n]
    found, restarts = _topics(reader, dropped)
    for topic in found:
        indexed = reader.topics[topic.name].count if topic.name in reader.topics else 0
        if indexed != topic.messages:
            problems.append(f"{topic.name} has {topic.messages:,} messages; its index lists {indexed:,}")
    if reader.last_ns == TIME_MAX_NS:
        problems.append("some message times exceed the limit of ROS 2 (2^63 ns): shown as the limit")
    missions = [one for name in namespaces(reader) for one in survey_missions(reader, name, problems)]
    distro = metadata.get("ros_distro")
    return Survey(
        path=printable(str(reader.path)),
        complete=not problems,
        problems=[printable(problem) for problem in problems],
        recoverable=recoverable,
        size_bytes=sum(part.stat().st_size for part in reader.parts),
        start_ns=reader.first_ns,
        duration_s=(reader.last_ns - reader.first_ns) / 1e9,
        set_back_s=reader.set_back_ns / 1e9,
        compressed=sorted({topic for storage in reader.storages for topic in storage.compressed}),
        json_channels=sorted(name for name, topic in reader.topics.items() if topic.is_json),
        messages=sum(topic.messages for topic in found),
        parts=[
            PartSurvey(
                name=printable(storage.path.name),
                messages=sum(topic.count for topic in storage.topics) + sum(storage.repeated.values()),
                repeated=sum(storage.repeated.values()),
                library=storage.library,
                has_end=storage.has_end,
                has_index=storage.has_index,
                lost_bytes=sum(damage.n_bytes for damage in storage.damages),
            )
            for storage in reader.storages
        ],
        topics=found,
        missions=missions,
        restarts=restarts,
        marks=read_marks(reader),
        ros_distro=distro if isinstance(distro, str) and distro else None,
        about=reader.about,
    )


def _damages(storage: Storage) -> Iterator[str]:
    if not storage.has_end:
        yield f"{storage.path.name} has no end: its recorder was killed, or is still writing"
    for damage in storage.damages[:DAMAGES_MAX]:
        yield f"{storage.path.name}: {damage.n_bytes:,} bytes lost at byte {damage.at:,}: {damage.reason}"
    if more := storage.damages[DAMAGES_MAX:]:
        n_bytes = sum(damage.n_bytes for damage in more)
        yield f"{storage.path.name}: {n_bytes:,} bytes lost at {len(more):,} more places"


def _metadata_problems(reader: BagReader, described: bool) -> Iterator[str]:
    """Compare metadata.yaml to the parts of the bag; `described`: whether it describes a bag."""
    if not described:
        exists = (reader.path / METADATA_FILE).exists()
        yield f"{METADATA_FILE} {'describes no bag' if exists else 'is missing'}"
        return
    parts = []
    for storage in reader.storages:
        part = Part(storage.path.name)
        for topic in storage.topics:
            part.topics[topic.name] = {"offered_qos_profiles": []}
            part.counts[topic.name] = topic.count + storage.repeated.get(topic.name, 0)
        parts.append(part)
    if not matches_metadata(reader.path, parts):
        yield f"{METADATA_FILE} lists other files, or other numbers of messages, than the bag has"


@dataclass
class _Times:
    """Log times of a topic, nanoseconds since the epoch."""

    n: int = 0
    first_ns: int = 0
    last_ns: int = 0
    gap_ns: int = -1
    gap_at_ns: int = 0

    def add(self, log_time_ns: int) -> None:
        if self.n == 0:
            self.first_ns = self.last_ns = log_time_ns
        elif log_time_ns - self.last_ns > self.gap_ns:
            self.gap_ns, self.gap_at_ns = log_time_ns - self.last_ns, self.last_ns
        self.last_ns = max(self.last_ns, log_time_ns)
        self.n += 1


def _topics(reader: BagReader, dropped: dict[str, int]) -> tuple[list[TopicSurvey], dict[str, int]]:
    """One pass over all messages: topics, and restarts by node."""
    times = {name: _Times() for name in reader.topics}
    restarts: dict[str, int] = {}
    for message in reader.messages():
        times[message.topic].add(message.log_time_ns)
        if message.type == topics.DIAGNOSTICS:
            for node, n in _restarts(message):
                restarts[node] = max(n, restarts.get(node, 0))
    found = []
    for name in sorted({*reader.topics, *dropped}):
        topic = TopicSurvey(name=name, type="", other_types=[], dropped=dropped.get(name, 0))
        if known := reader.topics.get(name):
            topic.type, topic.other_types = known.type, list(known.other_types)
        found.append(topic)
        of_topic = times.get(name, _Times())
        topic.messages = of_topic.n
        if of_topic.n:
            topic.first_s = (of_topic.first_ns - reader.first_ns) / 1e9
            topic.last_s = (of_topic.last_ns - reader.first_ns) / 1e9
        if of_topic.n > 1:
            span_ns = of_topic.last_ns - of_topic.first_ns
            topic.mean_hz = (of_topic.n - 1) * 1e9 / span_ns if span_ns else None
            topic.gap_s, topic.gap_at_s = of_topic.gap_ns / 1e9, (of_topic.gap_at_ns - reader.first_ns) / 1e9
    return found, {node: n for node, n in sorted(restarts.items()) if n}


def _restarts(message: BagMessage) -> Iterator[tuple[str, int]]:
    """Nodes in a diagnostics message, with the number of their restarts."""
    try:
        array: Any = typestore().deserialize_cdr(message.data, topics.DIAGNOSTICS)
    except Exception:  # of struct, numpy, rosbags: unreadable diagnostics of another system
        return
    namespace = message.topic.removesuffix("/diagnostics").removeprefix("/")
    prefix = f"{namespace}/" if namespace else ""
    for status in array.status:
        for pair in status.values if status.hardware_id == HARDWARE_ID else ():
            if not pair.value.isdecimal():
                continue
            if pair.key == "restarts":
                yield prefix + status.name, int(pair.value)
            elif pair.key.startswith("restarts of "):
                yield prefix + pair.key.removeprefix("restarts of "), int(pair.value)


def survey_missions(reader: BagReader, namespace: str, problems: list[str]) -> list[MissionSurvey]:
    """The missions of a namespace; adds what they lack to `problems`."""
    where = f" in {namespace}" if namespace else ""
    found: list[MissionSurvey] = []
    step_ns, names = 2**63, None  # of an unknown scenario, in a bag of another recorder
    with suppress(UavDcError):
        world = scenario(reader, namespace)
        step_ns, names = world.step_ns, world.users.names
    try:
        steps = Steps(reader, namespace, step_ns)
        before: RecordedStep | None = None
        for step in steps:
            if before is None or (before.flight, before.mission) != (step.flight, step.mission):
                found.append(MissionSurvey(namespace=namespace, flight=step.flight, mission=step.mission))
                next_step = 0
            else:
                next_step = before.step + 1
                found[-1].missing.update(_missing(before, last=False))
            mission = found[-1]
            if step.step > next_step:
                mission.missing.update(dict.fromkeys(STEP_TOPICS, step.step - next_step))
            mission.add(step.step, step.status, step.rates)
            if names is not None and step.rates is not None and len(step.rates.collected) == len(names):
                users = zip(names, step.rates.collected, strict=True)
                left = [name or str(i) for i, (name, collected) in enumerate(users) if not collected]
                mission.not_collected = left
            if step.status is not None and not mission.is_over:
                mission.reason = step.phase_reports[-1].reason if step.phase_reports else ""
            before = step
            if step.status is not None and step.status.phase.is_over:
                mission.missing.update(_missing(step, last=True))
        problems += (f"{line}{where}" for line in steps.rejected.lines())
    except BagDamagedError:
        raise
    except BagError as error:
        problems.append(str(error))
    missing = sum((mission.missing for mission in found), Counter())
    if missing:
        listed = ", ".join(f"{n:,} {topic}" for topic, n in missing.items())
        problems.append(f"steps{where} lack messages: {listed}")
    for mission in found:
        if not mission.is_over:
            name = mission_name(mission.mission, mission.flight)
            problems.append(f"{name}{where} has no end; its last step is {mission.steps}")
    wanted = reader.about.get("missions", "")
    n_over = len({mission.mission for mission in found if mission.is_over})
    if found and wanted.isdecimal() and n_over < int(wanted):
        problems.append(f"{n_over:,} of {int(wanted):,} missions{where} have an end")
    return found


def _missing(step: RecordedStep, *, last: bool) -> list[str]:
    """Topics without a message of this step. The last step has no move."""
    has = {
        "pose": step.position_m is not None or not step.is_measured,
        "users": step.users is not None or not step.is_measured,
        "rates": step.rates is not None or not step.is_measured,
        "mission": step.status is not None,
        "move": step.move is not None or last,
    }
    return [topic for topic, recorded in has.items() if not recorded]
