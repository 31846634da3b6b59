"""What a bag holds and what it lacks: its topics, its missions, and whether it is complete.

Whole bags and torn ones, ours and others, in two passes: one over all messages, one over the steps.
"""

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from uav_dc_ros import topics
from uav_dc_ros.bags.message_definitions import typestore
from uav_dc_ros.bags.metadata import LOST_BYTES_KEY, METADATA_FILE, Part, matches_metadata, read_metadata
from uav_dc_ros.bags.read import BagMessage, BagReader
from uav_dc_ros.bags.records import TIME_MAX_NS
from uav_dc_ros.bags.storage import Storage
from uav_dc_ros.errors import BagDamagedError, BagError
from uav_dc_ros.recordings.info.missions import MissionSurvey, look_through, mission_problems
from uav_dc_ros.recordings.recorded_step import printable
from uav_dc_ros.recordings.step_reader import namespaces

HARDWARE_ID = "uav_dc_ros"  # of our nodes' diagnostics
TOLD_MAX = 3  # damaged places of a file that are told one by one


@dataclass(kw_only=True)
class TopicSurvey:
    """A topic: its messages, and how they follow each other by their log times.

    Attributes:
        other_types: further types of its messages; ROS 2 allows one only.
        messages: how many.
        dropped: messages that the recorder heard of, but does not have, as it says itself.
        first_s, last_s: log times after the bag's first message, seconds; None without messages.
        mean_hz: messages per second between the first and the last; None below two.
        gap_s: longest time without a message between two, seconds; None below two.
        gap_at_s: when it began.
    """

    name: str
    type: str
    other_types: list[str] = field(default_factory=list)
    messages: int = 0
    dropped: int = 0
    first_s: float | None = None
    last_s: float | None = None
    mean_hz: float | None = None
    gap_s: float | None = None
    gap_at_s: float | None = None


@dataclass(kw_only=True)
class PartSurvey:
    """A file of a bag.

    Attributes:
        messages: all that it holds.
        repeated: those of them that repeat latched messages of earlier parts; the bag's are without these.
        library: what wrote it, in its own words.
        has_end: whether it is finished.
        has_index: whether it tells where its messages are; MCAP leaves that to the writer.
        lost_bytes: what of it cannot be used.
    """

    name: str
    messages: int
    repeated: int
    library: str
    has_end: bool
    has_index: bool
    lost_bytes: int


@dataclass(kw_only=True)
class Survey:
    """What a bag holds and lacks.

    Attributes:
        complete: whether nothing is known to be missing.
        problems: what is missing, a line each.
        recoverable: whether `recover` makes a whole bag of it.
        set_back_s: by how much the clock was set back, at most, while it was recorded; 0: never.
        compressed: topics of whose messages rosbag2 compressed each by itself.
        start_ns: log time of the first message, nanoseconds since the epoch.
        restarts: how often nodes were started again while it was recorded, by node.
        ros_distro: of metadata.yaml; None without one.
        about: what our recorder says of the bag.
    """

    path: str
    complete: bool = True
    problems: list[str] = field(default_factory=list)
    recoverable: bool = False
    size_bytes: int
    start_ns: int
    duration_s: float
    set_back_s: float
    compressed: list[str]
    messages: int
    parts: list[PartSurvey]
    topics: list[TopicSurvey]
    missions: list[MissionSurvey]
    restarts: dict[str, int]
    ros_distro: str | None
    about: dict[str, str]


def survey(path: Path) -> Survey:
    """Look through a bag.

    Raises:
        BagError: there is no bag, or nothing in it can be read.
    """
    try:
        with BagReader(path) as reader:
            return _survey(reader, None)
    except BagDamagedError as error:
        with BagReader(path, torn=True) as reader:
            if not (reader.topics or reader.about):
                raise
            return _survey(reader, error)


def _survey(reader: BagReader, error: BagDamagedError | None) -> Survey:
    """Look through an open bag; `error` tells why it had to be opened as far as it goes."""
    problems: list[str] = []
    for storage in reader.storages:
        problems += _damages(storage)
    recoverable = bool(problems) or error is not None
    if error is not None and not problems:
        problems.append(str(error))
    told: dict[str, Any] = {}
    if reader.path.is_dir():
        try:
            told = read_metadata(reader.path) or {}
            problems += _metadata_problems(reader, bool(told))
        except BagError as unreadable:
            problems.append(str(unreadable))
    problems += _lost(reader)
    dropped = reader.dropped or {}
    problems += [f"{n:,} messages of {topic} were dropped" for topic, n in sorted(dropped.items()) if n]
    found, restarts = _topics(reader, dropped)
    problems += _miscounted(reader, found)
    if reader.last_ns == TIME_MAX_NS:
        problems.append(
            "the times of some messages are beyond what ROS 2 can tell (2^63 ns): shown as the last"
        )
    missions: list[MissionSurvey] = []
    for namespace in namespaces(reader):
        missions += look_through(reader, namespace, problems)
    problems += mission_problems(reader, missions)
    distro = told.get("ros_distro")
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
        ros_distro=distro if isinstance(distro, str) and distro else None,
        about=reader.about,
    )


