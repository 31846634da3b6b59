"""Garbage for each topic, without end: broken, oversized and impossible messages, and why each is refused.

Whether a payload that was damaged by chance is still one is decided by a reader of its own: Python's json
with the schemas in msgs_json/. Such a one is left out. So is what no receiver can tell from the truth: a
lie that breaks no rule.

Payloads are written with a blank after each comma, which the nodes never do: in a bag, the payloads of
nodes can be told from those made here.
"""

import json
import math
import random
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import jsonschema
from rclpy.serialization import serialize_message

from tests.nodes import poses
from uav_dc_ros import cdr, files, messages
from uav_dc_ros.core.grid import ACTION_LABELS
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import MessageError

JSON_TOPICS = tuple(messages.PAYLOADS)
TOPICS = (*JSON_TOPICS, "pose")
NOBODY_S_MISSION = 1_000_000  # no test flies so many
RUN = "0123456789abcdef"  # of the missions that are flown under fire
UNDECODABLE = "undecodable"  # the middleware drops it, or the node refuses it as malformed
COLUMNS = {
    "users": ("cluster", "x_m", "y_m"),
    "rates": ("sinr", "rate_bps", "data_bits", "served", "collected"),
}
NOT_UTF8 = (b"\xff", b"\x80", b"\xc0\xaf", b"\xed\xa0\x80", b"\xf5\x80\x80\x80", b"\xe2\x82")
WRONG = (None, True, -1, 1.5, "", "7", [], {}, [[[]]], {"a": {"b": 1}}, 2**31, 2**64, -(2**70), [None], ["x"])
NOT_JSON = ("NaN", "Infinity", "-Infinity", "nan", "00", "1.", ".5", "+1", "'x'", "tru", "0x10", "1e", "\x01")


@dataclass(frozen=True)
class Garbage:
    """A message to refuse.

    Attributes:
        kind: how it was made.
        reason: for which a node must count it as rejected.
        data: its serialised form.
    """

    kind: str
    reason: str
    data: bytes


class Reader:
    """Decides, without the code under test, whether a text is a payload of a topic."""

    def __init__(self, topic: str) -> None:
        schema = json.loads((files.shipped_folder("msgs_json") / f"{topic}.schema.json").read_text("utf-8"))
        self._validator = jsonschema.Draft202012Validator(schema)
        self._columns = COLUMNS.get(topic, ())

    def accepts(self, text: bytes) -> bool:
        """Is it a payload: JSON, as the schema has it, with columns of one length."""
        try:
            value = json.loads(text.decode("utf-8"), parse_constant=_refuse)
        except (ValueError, RecursionError):
            return False
        if not self._validator.is_valid(value):
            return False
        numbers = [number for entry in value.values() if isinstance(entry, list) for number in entry]
        numbers += [entry for entry in value.values() if isinstance(entry, float)]
        return len({len(value[name]) for name in self._columns}) <= 1 and all(map(_is_finite, numbers))


def _refuse(constant: str) -> None:
    raise ValueError(constant)


def _is_finite(value: Any) -> bool:
    try:
        return not isinstance(value, int | float) or math.isfinite(value)
    except OverflowError:  # a whole number beyond all floats
        return False


def honest(topic: str, scenario: Scenario, rng: random.Random) -> dict[str, Any]:
    """A payload as a node might say it, of a mission that is not flown."""
    n_users = scenario.n_users
    stepped: dict[str, Any] = {
        "run": RUN,
        "mission": NOBODY_S_MISSION + rng.randrange(1000),
        "step": rng.randrange(1, scenario.mission.max_steps),
    }

    def column() -> list[float]:
        return [rng.uniform(0, 1e6) for _ in range(n_users)]

    if topic == "users":
        cluster = scenario.user_cluster.tolist()
        return stepped | {"stamp_ns": 0, "cluster": cluster, "x_m": column(), "y_m": column()}
    if topic == "rates":
        numbers = {name: column() for name in ("sinr", "rate_bps", "data_bits")}
        switches = {name: [rng.random() < 0.5] * n_users for name in ("served", "collected")}
        return stepped | {"sum_rate_bps": rng.uniform(0, 1e9)} | numbers | switches
    if topic == "mission":
        return stepped | {
            "phase": "ready",
            "cell": [rng.randrange(3) for _ in range(3)],
            "remaining_steps": rng.randrange(30),
            "seed": rng.randrange(2**63),
            "scenario": scenario.name,
            "fingerprint": scenario.fingerprint,
        }
    if topic == "move":
        return stepped | {"action": rng.choice(ACTION_LABELS)}
    return {"run": RUN, "node": "policy"}


