"""Ways on which MAVLink's bytes come and go: TCP, UDP, a serial line.

None of them waits while it reads or writes, and none mends itself: one that is broken says so, and another
one is opened. (pymavlink's own wait while they connect anew, and tell of it on standard output.)
"""

import contextlib
import importlib
import socket
from dataclasses import dataclass
from typing import Any, Literal, Protocol, Self

from uav_dc_ros.errors import VehicleError

EXPECTED = "tcp:HOST:PORT, udpin:HOST:PORT (listens), udpout:HOST:PORT (speaks first) or serial:DEVICE:BAUD"
CONNECT_S = 2.0
READ_BYTES = 65536


class ConnectionLost(Exception):
    """A link that is broken, or cannot be opened; the message says why."""


class Connection(Protocol):
    """A way to an autopilot."""

    def fileno(self) -> int:
        """To wait for something to read."""

    def read(self) -> bytes:
        """What has come; nothing, if nothing has."""

    def write(self, data: bytes) -> bool:
        """Send all of it; was there anybody to send it to."""

    def answer_here(self) -> None:
        """What was read last is the vehicle's: on UDP, send to where that came from from now on."""

    def close(self) -> None:
        """End it."""


@dataclass(frozen=True)
class Address:
    """Where an autopilot is found.

    Attributes:
        kind: how; `udp` is `udpin`, as with other tools of MAVLink.
        place: host or device.
        number: port or baud.
    """

    kind: Literal["tcp", "udpin", "udpout", "serial"]
    place: str
    number: int

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read an address such as `tcp:127.0.0.1:5760`.

        Raises:
            VehicleError: it is none.
        """
        kind, _, rest = text.partition(":")
        place, _, number = rest.rpartition(":")
        kind = "udpin" if kind == "udp" else kind
        if place.startswith("[") and place.endswith("]"):  # an IPv6 address, as people write it
            place = place[1:-1]
        if kind not in ("tcp", "udpin", "udpout", "serial") or not place or not number.isascii():
            raise VehicleError(f"connect: {text!r}; expected {EXPECTED}")
        least, most, what = (1, 4_000_000, "baud") if kind == "serial" else (1, 65535, "port")
        if not number.isdigit() or not least <= int(number) <= most:
            raise VehicleError(f"connect: {what} {number!r} in {text!r}; expected {least} to {most}")
        return cls(kind, place, int(number))  # type: ignore[arg-type]

    def __str__(self) -> str:
        """As `parse` reads it."""
        return f"{self.kind}:{self.place}:{self.number}"

    def open(self) -> Connection:
        """Open a link.

        Raises:
            LinkDown: it cannot be opened now.
            VehicleError: this machine cannot open it at all.
        """
        try:
            if self.kind == "tcp":
                return _Tcp(self)
            return _Serial(self) if self.kind == "serial" else _Udp(self)
        except ValueError as error:  # a name that no host and no device can have
            raise VehicleError(f"connect: {str(self)!r}: {error}; expected {EXPECTED}") from None
        except OSError as error:
            why = error.strerror or str(error)
            what = "does not answer" if self.kind == "tcp" else "cannot be opened"
            raise ConnectionLost(f"{self} {what}: {why}") from None


def load_serial(address: Address) -> Any:
    """pyserial.

    Raises:
        VehicleError: it is not installed.
    """
    try:
        return importlib.import_module("serial")
    except ImportError:
        raise VehicleError(
            f"{address} needs pyserial; expected it installed: pip install 'uav_dc_ros[mavlink]'"
        ) from None


class _Tcp:
    def __init__(self, address: Address) -> None:
        self.address = address
        self.socket = socket.create_connection((address.place, address.number), timeout=CONNECT_S)
        self.socket.setblocking(False)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # setpoints do not wait for company

    def fileno(self) -> int:
        return self.socket.fileno()

    def read(self) -> bytes:
        try:
            data = self.socket.recv(READ_BYTES)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise ConnectionLost(f"{self.address} broke: {error.strerror}") from None
        if not data:
            raise ConnectionLost(f"{self.address} was closed by the other side")
        return data

    def write(self, data: bytes) -> bool:
        try:
            sent = self.socket.send(data)
        except BlockingIOError:
            sent = 0
        except OSError as error:
            raise ConnectionLost(f"{self.address} broke: {error.strerror}") from None
        if sent < len(data):  # half a message would spoil the next one
            raise ConnectionLost(f"{self.address} takes nothing any more")
        return True

    def answer_here(self) -> None:
        pass

    def close(self) -> None:
        self.socket.close()


class _Udp:
    def __init__(self, address: Address) -> None:
        self.address = address
        family, kind, protocol, _, where = socket.getaddrinfo(
            address.place, address.number, type=socket.SOCK_DGRAM
        )[0]
        self.socket = socket.socket(family, kind, protocol)
        self.socket.setblocking(False)
        self.peer: Any = where if address.kind == "udpout" else None
        self.sender: Any = self.peer  # of what was read last; several vehicles may send to one port
        if address.kind == "udpin":
            try:
                self.socket.bind(where)
            except BaseException:
                self.socket.close()
                raise

    def fileno(self) -> int:
        return self.socket.fileno()

    def read(self) -> bytes:
        try:
            data, self.sender = self.socket.recvfrom(READ_BYTES)
        except (BlockingIOError, ConnectionRefusedError):  # refused: nobody is there yet
            return b""
        except OSError as error:
            raise ConnectionLost(f"{self.address} broke: {error.strerror}") from None
        self.peer = self.peer or self.sender
        return data

    def answer_here(self) -> None:
        self.peer = self.sender

    def write(self, data: bytes) -> bool:
        if self.peer is None:
            return False  # nobody has called yet
        # What does not go out is lost, as UDP may lose anything: heartbeats tell.
        with contextlib.suppress(OSError):
            self.socket.sendto(data, self.peer)
        return True

    def close(self) -> None:
        self.socket.close()


class _Serial:
    def __init__(self, address: Address) -> None:
        serial = load_serial(address)
        self.address = address
        self.port = serial.Serial(
            address.place, address.number, timeout=0, write_timeout=0, exclusive=True
        )  # its errors are OSErrors

    def fileno(self) -> int:
        return int(self.port.fileno())

    def read(self) -> bytes:
        try:
            return bytes(self.port.read(READ_BYTES))
        except OSError as error:
            raise ConnectionLost(f"{self.address} broke: {error}") from None

    def write(self, data: bytes) -> bool:
        try:
            sent = self.port.write(data)
        except OSError as error:
            raise ConnectionLost(f"{self.address} broke: {error}") from None
        if sent is not None and sent < len(data):
            raise ConnectionLost(f"{self.address} takes nothing any more")
        return True

    def answer_here(self) -> None:
        pass

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self.port.close()
