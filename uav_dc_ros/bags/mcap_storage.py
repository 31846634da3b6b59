"""MCAP files as storage of a bag, read by their index, or scanned without one."""

from collections import deque
from collections.abc import Collection, Iterator
from contextlib import ExitStack, suppress
from itertools import islice
from pathlib import Path
from typing import IO, Any

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Attachment, Channel, Chunk, Message, Metadata, Schema
from mcap.stream_reader import breakup_chunk
from mcap.summary import Summary

from uav_dc_ros import cdr, topics
from uav_dc_ros.bags import json_channels, message_definitions
from uav_dc_ros.bags.metadata import ABOUT_RECORD, DROPPED_RECORD, REPEATED_RECORD, ROSBAG2_RECORD, Part
from uav_dc_ros.bags.records import CDR, CHUNK_COMPRESSIONS, HEADER, MAGIC, TIME_MAX_NS, decompress_payload
from uav_dc_ros.bags.salvage.scan import Scan, has_end, metadata_records
from uav_dc_ros.bags.storage import (
    RECOVER,
    BagMessage,
    RecordedTopic,
    Storage,
    damage_errors,
    describe_foreign,
    goes_back_ns,
    merge_topic,
    read_errors,
    sorted_within,
)
from uav_dc_ros.errors import BagDamagedError, BagError

WAITING_BYTES = 64 * 2**20  # of messages that wait for earlier ones
OWN_RECORDS = (ABOUT_RECORD, REPEATED_RECORD, DROPPED_RECORD, ROSBAG2_RECORD)


def open_mcap(path: Path, closing: ExitStack, *, torn: bool = False, repeats: bool = True) -> Storage:
    """Open an MCAP file, which `closing` closes.

    With `torn`, it is scanned as far as possible. With `repeats`, the latched messages at its head that an
    earlier part of the bag has are kept. Raises BagError if it is no MCAP file; without `torn` also if it has
    no end or is damaged.
    """
    with read_errors(path):
        file = closing.enter_context(path.open("rb"))
        scan = Scan(path, file)
        whole = has_end(file)
    if torn:
        return _open_scanned(scan, file, repeats=repeats)
    if not scan.size:
        raise BagError(f"{path} is empty; expected an MCAP file")
    if not MAGIC.startswith(scan.magic):
        raise BagError(f"{path} {describe_foreign(scan.magic)}")
    if not whole:
        raise BagDamagedError(
            f"{path} has no end: its recorder was killed, or still writes it; expected a whole bag, as "
            f"{RECOVER} makes of it"
        )
    with damage_errors(path):
        file.seek(0)
        reader = SeekingReader(file, validate_crcs=True)
        summary = reader.get_summary()
    if summary is not None and _is_index(summary):
        return _open_indexed(path, file, reader, summary, repeats=repeats)
    storage = _open_scanned(scan, file, repeats=repeats)
    if scan.lost_bytes:
        raise BagDamagedError(f"{path} is damaged: {scan.lost_bytes} bytes; {RECOVER} recovers the others")
    return storage


def _is_index(summary: Summary) -> bool:
    """Whether every message is found by a summary, whose contents MCAP leaves to the writer."""
    statistics, channels = summary.statistics, summary.channels
    return (
        statistics is not None
        and statistics.chunk_count == len(summary.chunk_indexes)
        and bool(statistics.chunk_count or not statistics.message_count)  # none is outside of chunks
        and statistics.channel_message_counts.keys() <= channels.keys()
        and all(index.message_index_offsets.keys() <= channels.keys() for index in summary.chunk_indexes)
        and all(channel.schema_id in (0, *summary.schemas) for channel in channels.values())
    )


