"""Two hosts and a bad link between them: network namespaces joined by a process that loses and delays frames.

    with Link(loss=0.2, delay_s=0.1, jitter_s=0.02, seed=1) as link:
        process = subprocess.Popen(link.command("a", ["python", "-m", ...]))
        link.partition()
        link.heal()

The kernel's own tool for this, `tc netem`, is a module that many kernels lack. So each host's only device is
a tap, and this file, run as a program, carries Ethernet frames from one tap to the other: the same way
everywhere.

The namespaces have no names: they live as file descriptors of that program, which ends when its standard
input does. So nothing can be left behind, even by a test that was killed.
"""

import ctypes
import fcntl
import functools
import heapq
import itertools
import json
import os
import random
import selectors
import shutil
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from types import TracebackType
from typing import Any, Self

TUN = "/dev/net/tun"
TUNSETIFF, IFF_TAP, IFF_NO_PI = 0x400454CA, 0x0002, 0x1000
CLONE_NEWNET = 0x40000000
DEVICE = "link0"
ADDRESSES = {"a": "10.77.0.1", "b": "10.77.0.2"}
OTHER = {"a": "b", "b": "a"}
FRAME_MAX = 65536


class LinkError(Exception):
    """The link cannot be made or used; says why."""


@dataclass(kw_only=True)
class Carried:
    """What became of the frames that one host sent.

    Attributes:
        carried, lost, cut: frames delivered, lost by chance, and lost to a partition.
    """

    carried: int = 0
    lost: int = 0
    cut: int = 0


@dataclass(kw_only=True)
class Quality:
    """How bad the link is, alike in both directions.

    Attributes:
        loss: probability that a frame is lost.
        delay_s, jitter_s: each frame takes delay_s +- jitter_s, evenly spread; so frames overtake each other.
        up: is it there at all? If not, frames on their way are lost, too.
    """

    loss: float = 0.0
    delay_s: float = 0.0
    jitter_s: float = 0.0
    up: bool = True

    def __post_init__(self) -> None:
        if not (0.0 <= self.loss <= 1.0 and 0.0 <= self.jitter_s <= self.delay_s):
            raise ValueError(f"{self}; expected loss in [0, 1] and 0 <= jitter_s <= delay_s")


@dataclass(frozen=True)
class Host:
    """One end of the link: its address, and where its network namespace is found."""

    address: str
    namespace: str


class Link:
    """Two hosts, "a" and "b", and the link between them; a context manager.

    Args:
        seed: of what is lost, and of the jitter.
        quality: as in `Quality`.
    """

    def __init__(self, *, seed: int = 0, **quality: float) -> None:
        self._seed = seed
        self._quality = Quality(**quality)
        self.hosts: dict[str, Host] = {}

    def __enter__(self) -> Self:
        self._forwarder = subprocess.Popen(
            [sys.executable, __file__, json.dumps({"seed": self._seed, "quality": asdict(self._quality)})],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,  # Ctrl-C is for the test, which ends this one
        )
        try:
            namespaces = self._heard()
        except BaseException:
            self.__exit__(None, None, None)
            raise
        for name, descriptor in namespaces.items():
            self.hosts[name] = Host(ADDRESSES[name], f"/proc/{self._forwarder.pid}/fd/{descriptor}")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        assert self._forwarder.stdin is not None
        assert self._forwarder.stdout is not None
        self._forwarder.stdin.close()
        try:
            self._forwarder.wait(5)
        except subprocess.TimeoutExpired:
            self._forwarder.kill()
            self._forwarder.wait()
        self._forwarder.stdout.close()

    def command(self, host: str, arguments: Sequence[object]) -> list[str]:
        """The command that runs `arguments` in a host; the process keeps its id."""
        enter = f"--net={self.hosts[host].namespace}"
        return ["nsenter", enter, "--", *(str(argument) for argument in arguments)]

    def udp(self, host: str) -> socket.socket:
        """A UDP socket of this process that is in a host: a socket stays where it was made."""
        with open("/proc/thread-self/ns/net") as here, open(self.hosts[host].namespace) as there:
            _libc("setns", there.fileno(), CLONE_NEWNET)
            try:
                return socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            finally:
                _libc("setns", here.fileno(), CLONE_NEWNET)

    def set(self, **quality: float) -> None:
        """Change the quality, for frames sent from now on."""
        self._quality = Quality(**asdict(self._quality) | quality)
        self.statistics()

    def partition(self) -> None:
        """Cut the link: nothing passes, until it heals."""
        self.set(up=False)

    def heal(self) -> None:
        """Mend a link that was cut; it is as good or bad as before."""
        self.set(up=True)

    def statistics(self) -> dict[str, Carried]:
        """What became of the frames so far, by the host that sent them; those on their way are not in it."""
        assert self._forwarder.stdin is not None
        try:
            self._forwarder.stdin.write(json.dumps(asdict(self._quality)) + "\n")
            self._forwarder.stdin.flush()
        except BrokenPipeError:
            raise LinkError(f"the link's process ended with {self._forwarder.wait()}") from None
        return {host: Carried(**counts) for host, counts in self._heard().items()}

    def _heard(self) -> dict[str, Any]:
        assert self._forwarder.stdout is not None
        line = self._forwarder.stdout.readline()
        if not line:
            raise LinkError(f"the link's process ended with {self._forwarder.wait()}")
        heard: dict[str, Any] = json.loads(line)
        if "error" in heard:
            raise LinkError(heard["error"])
        return heard


