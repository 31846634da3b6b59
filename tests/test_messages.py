"""The JSON contract: what travels, what is refused, and that msgs_json/ is the same."""

import json
import math
import time
from collections.abc import Callable
from typing import Any

import jsonschema
import msgspec
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from tests.conftest import outcome
from uav_dc_ros import files, messages, topics
from uav_dc_ros.core.grid import ACTION_LABELS, ActionLabel
from uav_dc_ros.errors import MessageError
from uav_dc_ros.messages import PAYLOADS, FaultKind, Mission, Move, Phase, Rates, Ready, Users

RUN = "0123456789abcdef"
EXAMPLES = {
    "users": Users(
        run=RUN,
        mission=0,
        step=3,
        stamp_ns=45 * 10**9,
        cluster=[0, 1],
        x_m=[1.5, -2.0],
        y_m=[0.1, 1e-9],
    ),
    "rates": Rates(
        run=RUN,
        mission=0,
        step=3,
        sum_rate_bps=0.1 + 0.2,
        sinr=[1 / 3, 0.0],
        rate_bps=[5e-324, 1e6],
        data_bits=[1.0, 2.0],
        served=[True, False],
        collected=[False, True],
    ),
    "mission": Mission(
        run=RUN,
        mission=0,
        step=3,
        phase=Phase.READY,
        reason="no position for 0.5 s",
        held=True,
        fault=FaultKind.POSITION,
        cell=(1, 2, 0),
        remaining_steps=57,
        seed=2**63 - 1,
        scenario="five_clusters_hover",
        fingerprint="0123456789ab",
    ),
    "move": Move(run=RUN, mission=0, step=3, action="upward"),
    "ready": Ready(run=RUN, node="policy"),
}
OPTIONAL = {  # older bags have none
    ("mission", "reason"),
    ("mission", "steps_not_reached"),
    ("mission", "held"),
    ("mission", "fault"),
    *((topic, "run") for topic in PAYLOADS),
}


@pytest.mark.parametrize("topic", PAYLOADS)
def test_a_payload_arrives_as_it_was_sent(topic: str) -> None:
    sent = EXAMPLES[topic]
    assert messages.decode(messages.encode(sent), PAYLOADS[topic]) == sent


@pytest.mark.parametrize(
    ("fields", "held"),
    [
        ({"reason": "holds: no position for 0.5 s"}, True),  # as in version 0.1
        ({"reason": "goes on after: holds: no position for 0.5 s"}, False),
        ({}, False),
        ({"reason": "no position for 0.5 s", "held": True, "fault": "position"}, True),
        ({"reason": "no position for 0.5 s", "held": False, "fault": None}, False),
    ],
)
def test_held_is_a_field_and_in_an_old_payload_a_prefix(fields: dict[str, Any], held: bool) -> None:
    payload = json.loads(messages.encode(EXAMPLES["mission"]))
    for name in ("reason", "held", "fault"):
        del payload[name]
    mission = messages.decode(json.dumps(payload | fields), Mission)
    assert (mission.held, mission.fault) == (held, fields.get("fault"))
    assert mission.reason == fields.get("reason", ""), "as it was recorded"
    assert mission.state == ("ready (held)" if held else "ready")


@pytest.mark.parametrize("topic", PAYLOADS)
def test_the_published_schema_is_the_code_s(topic: str) -> None:
    path = files.shipped_folder("msgs_json") / f"{topic}.schema.json"
    assert path.read_text("utf-8") == messages.schema_text(PAYLOADS[topic]), (
        "run `python -m uav_dc_ros.messages` and look at the difference: it changes the contract"
    )


def test_no_schema_is_left_over() -> None:
    names = {path.name for path in files.shipped_folder("msgs_json").iterdir()}
    assert names == {f"{topic}.schema.json" for topic in PAYLOADS}


@pytest.mark.parametrize("topic", PAYLOADS)
def test_an_independent_validator_agrees(topic: str) -> None:
    schema = json.loads((files.shipped_folder("msgs_json") / f"{topic}.schema.json").read_text("utf-8"))
    jsonschema.Draft202012Validator.check_schema(schema)
    validator = jsonschema.Draft202012Validator(schema)
    good = json.loads(messages.encode(EXAMPLES[topic]))
    validator.validate(good)
    for key in good:
        less = {name: value for name, value in good.items() if name != key}
        if (topic, key) in OPTIONAL:
            validator.validate(less)
            messages.decode(json.dumps(less), PAYLOADS[topic])
            less = {}
        nothing = {key: None} if key != "fault" else {key: "none"}
        for bad in (less, good | nothing, good | {key: {}}, good | {"surplus": 1}):
            assert not validator.is_valid(bad)
            with pytest.raises(MessageError):
                messages.decode(json.dumps(bad), PAYLOADS[topic])


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "malformed"),
        ("{", "malformed"),
        ("\ud800", "malformed"),
        ("[" * 100_000, "invalid"),
        ("null", "invalid"),
        ('{"mission":0,"step":0,"action":"up"}', "invalid"),
        ('{"mission":0,"step":-1,"action":"hover"}', "invalid"),
        ('{"mission":0,"step":1.5,"action":"hover"}', "invalid"),
        ('{"mission":0,"step":"1","action":"hover"}', "invalid"),
        ('{"mission":0,"step":NaN,"action":"hover"}', "malformed"),
        ('{"mission":0,"step":1e400,"action":"hover"}', "invalid"),
        (b'{"mission":0,"step":0,"action":"\xff"}', "malformed"),
        (b'{"mission":0,"st\xffep":0,"action":"hover"}', "malformed"),
        (b'{"mission":0,"step":0,"action":"hover"}\0', "malformed"),
    ],
)
def test_what_is_not_a_payload_is_refused_by_reason(text: str | bytes, reason: str) -> None:
    with pytest.raises(MessageError) as refused:
        messages.decode(text, Move)
    assert refused.value.reason == reason


