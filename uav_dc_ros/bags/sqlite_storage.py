"""Files of rosbag2's SQLite storage, read without metadata.yaml."""

import sqlite3
from collections.abc import Collection, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from uav_dc_ros.bags.records import CDR, decompress_payload
from uav_dc_ros.bags.storage import (
    BagMessage,
    RecordedTopic,
    Storage,
    damage_errors,
    goes_back_ns,
    merge_topic,
)

ROWS = 1000  # read at a time


def open_sqlite(path: Path, closing: ExitStack) -> Storage:
    """Open a file of rosbag2's SQLite storage for this thread only; raises BagError if it is damaged."""
    # The write-ahead log of a killed recorder is read, too; that needs a lock.
    mode = "mode=ro" if path.with_name(f"{path.name}-wal").exists() else "immutable=1"
    with damage_errors(path, ""):
        database = sqlite3.connect(f"{path.absolute().as_uri()}?{mode}", uri=True)
        closing.callback(database.close)
        database.row_factory = sqlite3.Row
        rows = database.execute("SELECT * FROM topics ORDER BY id").fetchall()
        query = "SELECT topic_id, COUNT(*), MIN(timestamp), MAX(timestamp) FROM messages GROUP BY topic_id"
        counts = {topic: (n, first_ns, last_ns) for topic, n, first_ns, last_ns in database.execute(query)}
        topics = {row["id"]: _topic(row, counts.get(row["id"], (0,))[0]) for row in rows}
        by_name: dict[str, RecordedTopic] = {}
        for topic in topics.values():
            merge_topic(by_name, topic)
        _add_definitions(database, by_name)
        first_ns = min((int(first) for topic, (_, first, _) in counts.items() if topic in topics), default=0)
        last_ns = max((int(last) for topic, (_, _, last) in counts.items() if topic in topics), default=0)

    compressed: set[str] = set()

    def read(
        wanted: Collection[str] | None, start_ns: int | None, end_ns: int | None, order: str, n: int = -1
    ) -> Iterator[BagMessage]:
        values = [id for id, topic in topics.items() if wanted is None or topic.name in wanted]
        marks = ", ".join("?" * len(values))
        query = f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({marks})"
        for limit, compare in ((start_ns, ">="), (end_ns, "<")):
            if limit is not None:
                query += f" AND timestamp {compare} ?"
                values.append(limit)
        with damage_errors(path, ""):
            cursor = database.execute(f"{query} ORDER BY {order} LIMIT {n}", values)
        while True:
            with damage_errors(path, ""):
                batch = [_message(topics[row["topic_id"]], row, compressed) for row in cursor.fetchmany(ROWS)]
            if not batch:
                return
            yield from batch

    def times() -> Iterator[tuple[int, int]]:
        with damage_errors(path, ""):
            yield from database.execute("SELECT topic_id, timestamp FROM messages ORDER BY id")

    return Storage(
        path=path,
        topics=list(by_name.values()),
        first_ns=first_ns,
        last_ns=last_ns,
        messages=lambda wanted, start_ns, end_ns: read(wanted, start_ns, end_ns, "timestamp, id"),
        recorded=lambda wanted, start_ns, end_ns: read(wanted, start_ns, end_ns, "id"),
        latest=lambda topic, n, before_ns: list(read([topic], None, before_ns, "timestamp DESC, id DESC", n))[
            ::-1
        ],
        goes_back_ns=lambda: goes_back_ns(times()),
        compressed=compressed,
    )


def _topic(row: sqlite3.Row, count: int) -> RecordedTopic:
    """A row of the table `topics`; older versions have no QoS, or no hash of the type."""
    columns = tuple(row.keys())

    def text(column: str) -> str:
        return _text(row[column]) if column in columns else ""

    return RecordedTopic(
        name=_text(row["name"]),
        type=_text(row["type"]),
        encoding="",
        serialization=_text(row["serialization_format"]),
        offered_qos=text("offered_qos_profiles"),
        type_hash=text("type_description_hash"),
        count=count,
    )


def _add_definitions(database: sqlite3.Connection, topics: dict[str, RecordedTopic]) -> None:
    """Add the definitions of the topics' types; older bags have none."""
    table = "SELECT 1 FROM sqlite_master WHERE type = 'table' AND name = 'message_definitions'"
    if not database.execute(table).fetchone():
        return
    query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
    for row in database.execute(query):
        for topic in topics.values():
            if topic.type == row["topic_type"]:
                topic.encoding = _text(row["encoding"])
                topic.definition = _text(row["encoded_message_definition"]).encode()


def _message(topic: RecordedTopic, row: sqlite3.Row, compressed: set[str]) -> BagMessage:
    data, time_ns = row["data"], row["timestamp"]
    if not isinstance(data, bytes) or not isinstance(time_ns, int):
        raise ValueError(f"a message of {topic.name} has data or a time of the wrong type")
    payload = decompress_payload(data) if topic.serialization == CDR else data
    if payload is not data:
        compressed.add(topic.name)
    return BagMessage(topic.name, topic.type, payload, time_ns, time_ns)


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError(f"{value!r}; expected text")
    return value
