"""A Foxglove WebSocket server for serialized messages, without ROS.

Payloads travel as JSON with their schemas, so that Foxglove plots their fields, such as `rates.sum_rate_bps`.
Unlike the SDK's server, it keeps the last message of latched topics for later clients.
"""

import importlib.util
import socket
import threading
from collections.abc import Mapping
from typing import Any

from uav_dc_ros import cdr
from uav_dc_ros.bags import json_channels
from uav_dc_ros.bags.message_definitions import ENCODING, definition
from uav_dc_ros.errors import NodeError, ParameterError
from uav_dc_ros.topics import Topic

MISSING = "the live view needs foxglove-sdk: no module foxglove; pip install 'uav_dc_ros[live]'"


def check(*, address: str, port: int) -> None:
    """Raise the errors of FoxgloveServer, if a server cannot be started."""
    if importlib.util.find_spec("foxglove") is None:
        raise NodeError(MISSING)
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    try:
        socket.create_server((address, port), family=family).close()
    except OSError as error:
        raise _port_error(address, port, str(error.strerror).partition(" (while")[0]) from None


def _port_error(address: str, port: int, reason: str) -> ParameterError:
    return ParameterError(
        f"port: {port} at address {address!r}: {reason}; expected a free port of this machine (0: any)"
    )


class FoxgloveServer:
    """A running server with a channel for each topic.

    It is read-only: clients cannot call services, set parameters or publish. They show its `name`; `topics`
    are by full name; with port 0 it takes any free one. Raises NodeError if foxglove-sdk is not installed,
    and ParameterError if the port is in use, or the address belongs to another machine.
    """

    def __init__(self, *, name: str, address: str, port: int, topics: Mapping[str, Topic]) -> None:
        try:
            import foxglove
        except ModuleNotFoundError:
            raise NodeError(MISSING) from None
        self._context = foxglove.Context()  # its channels close with the last reference to it
        self._last: dict[int, tuple[bytes, int]] = {}  # message and time of latched topics, by channel
        self._lock = threading.Lock()  # the SDK's threads must not send an older message last
        listener: Any = self  # the SDK's protocol has more methods; it calls these two
        try:
            self._server = foxglove.start_server(
                name=name, host=address, port=port, context=self._context, server_listener=listener
            )
        except RuntimeError as error:
            raise _port_error(address, port, str(error).removeprefix("FoxgloveError: ")) from None
        self._topics = topics
        self._channels: dict[str, foxglove.Channel] = {}
        self._json: set[str] = set()  # full names of the topics that travel as JSON
        for full_name, row in topics.items():
            encoding, name, kind, data = "cdr", row.type, ENCODING, definition(row.type)
            if (payload := json_channels.payload(full_name, row.type)) is not None:
                self._json.add(full_name)
                encoding, name = json_channels.SERIALIZATION, json_channels.name(payload)
                kind, data = json_channels.ENCODING, json_channels.schema(payload)
            schema = foxglove.Schema(name=name, encoding=kind, data=data)
            self._channels[full_name] = foxglove.Channel(
                full_name, schema=schema, message_encoding=encoding, context=self._context
            )
        self._by_id = {channel.id(): channel for channel in self._channels.values()}

    @property
    def port(self) -> int:
        """TCP port of the server."""
        return self._server.port

    def send(self, topic: str, data: bytes, time_ns: int) -> None:
        """Send a CDR message to the subscribers of its topic (full name); `time_ns`: time of receipt.

        Raises MessageError for a payload that is no string.
        """
        channel = self._channels[topic]
        if topic in self._json:
            data = cdr.decode_string(data)
        if not self._topics[topic].latched:
            if channel.has_sinks():
                channel.log(data, log_time=time_ns)
            return
        with self._lock:
            self._last[channel.id()] = (data, time_ns)
            channel.log(data, log_time=time_ns)

    def on_subscribe(self, client: Any, view: Any) -> None:
        """Send the last latched message again, to all subscribers: the SDK has no call for a single one."""
        with self._lock:
            if view.id in self._last:
                data, time_ns = self._last[view.id]
                self._by_id[view.id].log(data, log_time=time_ns)

    def on_unsubscribe(self, client: Any, view: Any) -> None:
        """Do nothing; the SDK requires it."""

    def stop(self) -> None:
        """Close all connections, and the port."""
        self._server.stop()