def _damages(storage: Storage) -> Iterator[str]:
    if not storage.has_end:
        yield f"{storage.path.name} has no end: its recorder was killed, or still writes it"
    for damage in storage.damages[:TOLD_MAX]:
        yield f"{storage.path.name}: {damage.n_bytes:,} bytes lost at byte {damage.at:,}: {damage.reason}"
    if len(storage.damages) > TOLD_MAX:
        n_bytes = sum(damage.n_bytes for damage in storage.damages[TOLD_MAX:])
        n_places = len(storage.damages) - TOLD_MAX
        yield f"{storage.path.name}: {n_bytes:,} bytes lost at {n_places:,} places more"


def _metadata_problems(reader: BagReader, told: bool) -> Iterator[str]:
    """A folder's metadata.yaml must tell its parts; `told`: does it say anything of a bag."""
    if not told:
        there = (reader.path / METADATA_FILE).exists()
        yield f"{METADATA_FILE} {'says nothing of a bag' if there else 'is missing'}"
        return
    parts = []
    for storage in reader.storages:
        part = Part(storage.path.name)
        for topic in storage.topics:
            part.topics[topic.name] = {"offered_qos_profiles": []}
            part.counts[topic.name] = topic.count + storage.repeated.get(topic.name, 0)
        parts.append(part)
    if not matches_metadata(reader.path, parts):
        yield f"{METADATA_FILE} tells other files, or other numbers of messages, than there are"


def _miscounted(reader: BagReader, found: list[TopicSurvey]) -> Iterator[str]:
    """An index must tell as many messages as there are."""
    for topic in found:
        told = reader.topics[topic.name].count if topic.name in reader.topics else 0
        if told != topic.messages:
            yield f"{topic.name} has {topic.messages:,} messages; its files tell of {told:,}"


def _lost(reader: BagReader) -> Iterator[str]:
    """What was lost before the bag was recovered."""
    for storage in reader.storages:
        if LOST_BYTES_KEY in storage.about:
            lost = storage.about[LOST_BYTES_KEY][:40]
            yield f"{storage.path.name} was recovered, without {lost} bytes of its source"


@dataclass
class _Pace:
    """How the messages of a topic follow each other; log times in nanoseconds since the epoch."""

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


def _topics(reader: BagReader, dropped: Mapping[str, int]) -> tuple[list[TopicSurvey], dict[str, int]]:
    """One pass over all messages: the pace of each topic, and the restarts that diagnostics tell."""
    paces = {name: _Pace() for name in reader.topics}
    restarts: dict[str, int] = {}
    for message in reader.messages():
        paces[message.topic].add(message.log_time_ns)
        if message.type == topics.DIAGNOSTICS:
            for node, n in _restarts(message):
                restarts[node] = max(n, restarts.get(node, 0))
    found = []
    for name in sorted({*reader.topics, *dropped}):
        pace = paces.get(name, _Pace())
        topic = TopicSurvey(
            name=name,
            type=reader.topics[name].type if name in reader.topics else "",
            other_types=list(reader.topics[name].other_types) if name in reader.topics else [],
            messages=pace.n,
            dropped=dropped.get(name, 0),
        )
        if pace.n:
            topic.first_s = (pace.first_ns - reader.first_ns) / 1e9
            topic.last_s = (pace.last_ns - reader.first_ns) / 1e9
        if pace.n > 1:
            span_ns = pace.last_ns - pace.first_ns
            topic.mean_hz = (pace.n - 1) * 1e9 / span_ns if span_ns else None
            topic.gap_s, topic.gap_at_s = pace.gap_ns / 1e9, (pace.gap_at_ns - reader.first_ns) / 1e9
        found.append(topic)
    return found, {node: n for node, n in sorted(restarts.items()) if n}


def _restarts(message: BagMessage) -> Iterator[tuple[str, int]]:
    """Nodes that a diagnostics message tells of, and how often each was started again."""
    try:
        array: Any = typestore().deserialize_cdr(message.data, topics.DIAGNOSTICS)
    except Exception:  # of struct, numpy, rosbags: another one's bytes are not ours to judge
        return
    namespace = message.topic.removesuffix("/diagnostics").removeprefix("/")
    prefix = f"{namespace}/" if namespace else ""
    for status in array.status:
        if status.hardware_id != HARDWARE_ID:
            continue
        for pair in status.values:
            if pair.key == "restarts" and pair.value.isdecimal():
                yield prefix + status.name, int(pair.value)
            elif pair.key.startswith("restarts of ") and pair.value.isdecimal():
                yield prefix + pair.key.removeprefix("restarts of "), int(pair.value)


def start_text(start_ns: int) -> str:
    """The date and time of a log time, UTC."""
    return time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(start_ns // 10**9))