class Maker:
    """Makes garbage for a JSON topic.

    Args:
        topic: of the topic table.
        scenario: that is flown.
        rng: source of all chance.
    """

    def __init__(self, topic: str, scenario: Scenario, rng: random.Random) -> None:
        self.topic, self.scenario, self.rng = topic, scenario, rng
        self._reader = Reader(topic)
        self._kinds: list[Callable[[], tuple[bytes, str | None]]] = [
            *(self.truncated, self.flipped, self.spliced, self.not_utf8, self.not_a_number, self.surplus),
            *(self.missing, self.unknown, self.wrong_type, self.out_of_range, self.nested, self.huge),
            *(self.twice, self.other_top, self.noise, self.liar, self.other_bytes, self.another_run),
        ]
        if topic in COLUMNS:
            self._kinds += [self.uneven, self.layout]
        self._kinds += {
            "users": [self.no_pose],
            "mission": [self.other_world],
            "move": [self.wrong_step, self.wrong_step, self.unknown_action],
        }.get(topic, [])

    def one(self) -> Garbage:
        """One more."""
        while True:
            make = self.rng.choice(self._kinds)
            data, reason = make()
            if reason is None:  # damaged at random: a payload may have come out
                text = cdr.decode_string(data)
                if self._reader.accepts(text):
                    continue
                reason = self.told(text)
            return Garbage(make.__name__, reason, data)

    def told(self, text: bytes) -> str:
        """Why the decoder refuses what has more than one flaw: it depends on which one it meets first."""
        try:
            messages.decode(text, messages.PAYLOADS[self.topic])
        except MessageError as error:
            return error.reason
        raise AssertionError(f"accepted, although it is no payload: {text!r}")

    def honest(self) -> dict[str, Any]:
        return honest(self.topic, self.scenario, self.rng)

    def text(self) -> bytes:
        return json.dumps(self.honest()).encode()

    def changed(self, **values: Any) -> bytes:
        return cdr.encode_string(json.dumps(self.honest() | values).encode())

    def field(self) -> str:
        return self.rng.choice(list(self.honest()))

    # Not JSON.

    def truncated(self) -> tuple[bytes, str | None]:
        text = self.text()
        return cdr.encode_string(text[: self.rng.randrange(len(text))]), "malformed"

    def flipped(self) -> tuple[bytes, str | None]:
        text = bytearray(self.text())
        for _ in range(self.rng.choice((1, 1, 2, 8))):
            text[self.rng.randrange(len(text))] ^= 1 << self.rng.randrange(8)
        return cdr.encode_string(bytes(text)), None

    def spliced(self) -> tuple[bytes, str | None]:
        one, other = self.text(), self.text()
        at = self.rng.randrange(len(one))
        junk = self.rng.choice(
            (b"\0", b"\0" * 50, b"\n\x1b[2J", b"}", b"\\", b'"', b"/**/", b"\xef\xbb\xbf", b"")
        )
        return cdr.encode_string(one[:at] + junk + other[self.rng.randrange(len(other)) :]), None

    def not_utf8(self) -> tuple[bytes, str | None]:
        text = self.text()
        quotes = [i for i, byte in enumerate(text) if byte == ord('"')]
        at = self.rng.choice(quotes) + self.rng.choice((0, 1))
        return cdr.encode_string(text[:at] + self.rng.choice(NOT_UTF8) + text[at:]), None

    def not_a_number(self) -> tuple[bytes, str | None]:
        name = self.field()
        text = json.dumps(self.honest() | {name: "@"}).replace('"@"', self.rng.choice(NOT_JSON))
        return cdr.encode_string(text.encode()), None

    def surplus(self) -> tuple[bytes, str | None]:
        junk = self.rng.choice((b",", b"}", b"0", b"\0", b"{}", b'"', b"//", b" \x00"))
        return cdr.encode_string(self.text() + junk), "malformed"

    def other_bytes(self) -> tuple[bytes, str | None]:
        code = self.rng.choice(("utf-16", "utf-16-le", "utf-32", "utf-8-sig", "cp037"))
        return cdr.encode_string(self.text().decode().encode(code)), None

    def noise(self) -> tuple[bytes, str | None]:
        return cdr.encode_string(self.rng.randbytes(self.rng.choice((0, 1, 3, 30, 300)))), None

    # JSON, but not the schema's.

    def missing(self) -> tuple[bytes, str | None]:
        payload = self.honest()
        needed = [name for name in payload if name != "run"]  # which is missing in older bags
        for name in self.rng.sample(needed, self.rng.randint(1, len(needed))):
            del payload[name]
        return cdr.encode_string(json.dumps(payload).encode()), "invalid"

    def unknown(self) -> tuple[bytes, str | None]:
        name = self.rng.choice(
            ("surplus", "", "Mission", "step ", "\x1b[31m", "a" * 500, "\n", "\u202e", "node_")
        )
        return self.changed(**{name: 1}), "invalid"

    def wrong_type(self) -> tuple[bytes, str | None]:
        return self.changed(**{self.field(): self.rng.choice(WRONG)}), None

    def out_of_range(self) -> tuple[bytes, str | None]:
        number = self.rng.choice(
            ("1e999", "-1e999", "9" * 400, "-1", "18446744073709551616", "-1e-300", "1e5")
        )
        text = json.dumps(self.honest() | {self.field(): "@"}).replace(
            '"@"', self.rng.choice((number, f"[{number}]"))
        )
        return cdr.encode_string(text.encode()), None

    def nested(self) -> tuple[bytes, str | None]:
        depth = self.rng.choice((2, 100, 1000))
        start, end = self.rng.choice((("[", "]"), ('{"a":', "}"), ('{"mission":', "}")))
        deep = start * depth + "1" + end * self.rng.choice((depth, 0))
        text = json.dumps(self.honest() | {self.field(): "@"}).replace('"@"', deep)
        return cdr.encode_string(self.rng.choice((text, deep)).encode()), None

    def huge(self) -> tuple[bytes, str | None]:
        return self.changed(**{self.field(): self.rng.choice("x\u00e9\U0001f681") * 1500}), "invalid"

    def twice(self) -> tuple[bytes, str | None]:
        """A field twice, the second time of another type."""
        name = self.field()
        text = json.dumps(self.honest())[:-1] + f', "{name}": {json.dumps(self.rng.choice(WRONG))}}}'
        return cdr.encode_string(text.encode()), None

    def other_top(self) -> tuple[bytes, str | None]:
        text = self.rng.choice(
            ("null", "true", "7", "-0.5", '"move"', "[]", "[{}]", json.dumps([self.honest()]))
        )
        return cdr.encode_string(text.encode()), "invalid"

    def uneven(self) -> tuple[bytes, str | None]:
        payload = self.honest()
        column = payload[self.rng.choice(COLUMNS[self.topic])]
        column += column[:1]
        return cdr.encode_string(json.dumps(payload).encode()), "invalid"

    def unknown_action(self) -> tuple[bytes, str | None]:
        return self.changed(action=self.rng.choice(("up", "LEFT", "left ", "", "land", "hover\0"))), "invalid"

    # Of the schema, but not of this mission.

    def layout(self) -> tuple[bytes, str | None]:
        """Other users."""
        n_users = self.rng.choice([n for n in (0, 1, 3, 5, 400) if n != self.scenario.n_users])
        values = {name: (self.honest()[name] * n_users)[:n_users] for name in COLUMNS[self.topic]}
        if self.topic == "users" and self.rng.random() < 0.5:
            values = {"cluster": [7] * self.scenario.n_users}
        return self.changed(**values), "layout"

    def no_pose(self) -> tuple[bytes, str | None]:
        """Users of the past, whose pose is long forgotten."""
        return self.changed(), "no_pose"

    def other_world(self) -> tuple[bytes, str | None]:
        return self.changed(fingerprint=f"{self.rng.randrange(2**48):012x}"), "scenario"

    def another_run(self) -> tuple[bytes, str | None]:
        """Of another mission, or of a bag that is older than runs; `ready` may come before a run."""
        runs = ("f" * 16, f"{self.rng.randrange(2**64):016x}", *(("",) if self.topic != "ready" else ()))
        return self.changed(run=self.rng.choice(runs)), "another_run"

    def wrong_step(self) -> tuple[bytes, str | None]:
        """A move for another mission, one that is over, or no step of this one."""
        wrong = self.rng.choice(
            ({}, {"mission": 0}, {"mission": 2**31 - 1}, {"mission": 5, "step": 2**31 - 1})
        )
        return self.changed(**wrong), "wrong_step"

    # Not even a text.

    def liar(self) -> tuple[bytes, str | None]:
        """A serialised text that is shorter or longer than it says."""
        text = self.text()
        honest = cdr.encode_string(text)
        more = self.rng.choice((len(text) + 100, 2**31 - 1, 2**32 - 1, 2**24))
        return (
            self.rng.choice(
                (
                    honest[: self.rng.randrange(1, len(honest) - 1)],
                    honest[:4] + struct.pack("<I", more) + honest[8:],
                    honest[:4] + struct.pack("<I", self.rng.randrange(len(text) - 1)) + honest[8:],
                    b"\0\0" + honest[2:],  # the numbers of the other byte order
                    honest[:8],
                    honest[:4],
                    b"\0",
                )
            ),
            "malformed",
        )