def _open_indexed(
    path: Path, file: IO[bytes], reader: SeekingReader, summary: Summary, *, repeats: bool
) -> Storage:
    statistics = summary.statistics
    assert statistics is not None, "it is an index"
    part, others = Part(path.name), list[Metadata]()
    with damage_errors(path):
        indexed = statistics.metadata_count == len(summary.metadata_indexes) > 0
        for metadata in reader.iter_metadata() if indexed else metadata_records(path, file):
            part.add_metadata(metadata.name, metadata.metadata)
            if metadata.name not in OWN_RECORDS:
                others.append(metadata)
        library = reader.get_header().library
    for index in summary.chunk_indexes:
        if index.compression not in CHUNK_COMPRESSIONS:
            unsupported = f"unsupported compression type {index.compression!r}"
            raise BagError(f"{path}: {unsupported}; expected one of {CHUNK_COMPRESSIONS}")
    left_out = {} if repeats else part.repeated
    by_name: dict[str, RecordedTopic] = {}
    payloads: set[int] = set()  # channels
    for channel in summary.channels.values():
        count, schema = (
            statistics.channel_message_counts.get(channel.id, 0),
            summary.schemas.get(channel.schema_id),
        )
        merge_topic(by_name, _topic(channel, schema, count))
        if _is_payload(channel, schema):
            payloads.add(channel.id)
    for name, n in left_out.items():
        if name in by_name:
            by_name[name].count -= n

    compressed: set[str] = set()

    def read(
        wanted: Collection[str] | None,
        start_ns: int | None,
        end_ns: int | None,
        *,
        sort: bool = True,
        reverse: bool = False,
        head: bool = False,
    ) -> Iterator[BagMessage]:
        if sort:
            times: dict[str, Any] = {"starting_at": start_ns, "ending_before": end_ns}
            stream = reader.iter_messages(wanted, **times, reverse=reverse)
        else:
            stream = _in_file_order(file, summary, wanted, start_ns, end_ns)
        while True:
            with damage_errors(path):
                item = next(stream, None)
            if item is None:
                return
            schema, channel, message = item
            if (message.sequence == 0 and channel.topic in left_out) != head:
                continue
            if channel.id in payloads:
                yield _message(channel.topic, topics.JSON, message, cdr.encode_string(message.data))
                continue
            is_cdr = channel.message_encoding == CDR
            data = decompress_payload(message.data) if is_cdr else message.data
            if data is not message.data:
                compressed.add(channel.topic)
            yield _message(channel.topic, schema.name if schema else "", message, data)

    def latest(topic: str, n: int, before_ns: int) -> list[BagMessage]:
        return list(islice(read([topic], None, before_ns, reverse=True), n))[::-1]

    def repeated() -> list[BagMessage]:
        return list(islice(read(left_out, None, None, sort=False, head=True), sum(left_out.values())))

    def attachments() -> Iterator[Attachment]:
        with damage_errors(path):
            yield from reader.iter_attachments()

    def log_goes_back_ns() -> int:
        if all(chunk.message_index_offsets for chunk in summary.chunk_indexes):
            with suppress(ValueError), read_errors(path):
                return goes_back_ns(_indexed_times(file, summary))
        messages = read(None, None, None, sort=False)
        return goes_back_ns((message.topic, message.log_time_ns) for message in messages)

    return Storage(
        path=path,
        topics=list(by_name.values()),
        first_ns=min(statistics.message_start_time, TIME_MAX_NS),
        last_ns=min(statistics.message_end_time, TIME_MAX_NS),
        messages=read,
        recorded=lambda wanted, *range_ns: read(wanted, *range_ns, sort=False),
        latest=latest,
        goes_back_ns=log_goes_back_ns,
        about=part.about,
        dropped=part.dropped,
        repeated=left_out,
        head=repeated,
        metadata=others,
        attachments=attachments,
        library=library,
        compressed=compressed,
    )


def _in_file_order(
    file: IO[bytes],
    summary: Summary,
    wanted: Collection[str] | None,
    start_ns: int | None,
    end_ns: int | None,
) -> Iterator[tuple[Schema | None, Channel, Message]]:
    """Messages in the order of the file, a chunk at a time: mcap would read all chunks before the first one.

    May raise errors of libraries.
    """
    channels = {
        channel.id: (summary.schemas.get(channel.schema_id), channel)
        for channel in summary.channels.values()
        if wanted is None or channel.topic in wanted
    }
    for index in sorted(summary.chunk_indexes, key=lambda index: index.chunk_start_offset):
        is_later = end_ns is not None and index.message_start_time >= end_ns
        is_earlier = start_ns is not None and index.message_end_time < start_ns
        offsets = index.message_index_offsets  # empty: the chunk's topics are unknown
        if is_later or is_earlier or (offsets and not offsets.keys() & channels.keys()):
            continue
        file.seek(index.chunk_start_offset + HEADER.size)
        for record in breakup_chunk(Chunk.read(ReadDataStream(file)), validate_crc=True):
            if isinstance(record, Message) and (found := channels.get(record.channel_id)) is not None:
                if _is_within(record.log_time, start_ns, end_ns):
                    yield *found, record
            elif isinstance(record, Message) and record.channel_id not in summary.channels:
                raise LookupError(f"a message of channel {record.channel_id}, which is not in the summary")


def _indexed_times(file: IO[bytes], summary: Summary) -> Iterator[tuple[int, int]]:
    """Channel and log time of each message, in order within a channel, by the indexes (or ValueError)."""
    for chunk in sorted(summary.chunk_indexes, key=lambda index: index.chunk_start_offset):
        for channel, offset in chunk.message_index_offsets.items():
            file.seek(offset)
            opcode, length = HEADER.unpack(file.read(HEADER.size).ljust(HEADER.size))
            if opcode != Opcode.MESSAGE_INDEX or length > chunk.message_index_length:
                raise ValueError("no message index")
            entries = np.frombuffer(file.read(length)[6:], "<u8").reshape(-1, 2)  # log time, offset
            for time_ns in entries[entries[:, 1].argsort(), 0].tolist():
                yield channel, time_ns


