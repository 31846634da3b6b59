"""A Foxglove WebSocket server for messages that are serialised already. Knows no node.

The SDK's server keeps nothing for clients that come later. This one does: whoever opens a latched topic
gets its last message at once.
"""

import importlib.util
import socket
import threading
from collections.abc import Mapping
from typing import Any

from uav_dc_ros.bags.message_definitions import ENCODING, definition
from uav_dc_ros.errors import NodeError, ParameterError
from uav_dc_ros.topics import Topic

MISSING = "the live view needs foxglove-sdk: no module foxglove; pip install 'uav_dc_ros[live]'"


def check(*, address: str, port: int) -> None:
    """See whether a server could be started, before anything is.

    Raises:
        NodeError, ParameterError: as FoxgloveServer does.
    """
    if importlib.util.find_spec("foxglove") is None:
        raise NodeError(MISSING)
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    try:
        socket.create_server((address, port), family=family).close()
    except OSError as error:
        why = str(error.strerror).partition(" (while")[0]  # Python repeats the address there
        raise ParameterError(_no_port(address, port, why)) from None


def _no_port(address: str, port: int, why: str) -> str:
    return f"port: {port} at address {address!r}: {why}; expected a free port of this machine (0: any)"


class FoxgloveServer:
    """A server that listens from here on, with a channel for each topic.

    Its clients may look only: it offers none of the protocol's services, parameters or published topics.

    Args:
        name: that clients show.
        address: network address to listen on.
        port: TCP port; 0: any that is free.
        topics: rows of the topics, by full name.

    Raises:
        NodeError: foxglove-sdk is not installed.
        ParameterError: the port is in use, or the address is not this machine's.
    """

    def __init__(self, *, name: str, address: str, port: int, topics: Mapping[str, Topic]) -> None:
        try:
            import foxglove
        except ModuleNotFoundError:
            raise NodeError(MISSING) from None
        self._context = foxglove.Context()  # with the last reference to it, its channels would close
        self._last: dict[int, tuple[bytes, int]] = {}  # of latched topics, by channel: message, and its time
        self._lock = threading.Lock()  # the SDK calls from its own threads; no older message may come last
        listener: Any = self  # the SDK asks for all methods of its protocol; it calls two
        try:
            self._server = foxglove.start_server(
                name=name, host=address, port=port, context=self._context, server_listener=listener
            )
        except RuntimeError as error:
            why = str(error).removeprefix("FoxgloveError: ")
            raise ParameterError(_no_port(address, port, why)) from None
        self._topics = topics
        self._channels = {
            full_name: foxglove.Channel(
                full_name,
                schema=foxglove.Schema(name=row.type, encoding=ENCODING, data=definition(row.type)),
                message_encoding="cdr",
                context=self._context,
            )
            for full_name, row in topics.items()
        }
        self._by_id = {channel.id(): channel for channel in self._channels.values()}

    @property
    def port(self) -> int:
        """The port it listens on."""
        return self._server.port

    def send(self, topic: str, data: bytes, time_ns: int) -> None:
        """Send a message to the clients that have opened its topic.

        Args:
            topic: full name.
            data: the message, serialised (CDR).
            time_ns: when it was received, nanoseconds since the epoch.
        """
        channel = self._channels[topic]
        if not self._topics[topic].latched:
            if channel.has_sinks():
                channel.log(data, log_time=time_ns)
            return
        with self._lock:
            self._last[channel.id()] = (data, time_ns)
            channel.log(data, log_time=time_ns)

    def on_subscribe(self, client: Any, view: Any) -> None:
        """Send the last message again: to all clients of the topic, since the SDK cannot do so to one."""
        with self._lock:
            if view.id in self._last:
                data, time_ns = self._last[view.id]
                self._by_id[view.id].log(data, log_time=time_ns)

    def on_unsubscribe(self, client: Any, view: Any) -> None:
        """Nothing is to be done."""

    def stop(self) -> None:
        """Close all connections, and the port."""
        self._server.stop()