@functools.cache
def unavailable() -> str | None:
    """Why there can be no link on this machine; None if there can."""
    if os.geteuid() != 0:
        return "network namespaces need root"
    for tool in ("ip", "nsenter"):
        if shutil.which(tool) is None:
            return f"no program {tool!r}"
    try:
        with Link() as link:
            subprocess.run(link.command("a", ["true"]), check=True, capture_output=True)
    except (LinkError, subprocess.CalledProcessError) as error:
        return f"no network namespaces: {error}"
    return None


# The program that is the link.


@dataclass
class Forwarder:
    """Carries frames between two taps, as well as `quality` says."""

    taps: dict[str, int]
    quality: Quality
    seed: int
    counts: dict[str, Carried] = field(default_factory=lambda: {host: Carried() for host in ADDRESSES})

    def __post_init__(self) -> None:
        # One each: what one host sends must not change what is lost of the other's.
        self._chance = {host: random.Random(f"{self.seed} {host}") for host in self.taps}
        self._waiting: list[tuple[float, int, str, bytes]] = []  # due, order, sender, frame
        self._order = itertools.count()

    def run(self) -> None:
        """Carry frames until standard input ends."""
        with selectors.DefaultSelector() as selector:
            selector.register(0, selectors.EVENT_READ, None)
            for host, tap in self.taps.items():
                selector.register(tap, selectors.EVENT_READ, host)
            while True:
                until_s = self._waiting[0][0] - time.monotonic() if self._waiting else None
                for key, _ in selector.select(None if until_s is None else max(0.0, until_s)):
                    if key.data is not None:
                        self._take(key.data)
                    elif not self._obey():
                        return
                self._deliver()

    def _obey(self) -> bool:
        line = os.read(0, FRAME_MAX)  # whole: the other side waits for an answer before it says more
        if not line:
            return False
        for host in self.taps:
            self._take(host)  # what was sent before is treated as before
        self._deliver()
        self.quality = Quality(**json.loads(line))
        if not self.quality.up:
            for _, _, host, _ in self._waiting:
                self.counts[host].cut += 1
            self._waiting.clear()
        _tell({host: asdict(counts) for host, counts in self.counts.items()})
        return True

    def _take(self, host: str) -> None:
        """Take what a host has sent, and decide what becomes of it."""
        quality, chance, counts = self.quality, self._chance[host], self.counts[host]
        while True:
            try:
                frame = os.read(self.taps[host], FRAME_MAX)
            except BlockingIOError:
                return
            lost = chance.random() < quality.loss
            delay_s = quality.delay_s + quality.jitter_s * chance.uniform(-1.0, 1.0)
            if not quality.up:
                counts.cut += 1
            elif lost:
                counts.lost += 1
            else:
                due_s = time.monotonic() + delay_s
                heapq.heappush(self._waiting, (due_s, next(self._order), host, frame))

    def _deliver(self) -> None:
        """Deliver what is due."""
        while self._waiting and self._waiting[0][0] <= time.monotonic():
            _, _, host, frame = heapq.heappop(self._waiting)
            os.write(self.taps[OTHER[host]], frame)
            self.counts[host].carried += 1


def _make_host(address: str) -> tuple[int, int]:
    """Move to a new namespace, and make its devices; descriptors of the namespace and its tap."""
    _libc("unshare", CLONE_NEWNET)
    namespace = os.open("/proc/self/ns/net", os.O_RDONLY)
    tap = os.open(TUN, os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(tap, TUNSETIFF, struct.pack("16sH22x", DEVICE.encode(), IFF_TAP | IFF_NO_PI))
    for command in (
        "link set lo up",
        # No IPv6: what it says to set itself up would only blur the counts.
        f"link set {DEVICE} addrgenmode none",
        f"address add {address}/24 dev {DEVICE}",
        f"link set {DEVICE} up multicast on",
        f"route add 224.0.0.0/4 dev {DEVICE}",
    ):
        subprocess.run(["ip", *command.split()], check=True, capture_output=True, text=True)
    return namespace, tap


def _libc(name: str, *arguments: int) -> None:
    """Call a function of the C library that Python 3.11 does not offer."""
    libc = ctypes.CDLL(None, use_errno=True)
    if getattr(libc, name)(*arguments) != 0:
        raise OSError(ctypes.get_errno(), f"{name}: {os.strerror(ctypes.get_errno())}")


def _tell(told: dict[str, Any]) -> None:
    print(json.dumps(told), flush=True)


def main() -> None:
    """Be the link: standard input has its quality, one JSON line each, and the answers are the counts."""
    options = json.loads(sys.argv[1])
    try:
        made = {host: _make_host(address) for host, address in ADDRESSES.items()}
    except OSError as error:
        return _tell({"error": str(error)})
    except subprocess.CalledProcessError as error:
        return _tell({"error": f"{' '.join(error.cmd)}: {error.stderr.strip()}"})
    _tell({host: namespace for host, (namespace, _) in made.items()})
    taps = {host: tap for host, (_, tap) in made.items()}
    Forwarder(taps, Quality(**options["quality"]), options["seed"]).run()
    return None


if __name__ == "__main__":
    main()
