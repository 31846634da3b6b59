"""A client of Foxglove's WebSocket protocol, written by hand after its specification.

It shares no code with the server.
"""

import json
import socket
import struct
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from websockets.sync.client import connect

SUBPROTOCOL = "foxglove.sdk.v1"
MESSAGE = struct.Struct("<BIQ")  # operation, subscription, time in nanoseconds
MESSAGE_DATA = 1


@dataclass
class Received:
    """A message: its topic, when it was received, and its content by the sent schema."""

    topic: str
    time_ns: int
    content: Any


class FoxgloveClient:
    """A context manager: connects, and reads what the server sends first.

    Attributes:
        server: its `serverInfo`.
        channels: what it advertised, by topic.
    """

    def __init__(self, port: int, n_channels: int) -> None:
        self._stack = ExitStack()
        # When it leaves while messages wait to be read, it does not see the server's farewell: by itself it
        # would wait for that for ten seconds.
        self._socket = self._stack.enter_context(
            connect(f"ws://127.0.0.1:{port}", subprotocols=[SUBPROTOCOL], max_size=None, close_timeout=0.5)
        )
        self.server: dict[str, Any] = json.loads(self._socket.recv(5))
        self.channels: dict[str, dict[str, Any]] = {}
        while len(self.channels) < n_channels:
            data = json.loads(self._socket.recv(5))
            if data["op"] == "advertise":
                self.channels |= {channel["topic"]: channel for channel in data["channels"]}
        self._store = get_typestore(Stores.EMPTY)  # with the types that the server sends only
        for channel in self.channels.values():
            if channel["encoding"] == "json":
                continue
            types = get_types_from_msg(channel["schema"], channel["schemaName"])
            self._store.register(
                {name: kind for name, kind in types.items() if name not in self._store.types}
            )

    def open(self, *topics: str) -> None:
        """Subscribe; the channel's number is the subscription's, too."""
        numbers = [self.channels[topic]["id"] for topic in topics]
        wanted = [{"id": number, "channelId": number} for number in numbers]
        self._socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    def read(self, within_s: float) -> Received | None:
        """The next message; None if none comes in time."""
        deadline_s = time.monotonic() + within_s
        while (left_s := deadline_s - time.monotonic()) > 0:
            try:
                data = self._socket.recv(left_s)
            except TimeoutError:
                return None
            if isinstance(data, bytes) and data[0] == MESSAGE_DATA:
                _, number, time_ns = MESSAGE.unpack_from(data)
                (channel,) = (row for row in self.channels.values() if row["id"] == number)
                body = data[MESSAGE.size :]
                if channel["encoding"] == "json":
                    content = json.loads(body)
                else:
                    content = self._store.deserialize_cdr(body, channel["schemaName"])
                return Received(channel["topic"], time_ns, content)
        return None

    def read_until(self, enough: Callable[[list[Received]], bool], within_s: float) -> list[Received]:
        """Messages until there are enough of them."""
        received: list[Received] = []
        deadline_s = time.monotonic() + within_s
        while not enough(received):
            message = self.read(deadline_s - time.monotonic())
            topics = sorted({m.topic for m in received})
            assert message is not None, f"nothing more came; until then there were {topics}"
            received.append(message)
        return received

    def __enter__(self) -> "FoxgloveClient":
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()


def is_free(port: int) -> bool:
    """Whether a port is free."""
    with socket.socket() as trial:
        trial.setsockopt(
            socket.SOL_SOCKET, socket.SO_REUSEADDR, 1
        )  # connections that have ended do not count
        try:
            trial.bind(("127.0.0.1", port))
        except OSError:
            return False
        return True
