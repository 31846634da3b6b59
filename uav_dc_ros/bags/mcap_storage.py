"""MCAP files as storage of a bag: by their index, or without one as far as they go."""

import heapq
from collections.abc import Collection, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import IO

from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.records import Channel, Message, Schema

from uav_dc_ros.bags.frames import COMPRESSIONS, MAGIC
from uav_dc_ros.bags.metadata import Part
from uav_dc_ros.bags.scan import Scan, has_end
from uav_dc_ros.bags.storage import RECOVER, BagMessage, RecordedTopic, Storage, damage
from uav_dc_ros.errors import BagError

WAITING_BYTES = 64 * 2**20  # of messages that wait for earlier ones; a clock that jumped is not waited for
MESSAGE_BYTES = 400  # that a message takes beside its data


def open_mcap(path: Path, closing: ExitStack, *, torn: bool = False, repeats: bool = True) -> Storage:
    """An MCAP file.

    Args:
        path: the file.
        closing: closes it.
        torn: read it as far as it goes, if it has no end or is damaged: once more for what it holds.
        repeats: give the latched messages at its head that an earlier file of the bag holds already?

    Raises:
        BagError: no MCAP file; without `torn`, one without its end, or a damaged one.
    """
    with damage(path):
        file = closing.enter_context(path.open("rb"))
    if torn:
        return _open_torn(path, file, repeats=repeats)
    with damage(path):
        scan = Scan(path, file)
        whole = has_end(file)
    if not scan.size:
        raise BagError(f"{path} is empty; expected an MCAP file")
    if not MAGIC.startswith(scan.magic):
        raise BagError(f"{path} starts with {scan.magic!r}; expected {MAGIC!r}, as an MCAP file does")
    if not whole:
        raise BagError(
            f"{path} has no end: its recorder was killed, or still writes it; expected a whole bag, as "
            f"{RECOVER} makes of it"
        )
    with damage(path):
        file.seek(0)
        reader = SeekingReader(file, validate_crcs=True)
        summary = reader.get_summary()
        if summary is None or summary.statistics is None:
            raise McapError("its summary has no statistics")
        told = Part(path.name)
        for metadata in reader.iter_metadata():
            told.learn(metadata.name, metadata.metadata)
        left_out = {} if repeats else told.repeated
        library = reader.get_header().library
        statistics = summary.statistics
        topics = [
            _topic(channel, summary.schemas.get(channel.schema_id), statistics.channel_message_counts)
            for channel in summary.channels.values()
        ]
        for topic in topics:
            topic.count -= left_out.get(topic.name, 0)
    for index in summary.chunk_indexes:
        if index.compression not in COMPRESSIONS:
            raise BagError(
                f"{path}: unsupported compression type {index.compression!r}; expected one of {COMPRESSIONS}"
            )

    def messages(
        topics: Collection[str] | None, start_ns: int | None, end_ns: int | None
    ) -> Iterator[BagMessage]:
        if not summary.chunk_indexes:  # nothing to seek by
            with damage(path):
                scan = Scan(path, file)
                for _ in scan:
                    pass
            if scan.lost_bytes:
                raise BagError(
                    f"{path} is damaged: {scan.lost_bytes} bytes; {RECOVER} brings back the others"
                )
            with damage(path):
                yield from _scanned(Scan(path, file), scan.lag_ns, left_out, topics, start_ns, end_ns)
            return
        stream = reader.iter_messages(topics, starting_at=start_ns, ending_before=end_ns)
        while True:
            with damage(path):
                found = next(stream, None)
            if found is None:
                return
            schema, channel, message = found
            if message.sequence == 0 and channel.topic in left_out:
                continue
            yield _message(channel.topic, schema.name if schema else "", message)

    return Storage(
        path=path,
        topics=topics,
        first_ns=statistics.message_start_time,
        last_ns=statistics.message_end_time,
        messages=messages,
        about=told.about,
        dropped=told.dropped,
        library=library,
    )


def _open_torn(path: Path, file: IO[bytes], *, repeats: bool) -> Storage:
    """An MCAP file as far as it goes: read once for what it holds, and again for its messages."""

    def messages(
        topics: Collection[str] | None, start_ns: int | None, end_ns: int | None
    ) -> Iterator[BagMessage]:
        with damage(path):
            yield from _scanned(Scan(path, file), scan.lag_ns, left_out, topics, start_ns, end_ns)

    schemas: dict[int, Schema] = {}
    topics: dict[str, RecordedTopic] = {}
    with damage(path):
        scan = Scan(path, file)
        for record in scan:
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                topics.setdefault(record.topic, _topic(record, schemas.get(record.schema_id), {}))
        ended = has_end(file)
    left_out = {} if repeats else scan.part.repeated
    for name, count in scan.part.counts.items():
        topics[name].count = count - left_out.get(name, 0)
    return Storage(
        path=path,
        topics=list(topics.values()),
        first_ns=scan.part.first_ns or 0,
        last_ns=scan.part.last_ns,
        messages=messages,
        about=scan.part.about,
        dropped=scan.part.dropped,
        library=scan.library,
        damages=scan.damages,
        has_end=ended,
    )


def _topic(channel: Channel, schema: Schema | None, counts: Mapping[int, int]) -> RecordedTopic:
    return RecordedTopic(
        name=channel.topic,
        type=schema.name if schema else "",
        definition=schema.data if schema else b"",
        encoding=schema.encoding if schema else "",
        serialization=channel.message_encoding,
        offered_qos=channel.metadata.get("offered_qos_profiles", ""),
        count=counts.get(channel.id, 0),
    )


def _message(topic: str, type: str, message: Message) -> BagMessage:
    return BagMessage(topic, type, message.data, message.log_time, message.publish_time)


def _scanned(
    scan: Scan,
    lag_ns: int,
    left_out: Collection[str],
    topics: Collection[str] | None,
    start_ns: int | None,
    end_ns: int | None,
) -> Iterator[BagMessage]:
    """Messages of a file that has no index to read it by, in the order of their log times.

    Args:
        scan: of the file, new.
        lag_ns: how much earlier than one before it a message may be, nanoseconds.
        left_out: topics whose repeated messages are left out.
        topics, start_ns, end_ns: which messages.
    """
    schemas: dict[int, str] = {}
    channels: dict[int, tuple[str, str]] = {}
    waiting: list[tuple[int, int, BagMessage]] = []  # log time, number in the file
    waiting_bytes = newest_ns = 0
    for n, record in enumerate(scan):
        if isinstance(record, Schema):
            schemas[record.id] = record.name
        elif isinstance(record, Channel):
            channels[record.id] = record.topic, schemas.get(record.schema_id, "")
        elif isinstance(record, Message):
            topic, type = channels[record.channel_id]
            if record.sequence == 0 and topic in left_out:
                continue
            early = start_ns is not None and record.log_time < start_ns
            late = end_ns is not None and record.log_time >= end_ns
            newest_ns = max(newest_ns, record.log_time)
            if not early and not late and (topics is None or topic in topics):
                heapq.heappush(waiting, (record.log_time, n, _message(topic, type, record)))
                waiting_bytes += len(record.data) + MESSAGE_BYTES
            while waiting and (waiting[0][0] <= newest_ns - lag_ns or waiting_bytes > WAITING_BYTES):
                *_, message = heapq.heappop(waiting)
                waiting_bytes -= len(message.data) + MESSAGE_BYTES
                yield message
    while waiting:
        yield heapq.heappop(waiting)[2]