SCHEMAS = {
    topic: jsonschema.Draft202012Validator(
        json.loads((files.shipped_folder("msgs_json") / f"{topic}.schema.json").read_text("utf-8"))
    )
    for topic in PAYLOADS
}
JUNK = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers(-(2**70), 2**70) | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
    max_leaves=8,
)


def check_decode(topic: str, text: str | bytes) -> None:
    """A payload comes out that the schema allows as well, or a MessageError of a line."""
    came = outcome(lambda: messages.decode(text, PAYLOADS[topic]))
    if isinstance(came, MessageError):
        assert came.reason in ("malformed", "invalid", "oversized")
        assert str(came).isprintable()
        assert len(str(came)) <= 10 * messages.TEXT_MAX
    else:
        assert SCHEMAS[topic].is_valid(json.loads(text))
        assert messages.decode(messages.encode(came), PAYLOADS[topic]) == came


@given(st.sampled_from(sorted(PAYLOADS)), st.binary() | st.text() | JUNK.map(json.dumps))
@example("ready", b'{"node":"a\xff"}')
def test_junk_is_a_payload_or_a_message_error(topic: str, text: str | bytes) -> None:
    check_decode(topic, text)


@given(st.sampled_from(sorted(PAYLOADS)), st.data())
def test_a_payload_with_another_value_is_a_payload_or_a_message_error(topic: str, data: Any) -> None:
    good = json.loads(messages.encode(EXAMPLES[topic]))
    name = data.draw(st.sampled_from([*good, "surplus"]))
    near = [good.get(name), 0, 1, 1.0, -1, 2**31, 2**63, [0], [0, 1, 2], "hover", "policy\n", math.inf]
    check_decode(topic, json.dumps(good | {name: data.draw(JUNK | st.sampled_from(near))}))


@given(st.sampled_from(sorted(PAYLOADS)), st.data())
def test_a_damaged_payload_is_a_payload_or_a_message_error(topic: str, data: Any) -> None:
    text = bytearray(messages.encode(EXAMPLES[topic]))
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(text) - 1))
        text[at : at + data.draw(st.integers(0, 2))] = data.draw(st.binary(max_size=3))
        text = text or bytearray(b" ")
    check_decode(topic, bytes(text))


LARGEST: list[Callable[[], bytes]] = [  # made when they are needed: each is as large as what is read
    lambda: b"[" * messages.MAX_BYTES,
    lambda: b'{"node":' * (messages.MAX_BYTES // 8),
    lambda: b'{"x_m":' + b"[" * (messages.MAX_BYTES - 7),
    lambda: b'{"a":' + b"[" * (messages.MAX_BYTES - 5),
    lambda: b" " * messages.MAX_BYTES,
    lambda: b'"' + b"a" * (messages.MAX_BYTES - 2) + b'"',
    lambda: b'{"' + b"a" * (messages.MAX_BYTES - 2),
    lambda: b'{"node":"' + b"a" * (messages.MAX_BYTES - 11) + b'"}',
    lambda: b'{"mission":' + b"9" * (messages.MAX_BYTES - 12) + b"}",
    lambda: b'{"cluster":[' + b"1," * (messages.MAX_BYTES // 2 - 7) + b"1]}",
    lambda: b"x" * (messages.MAX_BYTES + 1),
]


@pytest.mark.parametrize("made", LARGEST)
def test_the_largest_junk_is_refused_at_once(made: Callable[[], bytes]) -> None:
    text = made()
    for kind in PAYLOADS.values():
        began_s = time.process_time()
        with pytest.raises(MessageError) as refused:
            messages.decode(text, kind)
        assert time.process_time() - began_s < 5.0  # a second or two, for millions of numbers
        assert (
            len(str(refused.value)) <= 10 * messages.TEXT_MAX
        )  # escapes are longer than what they stand for


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_number_that_json_does_not_know_never_leaves(value: float) -> None:
    bad = msgspec.structs.replace(EXAMPLES["users"], x_m=[value, 0.0])
    with pytest.raises(MessageError):
        messages.encode(bad)
    mission = msgspec.structs.replace(EXAMPLES["mission"], fault=None, reason="null")
    assert messages.decode(messages.encode(mission), Mission) == mission
    for fault in (None, messages.FaultKind.LINK):
        with pytest.raises(MessageError):
            messages.encode(msgspec.structs.replace(mission, fault=fault, energy_used_j=value))


def test_columns_have_one_length() -> None:
    text = messages.encode(EXAMPLES["users"]).replace(b"[1.5,-2.0]", b"[1.5]")
    with pytest.raises(MessageError, match="x_m 1, y_m 2"):
        messages.decode(text, Users)


def test_actions_are_those_of_the_grid() -> None:
    assert ActionLabel.__args__ == ACTION_LABELS  # type: ignore[attr-defined]


def test_every_json_topic_has_a_payload() -> None:
    of_type = {topic.name for topic in topics.TOPICS.values() if topic.type == topics.JSON}
    assert of_type == set(PAYLOADS)
