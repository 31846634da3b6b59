"""MCAP files as storage of a bag, read by their index, or scanned without one."""

from collections.abc import Collection, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import IO

import numpy as np
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Message, Schema
from mcap.summary import Summary

from uav_dc_ros.bags.metadata import Part
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
    part = Part(path.name)
    with damage_errors(path):
        indexed = statistics.metadata_count == len(summary.metadata_indexes) > 0
        for metadata in reader.iter_metadata() if indexed else metadata_records(path, file):
            part.add_metadata(metadata.name, metadata.metadata)
        library = reader.get_header().library
    for index in summary.chunk_indexes:
        if index.compression not in CHUNK_COMPRESSIONS:
            unsupported = f"unsupported compression type {index.compression!r}"
            raise BagError(f"{path}: {unsupported}; expected one of {CHUNK_COMPRESSIONS}")
    left_out = {} if repeats else part.repeated
    topics: dict[str, RecordedTopic] = {}
    for channel in summary.channels.values():
        count = statistics.channel_message_counts.get(channel.id, 0)
        merge_topic(topics, _topic(channel, summary.schemas.get(channel.schema_id), count))
    for name, n in left_out.items():
        if name in topics:
            topics[name].count -= n

    compressed: set[str] = set()

    def read(
        topics: Collection[str] | None, start_ns: int | None, end_ns: int | None, *, sort: bool = True
    ) -> Iterator[BagMessage]:
        stream = reader.iter_messages(topics, starting_at=start_ns, ending_before=end_ns, log_time_order=sort)
        while True:
            with damage_errors(path):
                item = next(stream, None)
            if item is None:
                return
            schema, channel, message = item
            if message.sequence == 0 and channel.topic in left_out:
                continue
            is_cdr = channel.message_encoding == CDR
            data = decompress_payload(message.data) if is_cdr else message.data
            if data is not message.data:
                compressed.add(channel.topic)
            yield _message(channel.topic, schema.name if schema else "", message, data)

    def log_goes_back_ns() -> int:
        if all(chunk.message_index_offsets for chunk in summary.chunk_indexes):
            with suppress(ValueError), read_errors(path):
                return goes_back_ns(_indexed_times(file, summary))
        messages = read(None, None, None, sort=False)
        return goes_back_ns((message.topic, message.log_time_ns) for message in messages)

    return Storage(
        path=path,
        topics=list(topics.values()),
        first_ns=min(statistics.message_start_time, TIME_MAX_NS),
        last_ns=min(statistics.message_end_time, TIME_MAX_NS),
        messages=read,
        recorded=lambda topics: read(topics, None, None, sort=False),
        goes_back_ns=log_goes_back_ns,
        about=part.about,
        dropped=part.dropped,
        repeated=left_out,
        library=library,
        compressed=compressed,
    )


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

    def recorded(topics: Collection[str] | None) -> Iterator[BagMessage]:
        with read_errors(path):
            again = Scan(path, file)
            for record in again:
                if isinstance(record, Message):
                    topic, type = again.channels[record.channel_id]
                    is_repeated = record.sequence == 0 and topic in left_out
                    if not is_repeated and (topics is None or topic in topics):
                        yield _message(topic, type, record, record.data)

    schemas: dict[int, Schema] = {}
    topics: dict[str, RecordedTopic] = {}
    with read_errors(path):
        for record in scan:
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                merge_topic(topics, _topic(record, schemas.get(record.schema_id), 0))
        ended = has_end(file)
    left_out = {} if repeats else scan.part.repeated
    for name, count in scan.part.counts.items():
        topics[name].count = count - left_out.get(name, 0)
    return Storage(
        path=path,
        topics=list(topics.values()),
        first_ns=scan.part.first_ns or 0,
        last_ns=scan.part.last_ns,
        messages=lambda topics, *range_ns: _sorted(recorded(topics), scan.lag_ns, *range_ns),
        recorded=recorded,
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


def _topic(channel: Channel, schema: Schema | None, count: int) -> RecordedTopic:
    return RecordedTopic(
        name=channel.topic,
        type=schema.name if schema else "",
        definition=schema.data if schema else b"",
        encoding=schema.encoding if schema else "",
        serialization=channel.message_encoding,
        offered_qos=channel.metadata.get("offered_qos_profiles", ""),
        count=count,
    )


def _message(topic: str, type: str, message: Message, data: bytes) -> BagMessage:
    log_time_ns, publish_time_ns = min(message.log_time, TIME_MAX_NS), min(message.publish_time, TIME_MAX_NS)
    return BagMessage(topic, type, data, log_time_ns, publish_time_ns)


def _sorted(
    messages: Iterator[BagMessage], lag_ns: int, start_ns: int | None, end_ns: int | None
) -> Iterator[BagMessage]:
    """Messages of a range of log times, sorted; `messages` go back by at most `lag_ns`."""
    newest_ns = 0

    def in_range() -> Iterator[tuple[int, BagMessage]]:
        nonlocal newest_ns
        for message in messages:
            time_ns = message.log_time_ns
            newest_ns = max(newest_ns, time_ns)
            if (start_ns is None or time_ns >= start_ns) and (end_ns is None or time_ns < end_ns):
                yield time_ns, message

    for _, message in sorted_within(in_range(), WAITING_BYTES, lambda time_ns: time_ns <= newest_ns - lag_ns):
        yield message