def _open_scanned(scan: Scan, file: IO[bytes], *, repeats: bool) -> Storage:
    """Read a file once for its contents; each iteration over messages scans it again."""
    path = scan.path

    def recorded(
        wanted: Collection[str] | None, start_ns: int | None, end_ns: int | None, *, head: bool = False
    ) -> Iterator[BagMessage]:
        with read_errors(path):
            again = Scan(path, file)
            for record in again:
                if not isinstance(record, Message):
                    continue
                topic, type = again.channels[record.channel_id]
                is_repeated = record.sequence == 0 and topic in left_out
                if is_repeated != head or (wanted is not None and topic not in wanted):
                    continue
                if record.channel_id in payloads:
                    message = _message(topic, topics.JSON, record, cdr.encode_string(record.data))
                else:
                    message = _message(topic, type, record, record.data)
                if _is_within(message.log_time_ns, start_ns, end_ns):
                    yield message

    def latest(topic: str, n: int, before_ns: int) -> list[BagMessage]:
        ordered = _sorted(recorded([topic], None, before_ns), scan.lag_ns)
        return list(deque(ordered, maxlen=n))

    def attachments() -> Iterator[Attachment]:
        with read_errors(path):
            yield from (record for record in Scan(path, file) if isinstance(record, Attachment))

    schemas: dict[int, Schema] = {}
    by_name: dict[str, RecordedTopic] = {}
    payloads: set[int] = set()  # channels
    others: list[Metadata] = []
    with read_errors(path):
        for record in scan:
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                merge_topic(by_name, _topic(record, schemas.get(record.schema_id), 0))
                if _is_payload(record, schemas.get(record.schema_id)):
                    payloads.add(record.id)
            elif isinstance(record, Metadata) and record.name not in OWN_RECORDS:
                others.append(record)
        ended = has_end(file)
    left_out = {} if repeats else scan.part.repeated
    for name, count in scan.part.counts.items():
        by_name[name].count = count - left_out.get(name, 0)
    return Storage(
        path=path,
        topics=list(by_name.values()),
        first_ns=scan.part.first_ns or 0,
        last_ns=scan.part.last_ns,
        messages=lambda wanted, *range_ns: _sorted(recorded(wanted, *range_ns), scan.lag_ns),
        recorded=recorded,
        latest=latest,
        goes_back_ns=lambda: scan.goes_back_ns,
        about=scan.part.about,
        dropped=scan.part.dropped,
        repeated=left_out,
        head=lambda: list(recorded(left_out, None, None, head=True)),
        metadata=others,
        attachments=attachments,
        library=scan.library,
        damages=scan.damages,
        has_end=ended,
        has_index=False,
        compressed=scan.compressed,
    )


def _is_payload(channel: Channel, schema: Schema | None) -> bool:
    """Whether a channel is one of `json_channels`."""
    is_json = channel.message_encoding == json_channels.SERIALIZATION
    return is_json and schema is not None and schema.name in json_channels.NAMES


def _is_within(time_ns: int, start_ns: int | None, end_ns: int | None) -> bool:
    return (start_ns is None or time_ns >= start_ns) and (end_ns is None or time_ns < end_ns)


def _topic(channel: Channel, schema: Schema | None, count: int) -> RecordedTopic:
    given: dict[str, Any] = {
        "offered_qos": channel.metadata.get("offered_qos_profiles", ""),
        "type_hash": channel.metadata.get("topic_type_hash", ""),
    }
    if _is_payload(channel, schema):
        definition = message_definitions.definition(topics.JSON)
        return RecordedTopic(
            name=channel.topic, type=topics.JSON, definition=definition, is_json=True, count=count, **given
        )
    return RecordedTopic(
        name=channel.topic,
        type=schema.name if schema else "",
        definition=schema.data if schema else b"",
        encoding=schema.encoding if schema else "",
        serialization=channel.message_encoding,
        count=count,
        **given,
    )


def _message(topic: str, type: str, message: Message, data: bytes) -> BagMessage:
    log_time_ns, publish_time_ns = min(message.log_time, TIME_MAX_NS), min(message.publish_time, TIME_MAX_NS)
    return BagMessage(topic, type, data, log_time_ns, publish_time_ns)


def _sorted(messages: Iterator[BagMessage], lag_ns: int) -> Iterator[BagMessage]:
    """Messages sorted by log time; they go back by at most `lag_ns`."""
    newest_ns = 0

    def timed() -> Iterator[tuple[int, BagMessage]]:
        nonlocal newest_ns
        for message in messages:
            newest_ns = max(newest_ns, message.log_time_ns)
            yield message.log_time_ns, message

    for _, message in sorted_within(timed(), WAITING_BYTES, lambda time_ns: time_ns <= newest_ns - lag_ns):
        yield message
