"""Files of rosbag2's SQLite storage, each by itself: what metadata.yaml says of them is not needed."""

import sqlite3
from collections.abc import Collection, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from uav_dc_ros.bags.records import CDR, plain
from uav_dc_ros.bags.storage import BagMessage, RecordedTopic, Storage, damage, goes_back_ns

ROWS = 1000  # read at a time


def open_sqlite(path: Path, closing: ExitStack) -> Storage:
    """A file of rosbag2's SQLite storage; only the thread that opened it may read it.

    Raises:
        BagError: it cannot be read, or is damaged.
    """
    # What a recorder that was killed left in a write-ahead log beside it is read, too; that needs a lock.
    how = "mode=ro" if path.with_name(f"{path.name}-wal").exists() else "immutable=1"
    with damage(path, ""):
        database = sqlite3.connect(f"{path.absolute().as_uri()}?{how}", uri=True)
        closing.callback(database.close)
        database.row_factory = sqlite3.Row
        rows = database.execute("SELECT * FROM topics ORDER BY id").fetchall()
        counts = {
            topic: (n, first_ns, last_ns)
            for topic, n, first_ns, last_ns in database.execute(
                "SELECT topic_id, COUNT(*), MIN(timestamp), MAX(timestamp) FROM messages GROUP BY topic_id"
            )
        }
        topics = {row["id"]: _topic(row, counts.get(row["id"], (0,))[0]) for row in rows}
        by_name: dict[str, RecordedTopic] = {}
        for topic in topics.values():
            known = by_name.setdefault(topic.name, topic)
            if known is not topic:
                known.join(topic)
        _define(database, by_name)
        first_ns = min((int(first) for topic, (_, first, _) in counts.items() if topic in topics), default=0)
        last_ns = max((int(last) for topic, (_, _, last) in counts.items() if topic in topics), default=0)

    compressed: set[str] = set()

    def read(
        wanted: Collection[str] | None, start_ns: int | None, end_ns: int | None, order: str
    ) -> Iterator[BagMessage]:
        ids = [id for id, topic in topics.items() if wanted is None or topic.name in wanted]
        query = f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({_marks(ids)})"
        given = list(ids)
        for limit, compare in ((start_ns, ">="), (end_ns, "<")):
            if limit is not None:
                query += f" AND timestamp {compare} ?"
                given.append(limit)
        with damage(path, ""):
            cursor = database.execute(f"{query} ORDER BY {order}", given)
        while True:
            with damage(path, ""):
                found = [_message(topics[row["topic_id"]], row, compressed) for row in cursor.fetchmany(ROWS)]
            if not found:
                return
            yield from found

    def times() -> Iterator[tuple[int, int]]:
        with damage(path, ""):
            yield from database.execute("SELECT topic_id, timestamp FROM messages ORDER BY id")

    return Storage(
        path=path,
        topics=list(by_name.values()),
        first_ns=first_ns,
        last_ns=last_ns,
        messages=lambda wanted, start_ns, end_ns: read(wanted, start_ns, end_ns, "timestamp, id"),
        recorded=lambda wanted: read(wanted, None, None, "id"),
        goes_back_ns=lambda: goes_back_ns(times()),
        compressed=compressed,
    )


def _marks(values: Collection[object]) -> str:
    return ", ".join("?" * len(values))


def _topic(row: sqlite3.Row, count: int) -> RecordedTopic:
    """A row of the table `topics`; the oldest ones have no QoS."""
    has_qos = "offered_qos_profiles" in tuple(row.keys())
    return RecordedTopic(
        name=_text(row["name"]),
        type=_text(row["type"]),
        encoding="",
        serialization=_text(row["serialization_format"]),
        offered_qos=_text(row["offered_qos_profiles"]) if has_qos else "",
        count=count,
    )


def _define(database: sqlite3.Connection, topics: dict[str, RecordedTopic]) -> None:
    """Enter the definitions of the topics' types; older bags have none."""
    table = "SELECT 1 FROM sqlite_master WHERE type = 'table' AND name = 'message_definitions'"
    if not database.execute(table).fetchone():
        return
    for row in database.execute(
        "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
    ):
        for topic in topics.values():
            if topic.type == row["topic_type"]:
                topic.encoding = _text(row["encoding"])
                topic.definition = _text(row["encoded_message_definition"]).encode()


def _message(topic: RecordedTopic, row: sqlite3.Row, compressed: set[str]) -> BagMessage:
    data, time_ns = row["data"], row["timestamp"]
    if not isinstance(data, bytes) or not isinstance(time_ns, int):
        raise ValueError(f"a message of {topic.name} is none")
    payload = plain(data) if topic.serialization == CDR else data
    if payload is not data:
        compressed.add(topic.name)
    return BagMessage(topic.name, topic.type, payload, time_ns, time_ns)


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError(f"{value!r} where text is expected")
    return value
