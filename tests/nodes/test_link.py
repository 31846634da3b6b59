"""The bad link is as bad as it says: real sockets in both of its hosts."""

import contextlib
import os
import socket
import statistics
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.nodes.link import Link, LinkError, unavailable

pytestmark = pytest.mark.skipif(unavailable() is not None, reason=f"no link: {unavailable()}")

PORT = 7000
GROUP = "239.255.0.1"  # the group in which DDS participants find each other
BOTH = (("a", "b"), ("b", "a"))


@contextlib.contextmanager
def ends(link: Link) -> Iterator[dict[str, socket.socket]]:
    """A socket in each host; each knows the other's hardware address by now."""
    with link.udp("a") as a, link.udp("b") as b:
        sockets = {"a": a, "b": b}
        for host, end in sockets.items():
            end.bind((link.hosts[host].address, PORT))
        for sender, receiver in BOTH:
            while True:
                sockets[sender].sendto(b"hello", (link.hosts[receiver].address, PORT))
                if heard(sockets[receiver]):
                    break
        link.statistics()  # all that was sent has been delivered by now
        for end in sockets.values():
            while heard(end):
                pass
        yield sockets


def heard(end: socket.socket, patience_s: float = 0.05) -> bytes | None:
    """The next datagram, if one comes in time."""
    end.settimeout(patience_s)
    try:
        return end.recv(2048)
    except TimeoutError:
        return None


def test_a_good_link_loses_nothing_and_keeps_the_order() -> None:
    with Link() as link, ends(link) as sockets:
        for sender, receiver in BOTH:
            for number in range(100):
                sockets[sender].sendto(struct.pack("I", number), (link.hosts[receiver].address, PORT))
                assert heard(sockets[receiver], 30.0) == struct.pack("I", number)
        assert all(counts.lost == counts.cut == 0 for counts in link.statistics().values())


def test_loss_is_as_told_and_is_counted() -> None:
    """Of 2000 datagrams, 20% are 400 +- 18: five deviations are 90."""
    with Link() as link, ends(link) as sockets:
        link.set(loss=0.2)
        for sender, receiver in BOTH:
            before = link.statistics()[sender]
            arrived = 0
            for _ in range(20):  # no more at once than a socket's buffer holds
                for _ in range(100):
                    sockets[sender].sendto(b"x" * 64, (link.hosts[receiver].address, PORT))
                link.statistics()  # all that is not lost has been delivered by now
                while heard(sockets[receiver]):
                    arrived += 1
            after = link.statistics()[sender]
            assert 310 <= 2000 - arrived <= 490
            # The kernel asks for hardware addresses, now and then.
            assert abs(after.carried - before.carried - arrived) <= 10
            assert abs(after.lost - before.lost - (2000 - arrived)) <= 10


def test_the_same_seed_loses_the_same() -> None:
    def lost(seed: int) -> list[int]:
        arrived = []
        with Link(seed=seed) as link, ends(link) as sockets:
            link.set(loss=0.5)
            for number in range(50):
                sockets["a"].sendto(struct.pack("I", number), (link.hosts["b"].address, PORT))
            link.statistics()
            while len(arrived) < 50 and (data := heard(sockets["b"])):
                arrived.append(struct.unpack("I", data)[0])
        return arrived

    first = lost(1)
    assert lost(1) == first
    assert lost(2) != first


def test_delay_and_jitter_are_as_told() -> None:
    with Link() as link, ends(link) as sockets:
        link.set(delay_s=0.1, jitter_s=0.02)
        for sender, receiver in BOTH:
            for number in range(100):
                sockets[sender].sendto(
                    struct.pack("Id", number, time.monotonic()), (link.hosts[receiver].address, PORT)
                )
                time.sleep(0.001)
            numbers, delays_s = [], []
            for _ in range(100):
                number, sent_s = struct.unpack("Id", heard(sockets[receiver], 30.0) or b"")
                numbers.append(number)
                delays_s.append(time.monotonic() - sent_s)
            assert sorted(numbers) == list(range(100))
            assert numbers != sorted(numbers)  # they overtook each other
            # A loaded machine adds to a delay, and takes nothing from it.
            assert min(delays_s) >= 0.08
            assert statistics.median(delays_s) >= 0.095