def garbage(topic: str, scenario: Scenario, seed: int) -> Iterator[Garbage]:
    """Garbage for a topic, without end; the same for the same seed."""
    rng = random.Random(f"{seed} {topic}")
    if topic == "pose":
        while True:
            yield _pose(rng)
    maker = Maker(topic, scenario, rng)
    while True:
        yield maker.one()


def oversized(size: int = messages.MAX_BYTES + 1) -> Garbage:
    """A text longer than any payload may be."""
    return Garbage("oversized", "oversized", cdr.encode_string(b" " * size))


def _pose(rng: random.Random) -> Garbage:
    message = poses.pose([rng.uniform(-1e3, 1e3) for _ in range(3)], 0)
    message.header.stamp.sec = rng.choice((0, -1, -(2**31), 2**31 - 1))
    message.header.stamp.nanosec = rng.choice((0, 2**32 - 1))
    kind = rng.choice(("not_finite", "frame", UNDECODABLE))
    if kind == "not_finite":
        bad = rng.choice((math.nan, math.inf, -math.inf))
        for axis in rng.choice(("x", "y", "z", "xyz")):
            setattr(message.pose.position, axis, bad)
    elif kind == "frame":
        message.header.frame_id = rng.choice(
            ("", "odom", "MAP", "/map", "map ", "mapp", "m\u00e4p", "x" * 1500)
        )
        message.pose.position.x = rng.choice((1.0, math.nan))
    data = serialize_message(message)
    if message.header.frame_id == "odom":  # text in place, its length before it
        data = data[:16] + rng.choice((b"odom", b"\xff\xfe\x80\xc0", b"m\0ap", b"\x1b[2J")) + data[20:]
    if kind == UNDECODABLE:
        long = data[:12] + struct.pack("<I", rng.choice((10**4, 2**31, 2**32 - 1))) + data[16:]
        data = rng.choice((data[: rng.randrange(4, 60)], long))
    return Garbage(kind, kind, data)
