"""MCAP files as storage of a bag: by their index, or without one as far as they go."""

import heapq
from collections.abc import Collection, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import IO

import numpy as np
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Message, Metadata, Schema
from mcap.summary import Summary

from uav_dc_ros.bags.metadata import Part
from uav_dc_ros.bags.records import CDR, COMPRESSIONS, FRAME, MAGIC, TIME_MAX_NS, plain
from uav_dc_ros.bags.salvage.scan import Scan, has_end, metadata_records
from uav_dc_ros.bags.storage import (
    RECOVER,
    BagMessage,
    RecordedTopic,
    Storage,
    damage,
    foreign,
    goes_back_ns,
    reading,
)
from uav_dc_ros.errors import BagDamagedError, BagError

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
        BagError: no MCAP file. Without `torn`: one without its end, or a damaged one.
    """
    with reading(path):
        file = closing.enter_context(path.open("rb"))
        scan = Scan(path, file)
        whole = has_end(file)
    if torn:
        return _open_scanned(scan, file, repeats=repeats)
    if not scan.size:
        raise BagError(f"{path} is empty; expected an MCAP file")
    if not MAGIC.startswith(scan.magic):
        raise BagError(f"{path} {foreign(scan.magic)}")
    if not whole:
        raise BagDamagedError(
            f"{path} has no end: its recorder was killed, or still writes it; expected a whole bag, as "
            f"{RECOVER} makes of it"
        )
    with damage(path):
        file.seek(0)
        reader = SeekingReader(file, validate_crcs=True)
        summary = reader.get_summary()
    if summary is not None and _is_index(summary):
        return _open_indexed(path, file, reader, summary, repeats=repeats)
    found = _open_scanned(scan, file, repeats=repeats)
    if scan.lost_bytes:
        raise BagDamagedError(f"{path} is damaged: {scan.lost_bytes} bytes; {RECOVER} brings back the others")
    return found


def _is_index(summary: Summary) -> bool:
    """Whether every message can be found by a summary: MCAP leaves it to the writer what is in there."""
    statistics, channels = summary.statistics, summary.channels
    return (
        statistics is not None
        and statistics.chunk_count == len(summary.chunk_indexes)
        and bool(statistics.chunk_count or not statistics.message_count)  # none lies outside of chunks
        and statistics.channel_message_counts.keys() <= channels.keys()
        and all(index.message_index_offsets.keys() <= channels.keys() for index in summary.chunk_indexes)
        and all(channel.schema_id in (0, *summary.schemas) for channel in channels.values())
    )


def _open_indexed(
    path: Path, file: IO[bytes], reader: SeekingReader, summary: Summary, *, repeats: bool
) -> Storage:
    """A finished MCAP file, by its index."""
    statistics = summary.statistics
    assert statistics is not None, "it is an index"
    told = Part(path.name)
    with damage(path):
        for metadata in _metadata(path, file, reader, summary):
            told.learn(metadata.name, metadata.metadata)
        library = reader.get_header().library
    for index in summary.chunk_indexes:
        if index.compression not in COMPRESSIONS:
            raise BagError(
                f"{path}: unsupported compression type {index.compression!r}; expected one of {COMPRESSIONS}"
            )
    left_out = {} if repeats else told.repeated
    topics: dict[str, RecordedTopic] = {}
    for channel in summary.channels.values():
        count = statistics.channel_message_counts.get(channel.id, 0)
        _enter(topics, channel, summary.schemas.get(channel.schema_id), count)
    for name, n in left_out.items():
        if name in topics:
            topics[name].count -= n

    compressed: set[str] = set()

    def read(
        topics: Collection[str] | None, start_ns: int | None, end_ns: int | None, *, sort: bool
    ) -> Iterator[BagMessage]:
        stream = reader.iter_messages(topics, starting_at=start_ns, ending_before=end_ns, log_time_order=sort)
        while True:
            with damage(path):
                found = next(stream, None)
            if found is None:
                return
            schema, channel, message = found
            if message.sequence == 0 and channel.topic in left_out:
                continue
            data = plain(message.data) if channel.message_encoding == CDR else message.data
            if data is not message.data:
                compressed.add(channel.topic)
            yield _message(channel.topic, schema.name if schema else "", message, data)

    def recorded(topics: Collection[str] | None) -> Iterator[BagMessage]:
        return read(topics, None, None, sort=False)

    def log_goes_back_ns() -> int:
        if all(chunk.message_index_offsets for chunk in summary.chunk_indexes):
            with suppress(ValueError), reading(path):
                return goes_back_ns(_indexed_times(file, summary))
        return goes_back_ns((message.topic, message.log_time_ns) for message in recorded(None))

    return Storage(
        path=path,
        topics=list(topics.values()),
        first_ns=min(statistics.message_start_time, TIME_MAX_NS),
        last_ns=min(statistics.message_end_time, TIME_MAX_NS),
        messages=lambda topics, start_ns, end_ns: read(topics, start_ns, end_ns, sort=True),
        recorded=recorded,
        goes_back_ns=log_goes_back_ns,
        about=told.about,
        dropped=told.dropped,
        repeated=left_out,
        library=library,
        compressed=compressed,
    )


def _metadata(path: Path, file: IO[bytes], reader: SeekingReader, summary: Summary) -> Iterator[Metadata]:
    """The metadata records of a file, by their index, if it tells of them all; it is optional, too."""
    counted = summary.statistics.metadata_count if summary.statistics is not None else 0
    if counted and counted == len(summary.metadata_indexes):
        return reader.iter_metadata()
    return metadata_records(path, file)


def _indexed_times(file: IO[bytes], summary: Summary) -> Iterator[tuple[int, int]]:
    """Channel and log time (ns) of each message, those of a channel in their order, by the chunks' indexes.

    Raises:
        ValueError: they are not what they say.
    """
    for chunk in sorted(summary.chunk_indexes, key=lambda index: index.chunk_start_offset):
        for channel, offset in chunk.message_index_offsets.items():
            file.seek(offset)
            opcode, length = FRAME.unpack(file.read(FRAME.size).ljust(FRAME.size))
            if opcode != Opcode.MESSAGE_INDEX or length > chunk.message_index_length:
                raise ValueError("no index of messages")
            pairs = np.frombuffer(file.read(length)[6:], "<u8").reshape(-1, 2)  # log time, place
            for time_ns in pairs[pairs[:, 1].argsort(), 0].tolist():
                yield channel, time_ns


def _open_scanned(scan: Scan, file: IO[bytes], *, repeats: bool) -> Storage:
    """An MCAP file as far as it goes: read once for what it holds, and again for its messages."""
    path = scan.path

    def messages(
        topics: Collection[str] | None, start_ns: int | None, end_ns: int | None
    ) -> Iterator[BagMessage]:
        return _sorted(_scanned(Scan(path, file), left_out, topics), scan.lag_ns, start_ns, end_ns)

    schemas: dict[int, Schema] = {}
    topics: dict[str, RecordedTopic] = {}
    with reading(path):
        for record in scan:
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                _enter(topics, record, schemas.get(record.schema_id), 0)
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
        recorded=lambda topics: _scanned(Scan(path, file), left_out, topics),
        goes_back_ns=lambda: scan.goes_back_ns,
        about=scan.part.about,
        dropped=scan.part.dropped,
        repeated=left_out,
        library=scan.library,
        damages=scan.damages,
        has_end=ended,
        has_index=False,
        compressed=scan.compressed,
    )


def _enter(topics: dict[str, RecordedTopic], channel: Channel, schema: Schema | None, count: int) -> None:
    """Enter a channel; there may be several of a topic, one for each of its publishers."""
    made = RecordedTopic(
        name=channel.topic,
        type=schema.name if schema else "",
        definition=schema.data if schema else b"",
        encoding=schema.encoding if schema else "",
        serialization=channel.message_encoding,
        offered_qos=channel.metadata.get("offered_qos_profiles", ""),
        count=count,
    )
    known = topics.setdefault(channel.topic, made)
    if known is not made:
        known.join(made)


def _message(topic: str, type: str, message: Message, data: bytes) -> BagMessage:
    return BagMessage(
        topic, type, data, min(message.log_time, TIME_MAX_NS), min(message.publish_time, TIME_MAX_NS)
    )


def _scanned(scan: Scan, left_out: Collection[str], topics: Collection[str] | None) -> Iterator[BagMessage]:
    """Messages of a file that has no index to read it by, as they lie there.

    Args:
        scan: of the file, new.
        left_out: topics whose repeated messages are left out.
        topics: which; None: all.
    """
    schemas: dict[int, str] = {}
    channels: dict[int, tuple[str, str]] = {}
    records = iter(scan)
    while True:
        with reading(scan.path):
            record = next(records, None)
        if record is None:
            return
        if isinstance(record, Schema):
            schemas[record.id] = record.name
        elif isinstance(record, Channel):
            channels[record.id] = record.topic, schemas.get(record.schema_id, "")
        elif isinstance(record, Message):
            topic, type = channels[record.channel_id]
            if (record.sequence == 0 and topic in left_out) or (topics is not None and topic not in topics):
                continue
            yield _message(topic, type, record, record.data)


def _sorted(
    messages: Iterator[BagMessage], lag_ns: int, start_ns: int | None, end_ns: int | None
) -> Iterator[BagMessage]:
    """Messages between two times in the order of their log times.

    Args:
        messages: as they lie in a file.
        lag_ns: how much earlier than one before it a message may be, nanoseconds.
        start_ns, end_ns: which.
    """
    waiting: list[tuple[int, int, BagMessage]] = []  # log time, number in the file
    waiting_bytes = newest_ns = 0
    for n, message in enumerate(messages):
        time_ns = message.log_time_ns
        newest_ns = max(newest_ns, time_ns)
        if (start_ns is None or time_ns >= start_ns) and (end_ns is None or time_ns < end_ns):
            heapq.heappush(waiting, (time_ns, n, message))
            waiting_bytes += len(message.data) + MESSAGE_BYTES
        while waiting and (waiting[0][0] <= newest_ns - lag_ns or waiting_bytes > WAITING_BYTES):
            *_, first = heapq.heappop(waiting)
            waiting_bytes -= len(first.data) + MESSAGE_BYTES
            yield first
    while waiting:
        yield heapq.heappop(waiting)[2]