def test_a_partition_stops_everything_until_it_heals() -> None:
    with Link() as link, ends(link) as sockets:
        link.partition()
        for sender, receiver in BOTH:
            sockets[sender].sendto(b"lost", (link.hosts[receiver].address, PORT))
            assert heard(sockets[receiver]) is None
        assert all(counts.cut >= 1 for counts in link.statistics().values())
        link.heal()
        for sender, receiver in BOTH:
            sockets[sender].sendto(b"back", (link.hosts[receiver].address, PORT))
            assert heard(sockets[receiver], 30.0) == b"back"


def test_a_partition_takes_what_is_on_its_way() -> None:
    with Link() as link, ends(link) as sockets:
        link.set(delay_s=0.6)
        sockets["a"].sendto(b"lost", (link.hosts["b"].address, PORT))
        time.sleep(0.02)
        link.partition()
        link.heal()
        assert heard(sockets["b"], 0.8) is None
        assert link.statistics()["a"].cut == 1


def test_multicast_reaches_the_other_host() -> None:
    with Link() as link, ends(link) as sockets:
        for sender, receiver in BOTH:
            with link.udp(receiver) as member:
                member.bind((GROUP, PORT))
                own = socket.inet_aton(link.hosts[receiver].address)
                member.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, socket.inet_aton(GROUP) + own)
                sockets[sender].sendto(b"who is there?", (GROUP, PORT))
                assert heard(member, 30.0) == b"who is there?"


def test_hosts_are_strangers_to_this_machine_and_to_other_links() -> None:
    with Link() as one, Link() as two, ends(one), ends(two), pytest.raises(OSError, match="Cannot assign"):
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM).bind((one.hosts["a"].address, PORT))


def test_a_command_runs_in_its_host() -> None:
    with Link() as link:
        for host, end in link.hosts.items():
            command = link.command(host, ["ip", "-o", "address", "show", "dev", "link0"])
            assert end.address in subprocess.run(command, capture_output=True, text=True, check=True).stdout


def test_nothing_is_left_of_a_link() -> None:
    """Neither after an exception, nor after the end of a process that had no time to tidy up."""
    with pytest.raises(ZeroDivisionError), Link() as link:
        raise ZeroDivisionError
    assert not Path(link.hosts["a"].namespace).exists()

    script = (
        "import os, time\nfrom tests.nodes.link import Link\n"
        "with Link() as link:\n  print(link.hosts['a'].namespace, flush=True)\n  time.sleep(60)"
    )
    root = Path(__file__).parents[2]
    with subprocess.Popen(
        [sys.executable, "-c", script],
        cwd=root,
        env={**os.environ, "PYTHONPATH": str(root)},
        stdout=subprocess.PIPE,
        text=True,
    ) as killed:
        assert killed.stdout is not None
        namespace = Path(killed.stdout.readline().strip())
        assert namespace.exists()
        killed.kill()
    deadline_s = time.monotonic() + 60.0
    while namespace.exists() and time.monotonic() < deadline_s:
        time.sleep(0.01)
    assert not namespace.exists()


def test_a_link_that_makes_no_sense_is_refused() -> None:
    with pytest.raises(ValueError, match=r"loss=1\.5"):
        Link(loss=1.5)
    with Link() as link, pytest.raises(ValueError, match="jitter_s <= delay_s"):
        link.set(jitter_s=0.1)


def test_a_link_whose_process_died_says_so() -> None:
    with Link() as link:
        link._forwarder.kill()
        with pytest.raises(LinkError, match="ended with -9"):
            link.statistics()
