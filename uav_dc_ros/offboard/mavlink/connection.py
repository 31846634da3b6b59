"""Non-blocking connections that carry MAVLink: TCP, UDP, serial.

A broken connection raises `ConnectionLost`, and the caller opens another one. (pymavlink's own connections
block while they reconnect, and print to standard output.)
"""

import contextlib
import socket
from dataclasses import dataclass
from typing import Any, Literal, Self

from uav_dc_ros.errors import VehicleError
from uav_dc_ros.offboard.extras import load

EXPECTED = "tcp:HOST:PORT, udpin:HOST:PORT (listens), udpout:HOST:PORT (sends first) or serial:DEVICE:BAUD"
CONNECT_S = 2.0
READ_BYTES = 65536


class ConnectionLost(Exception):
    """A connection is broken, or cannot be opened; the message gives the reason."""


@dataclass(frozen=True)
class Address:
    """Address of an autopilot: host and port, or serial device and baud rate."""

    kind: Literal["tcp", "udpin", "udpout", "serial"]
    host: str
    number: int

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read an address such as `tcp:127.0.0.1:5760`; raises VehicleError if the text is none.

        `udp` means `udpin`, as with other MAVLink tools.
        """
        kind, _, rest = text.partition(":")
        host, _, number = rest.rpartition(":")
        kind = "udpin" if kind == "udp" else kind
        if host.startswith("[") and host.endswith("]"):  # an IPv6 address
            host = host[1:-1]
        if kind not in ("tcp", "udpin", "udpout", "serial") or not host or not number.isascii():
            raise VehicleError(f"connect: {text!r}; expected {EXPECTED}")
        maximum, what = (4_000_000, "baud") if kind == "serial" else (65535, "port")
        if not number.isdigit() or not 1 <= int(number) <= maximum:
            raise VehicleError(f"connect: {what} {number!r} in {text!r}; expected 1 to {maximum}")
        return cls(kind, host, int(number))  # type: ignore[arg-type]

    def __str__(self) -> str:
        """As `parse` reads it."""
        return f"{self.kind}:{self.host}:{self.number}"

    def open(self) -> "Connection":
        """Open a connection; raises ConnectionLost if that fails now, VehicleError if it always will."""
        try:
            if self.kind == "tcp":
                return _Tcp(self)
            return _Serial(self) if self.kind == "serial" else _Udp(self)
        except ValueError as error:  # an invalid host or device name
            raise VehicleError(f"connect: {str(self)!r}: {error}; expected {EXPECTED}") from None
        except OSError as error:
            what = "does not answer" if self.kind == "tcp" else "cannot be opened"
            raise ConnectionLost(f"{self} {what}: {error.strerror or error}") from None


def load_serial(address: Address) -> Any:
    """The module of pyserial; raises VehicleError if it is not installed."""
    return load("serial", f"{address} needs pyserial")


class Connection:
    """Bytes to and from an autopilot, on an open socket or serial port."""

    def __init__(self, address: Address, file: Any) -> None:
        self.address, self._file = address, file

    def fileno(self) -> int:
        """File descriptor, for `select`."""
        return int(self._file.fileno())

    def read(self) -> bytes:
        """Bytes that were received; empty: none."""
        try:
            return self._receive()
        except BlockingIOError:
            return b""
        except OSError as error:
            raise ConnectionLost(f"{self.address} broke: {error.strerror or error}") from None

    def write(self, data: bytes) -> bool:
        """Send all of `data`; False: there is no peer yet."""
        try:
            sent = self._send(data)
        except BlockingIOError:
            sent = 0
        except OSError as error:
            raise ConnectionLost(f"{self.address} broke: {error.strerror or error}") from None
        if sent is not None and sent < len(data):  # half a message would corrupt the next one
            raise ConnectionLost(f"{self.address} accepts no more data")
        return True

    def reply_to_sender(self) -> None:
        """On UDP, send from now on to the sender of the last datagram."""

    def close(self) -> None:
        """Close the socket or port."""
        with contextlib.suppress(OSError):
            self._file.close()

    def _receive(self) -> bytes:
        raise NotImplementedError

    def _send(self, data: bytes) -> int | None:
        raise NotImplementedError


class _Tcp(Connection):
    def __init__(self, address: Address) -> None:
        super().__init__(address, socket.create_connection((address.host, address.number), CONNECT_S))
        self._file.setblocking(False)
        self._file.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # no delay for setpoints

    def _receive(self) -> bytes:
        data: bytes = self._file.recv(READ_BYTES)
        if not data:
            raise ConnectionLost(f"{self.address} was closed by the other side")
        return data

    def _send(self, data: bytes) -> int:
        return int(self._file.send(data))


class _Serial(Connection):
    def __init__(self, address: Address) -> None:
        serial, (device, baud) = load_serial(address), (address.host, address.number)
        super().__init__(address, serial.Serial(device, baud, timeout=0, write_timeout=0, exclusive=True))

    def _receive(self) -> bytes:
        return bytes(self._file.read(READ_BYTES))

    def _send(self, data: bytes) -> int | None:
        sent: int | None = self._file.write(data)
        return sent


class _Udp(Connection):
    def __init__(self, address: Address) -> None:
        found = socket.getaddrinfo(address.host, address.number, type=socket.SOCK_DGRAM)
        family, kind, protocol, _, where = found[0]
        super().__init__(address, socket.socket(family, kind, protocol))
        self._file.setblocking(False)
        self._peer: Any = where if address.kind == "udpout" else None
        self._sender: Any = self._peer  # of the last datagram; several vehicles may send to one port
        if address.kind == "udpin":
            try:
                self._file.bind(where)
            except BaseException:
                self._file.close()
                raise

    def _receive(self) -> bytes:
        data: bytes
        try:
            data, self._sender = self._file.recvfrom(READ_BYTES)
        except ConnectionRefusedError:  # the peer is not listening yet
            return b""
        self._peer = self._peer or self._sender
        return data

    def reply_to_sender(self) -> None:
        self._peer = self._sender

    def write(self, data: bytes) -> bool:
        if self._peer is None:
            return False
        with contextlib.suppress(OSError):  # UDP may lose any datagram; heartbeats detect it
            self._file.sendto(data, self._peer)
        return True
