"""Payloads as JSON channels: readers without this package plot them, and they become strings again."""

import json
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from mcap.reader import make_reader

from tests.bags.test_edit import messages
from tests.bags.test_foreign import run
from tests.recordings import made
from tests.support.bags import TYPES, information, text
from tests.support.worlds import tiny
from tests.test_messages import EXAMPLES
from uav_dc_ros import cdr, files
from uav_dc_ros import messages as contract
from uav_dc_ros.bags import json_channels
from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.bags.salvage.recover import recover
from uav_dc_ros.messages import PAYLOADS, Phase

Capture = pytest.CaptureFixture[str]
JSON_TOPICS = ("/users", "/rates", "/mission", "/move")


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bag of a mission, as recorded."""
    world = tiny()
    recorded = made.flight(world, missions=2)
    return made.write(tmp_path_factory.mktemp("flown") / "B", recorded, made.about(world), latched=True)


@pytest.fixture(scope="module")
def converted(flown: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same with JSON channels."""
    from uav_dc_ros import bag

    folder = tmp_path_factory.mktemp("converted") / "J"
    with pytest.raises(SystemExit):
        bag.main(["convert", str(flown), "--out", str(folder), "--json-channels"])
    return folder


def test_a_reader_without_this_package_plots_sum_rate_beside_the_path(flown: Path, converted: Path) -> None:
    """Only mcap, json, jsonschema and rosbags read the converted bag here."""
    sum_rate_bps: list[float] = []
    altitude_m: list[float] = []
    with (converted / "J_0.mcap").open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            if channel.message_encoding == "json":
                assert schema.encoding == "jsonschema"
                payload = json.loads(message.data)
                jsonschema.Draft202012Validator(json.loads(schema.data)).validate(payload)
                if channel.topic == "/rates":
                    sum_rate_bps.append(payload["sum_rate_bps"])
            else:
                pose: Any = TYPES.deserialize_cdr(message.data, schema.name)
                altitude_m.append(pose.pose.position.z)
    with BagReader(flown) as reader:
        rates = [
            contract.decode(cdr.decode_string(message.data), contract.Rates).sum_rate_bps
            for message in reader.messages(["/rates"])
        ]
    assert sum_rate_bps == rates
    assert max(rates) > 0
    assert len(altitude_m) == len(rates)


def test_our_reader_reads_them_as_the_strings_that_they_were(
    flown: Path, converted: Path, tmp_path: Path, capsys: Capture
) -> None:
    assert messages(converted) == messages(flown)
    with BagReader(converted) as reader, BagReader(flown) as original:
        for name, topic in reader.topics.items():
            assert topic.is_json == (name in JSON_TOPICS)
            assert (topic.type, topic.offered_qos) == (
                original.topics[name].type,
                original.topics[name].offered_qos,
            )
    kinds = {row["topic_metadata"]["name"]: row["topic_metadata"] for row in
             information(converted)["topics_with_message_count"]}  # fmt: skip
    assert (kinds["/rates"]["type"], kinds["/rates"]["serialization_format"]) == ("uav_dc_ros.Rates", "json")
    assert kinds["/pose"]["serialization_format"] == "cdr"
    lines = [run(capsys, "verify", bag).splitlines()[1:] for bag in (flown, converted)]
    assert lines[0] == lines[1]
    assert "/mission, /move, /rates, /users as JSON" in run(capsys, "info", converted)
    # A cut of it has JSON channels, too; a conversion without the option makes strings again.
    run(capsys, "cut", converted, "--out", tmp_path / "cut", "--missions", 1)
    with BagReader(tmp_path / "cut") as cut:
        assert cut.topics["/move"].is_json
    run(capsys, "convert", converted, "--out", tmp_path / "B")
    rows = [information(bag)["topics_with_message_count"] for bag in (flown, tmp_path / "B")]
    assert rows[0] == rows[1]
    assert messages(tmp_path / "B") == messages(flown)


def test_a_torn_one_is_recovered(converted: Path, flown: Path, tmp_path: Path) -> None:
    file = (converted / "J_0.mcap").read_bytes()
    (tmp_path / "torn.mcap").write_bytes(file[:-300])
    recover(tmp_path / "torn.mcap", tmp_path / "whole")
    assert messages(tmp_path / "whole") == messages(flown)
    with BagReader(tmp_path / "torn.mcap", torn=True) as reader:
        assert sorted(reader.messages(), key=lambda m: (m.log_time_ns, *m)) == messages(flown)


def test_a_text_that_is_no_payload_stays_and_is_counted(flown: Path, tmp_path: Path, capsys: Capture) -> None:
    whole = messages(flown)
    bad = [message for message in whole if message.topic == "/rates"][:2]
    changed = [message._replace(data=text("no JSON")) if message in bad else message for message in whole]
    bag = made.write(tmp_path / "bad", changed)
    out = run(capsys, "convert", bag, "--out", tmp_path / "json", "--json-channels")
    assert "2 messages of /rates cannot be read: malformed" in out
    assert messages(tmp_path / "json") == messages(bag)
    changed[0] = next(message for message in whole if message.topic == "/users")._replace(data=b"\0\1\0\0")
    bag = made.write(tmp_path / "worse", changed)
    error = run(capsys, "convert", bag, "--out", tmp_path / "no", "--json-channels", status=2)
    assert "a message of /users at" in error
    assert "is no std_msgs/msg/String" in error


@pytest.mark.parametrize("topic", PAYLOADS)
def test_the_schema_of_a_channel_accepts_what_the_contract_accepts(topic: str) -> None:
    path = files.shipped_folder("msgs_json") / f"{topic}.schema.json"
    schemas = json.loads(path.read_text("utf-8")), json.loads(json_channels.schema(PAYLOADS[topic]))
    ours, theirs = map(jsonschema.Draft202012Validator, schemas)
    jsonschema.Draft202012Validator.check_schema(schemas[1])
    good = json.loads(contract.encode(EXAMPLES[topic]))
    assert ours.is_valid(good)
    others: tuple[Any, ...] = (
        None,
        True,
        -1,
        0,
        0.5,
        2**70,
        "",
        "link",
        "up",
        [],
        [1, 2],
        [1, 2, 3],
        [1, 2, -3],
        {},
    )
    for key in (*good, "surplus"):
        less = {name: value for name, value in good.items() if name != key}
        for changed in (less, *(good | {key: other} for other in (*others, *Phase))):
            assert theirs.is_valid(changed) == ours.is_valid(changed), changed


@pytest.mark.parametrize("topic", PAYLOADS)
def test_foxglove_s_parser_takes_the_schema(topic: str) -> None:
    """Its rules, by its documentation and its last open source: a plain type for each field and item."""
    schema = json.loads(json_channels.schema(PAYLOADS[topic]))
    assert schema["type"] == "object"
    assert "sum_rate_bps" in schema["properties"] or topic != "rates"
    plain = {"boolean", "string", "number", "integer"}
    for name, field in schema["properties"].items():
        assert "oneOf" not in field, name
        assert field["type"] in plain or (field["type"] == "array" and field["items"]["type"] in plain), name
    assert set(schema["patternProperties"]) <= {"^fault$"}, "null or text: viewers show it without a type"
