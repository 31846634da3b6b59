"""`bag cut`, `merge`, `filter` and `convert`: messages, what is beside them, and what is refused."""

import random
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap.stream_reader import breakup_chunk
from mcap.writer import Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter
from rosbags.rosbag2.metadata import parse_qos

from tests.bags.test_foreign import run
from tests.support.bags import QOS, STRING, TYPES, content, in_bag, in_mcap, information, text
from uav_dc_ros.bags import mcap_storage
from uav_dc_ros.bags.read import BagMessage, BagReader
from uav_dc_ros.bags.write import BagWriter

Capture = pytest.CaptureFixture[str]
LATCHED = QOS.replace("volatile", "transient_local")
OTHER = LATCHED.replace("depth: 7", "depth: 3")
S = 10**9


def messages(path: Path) -> list[BagMessage]:
    """All messages, sorted."""
    with BagReader(path) as reader:
        return sorted(reader.messages(), key=lambda message: (message.log_time_ns, *message))


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bag of ten seconds in five parts, recorded topic by topic, as a recorder writes waiting messages.

    /map is latched and published four times, /two by two publishers of different QoS, /static once.
    """
    folder, noise = tmp_path_factory.mktemp("source") / "B", random.Random(1)
    with BagWriter(folder, {"seed": "3", "missions": "2"}, split_s=2.0) as bag:
        bag.add_topic("/pose", STRING, parse_qos(QOS))
        bag.add_topic("/map", STRING, parse_qos(LATCHED))
        bag.add_topic("/two", STRING, parse_qos(LATCHED + OTHER))
        bag.add_topic("/static", STRING, parse_qos(LATCHED))
        bag.add_topic("/silent", STRING, parse_qos(LATCHED))
        for second in range(100):
            at_ns = S + second * S // 10
            rows = [(topic, at_ns + noise.randrange(S // 10)) for topic in ("/pose",) * 3]
            rows += [("/map", at_ns)] * (second % 25 == 3) + [("/two", at_ns + 1)] * (second % 9 == 0)
            rows += [("/static", at_ns)] * (second == 1)
            for n, (topic, log_ns) in enumerate(sorted(rows)):
                data = text(f"{second} {n} {noise.randrange(3)}")
                bag.write(topic, data, log_time_ns=log_ns, publish_time_ns=log_ns - 5)
        bag.set_dropped({"/pose": 2})
    return folder


def cuts(capsys: Capture, source: Path, folder: Path, ends_s: Sequence[tuple[float, float]]) -> list[Path]:
    """Cuts of a bag from one time to another."""
    made = []
    for n, (start_s, end_s) in enumerate(ends_s):
        made.append(folder / f"cut{n}")
        run(capsys, "cut", source, "--out", made[-1], "--start", start_s, "--end", end_s)
    return made


def check_merge_of_cuts(capsys: Capture, source: Path, folder: Path, n: int, seed: int) -> None:
    """Cuts at random times, some of which overlap, have the source's messages when they are merged."""
    draw = random.Random(seed)
    times_ns = sorted({message.log_time_ns for message in messages(source)})  # none of the cuts is empty
    at_s = [0.0, *sorted((at_ns - times_ns[0]) / 1e9 for at_ns in draw.sample(times_ns[1:], n)), 11.0]
    ends_s = [(one, other + draw.choice((0.0, 0.0, 0.3))) for one, other in pairwise(at_s)]
    made = cuts(capsys, source, folder, ends_s)
    draw.shuffle(made)
    run(capsys, "merge", *made, "--out", folder / "merged")
    assert messages(folder / "merged") == messages(source)


def test_random_cuts_merged_again_are_the_original(source: Path, tmp_path: Path, capsys: Capture) -> None:
    check_merge_of_cuts(capsys, source, tmp_path, 6, 1)


@pytest.mark.long
def test_200_random_cuts_merged_again_are_the_original(source: Path, tmp_path: Path, capsys: Capture) -> None:
    check_merge_of_cuts(capsys, source, tmp_path, 199, 7)


def test_a_cut_begins_with_the_latched_messages_that_held(
    source: Path, tmp_path: Path, capsys: Capture
) -> None:
    out = run(capsys, "cut", source, "--out", tmp_path / "cut", "--start", 5, "--split-s", 2)
    assert "in 3 parts" in out
    start_ns = BagReader(source).first_ns + 5 * S
    whole = [one for one in messages(source) if one.log_time_ns >= start_ns]
    held = {topic: [m for m in messages(source) if m.topic == topic and m.log_time_ns < start_ns] for topic in
            ("/map", "/two", "/static")}  # fmt: skip
    expected = [(m.topic, m.publish_time_ns, m.data) for m in held["/map"][-1:] + held["/two"][-2:]]
    expected += [(m.topic, m.publish_time_ns, m.data) for m in held["/static"]]
    first, second, third = (tmp_path / "cut" / f"cut_{n}.mcap" for n in range(3))
    head = in_mcap(first)[:4]
    assert [(topic, publish, data) for topic, _, _, publish, data in head] == expected
    assert {(sequence, log) for _, sequence, log, *_ in head} == {(0, whole[0].log_time_ns)}
    assert all(sequence for _, sequence, *_ in in_mcap(first)[4:])
    for later in (second, third):  # each file can be read alone
        assert {row[0] for row in in_mcap(later) if row[1] == 0} == {"/map", "/two", "/static"}
    with BagReader(tmp_path / "cut", repeats=False) as reader:
        assert sorted(reader.messages(), key=lambda m: (m.log_time_ns, *m)) == whole
        assert [(m.topic, m.publish_time_ns, m.data) for m in reader.held()] == expected
        assert reader.about == {"seed": "3", "made_by": "bag cut, 5 s to the end, of B"}
        assert reader.dropped == {"/pose": 2}
    by_rosbags = in_bag(tmp_path / "cut")
    assert len(by_rosbags) == len(whole) + 3 * 4
    rows = {row["topic_metadata"]["name"]: row["topic_metadata"] for row in
            information(tmp_path / "cut")["topics_with_message_count"]}  # fmt: skip
    assert rows == {row["topic_metadata"]["name"]: row["topic_metadata"] for row in
                    information(source)["topics_with_message_count"]}  # fmt: skip


def test_a_cut_of_a_cut_holds_what_its_head_held(source: Path, tmp_path: Path, capsys: Capture) -> None:
    cuts(capsys, source, tmp_path, [(5.0, 11.0)])
    run(capsys, "cut", tmp_path / "cut0", "--out", tmp_path / "again", "--start", 1.0)
    run(capsys, "cut", source, "--out", tmp_path / "once", "--start", 6.0)
    with BagReader(tmp_path / "again", repeats=False) as again, BagReader(tmp_path / "once") as once:
        assert [m for m in again.held() if m.topic == "/static"]
        assert again.first_ns - once.first_ns < S  # a second after the cut's first message, not after 5 s
    run(capsys, "convert", tmp_path / "cut0", "--out", tmp_path / "same", "--compression", "none")
    assert messages(tmp_path / "same") == messages(tmp_path / "cut0")


def test_a_gap_between_merged_bags_keeps_the_state_after_it(
    source: Path, tmp_path: Path, capsys: Capture
) -> None:
    made = cuts(capsys, source, tmp_path, [(0.0, 2.0), (5.5, 11.0)])
    run(capsys, "merge", *made, "--out", tmp_path / "merged")
    one, other = map(messages, made)
    head = [row[0] for row in in_mcap(made[1] / "cut1_0.mcap") if row[1] == 0]
    assert head == ["/map", "/two", "/two", "/static"]
    # /static is the same before and after the gap.
    assert messages(tmp_path / "merged") == sorted(
        one + [m for m in other if m.topic != "/static"], key=lambda m: (m.log_time_ns, *m)
    )


def test_overlapping_recorders_are_sorted_and_nothing_is_lost(tmp_path: Path, capsys: Capture) -> None:
    for name, topics in (("one", "ab"), ("two", "bc")):
        with BagWriter(tmp_path / name, {"seed": "3", "policy": name}) as bag:
            for topic in topics:
                bag.add_topic(f"/{topic}", STRING, parse_qos(QOS if name == "one" else OTHER))
            for i in range(50):
                topic = topics[i % 2]
                # The same message twice in one bag is two messages; of /b each bag has the same.
                at_ns = 1000 + i - i % 4 + (topic == "b")
                bag.write(f"/{topic}", text(f"{topic}"), log_time_ns=at_ns, publish_time_ns=at_ns)
    out = run(capsys, "merge", tmp_path / "two", tmp_path / "one", "--out", tmp_path / "merged")
    assert "the bags differ in policy: the new bag does not name it" in out
    one, two = messages(tmp_path / "one"), messages(tmp_path / "two")
    times = sorted({m.log_time_ns for m in one + two})
    expected = []
    for at_ns in times:
        of = [[m for m in bag if m.log_time_ns == at_ns] for bag in (one, two)]
        for message in sorted({*of[0], *of[1]}):
            expected += [message] * max(of[0].count(message), of[1].count(message))
    assert len(expected) > max(len(one), len(two))
    assert messages(tmp_path / "merged") == expected
    with BagReader(tmp_path / "merged") as reader:
        assert [m.log_time_ns for m in reader.recorded()] == sorted(m.log_time_ns for m in expected)
        offered = [qos.depth for qos in parse_qos(reader.topics["/b"].offered_qos)]
        assert sorted(offered) == [3, 7]
        assert reader.about == {"seed": "3", "made_by": "bag merge of one, two"}


def test_filter_by_names_and_patterns(source: Path, tmp_path: Path, capsys: Capture) -> None:
    run(capsys, "filter", source, "--out", tmp_path / "kept", "--topics", "/map,/s*", "--exclude", "/silent")
    whole = messages(source)
    assert messages(tmp_path / "kept") == [m for m in whole if m.topic in ("/map", "/static")]
    with BagReader(tmp_path / "kept") as reader:
        assert set(reader.topics) == {"/map", "/static"}
        assert reader.dropped == {}
    error = run(capsys, "filter", source, "--out", tmp_path / "no", "--topics", "/pos", status=2)
    assert "--topics /pos: no such topic; expected some of /map, /pose, /silent, /static, /two" in error
    error = run(capsys, "filter", source, "--out", tmp_path / "no", "--topics", "/silent", status=2)
    assert "no message is left for bag" in error
    assert not (tmp_path / "no").exists()


def test_sqlite_becomes_mcap(tmp_path: Path, capsys: Capture) -> None:
    with RosbagsWriter(tmp_path / "old", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        offered = parse_qos(LATCHED)
        connection = writer.add_connection(
            "/a", STRING, typestore=TYPES, serialization_format="cdr", offered_qos_profiles=offered
        )
        for i in range(300):
            writer.write(connection, 1000 + i, text(f"message {i}"))
        writer.set_custom_data("flight", "7")
    run(capsys, "convert", tmp_path / "old", "--out", tmp_path / "new", "--split-bytes", 4096)
    assert in_bag(tmp_path / "new")[-1] == in_bag(tmp_path / "old")[-1]
    assert messages(tmp_path / "new") == messages(tmp_path / "old")
    info = information(tmp_path / "new")
    assert (info["storage_identifier"], info["custom_data"]["flight"]) == ("mcap", "7")
    old, new = (information(tmp_path / name)["topics_with_message_count"][0] for name in ("old", "new"))
    assert new["topic_metadata"] == old["topic_metadata"]
    with next((tmp_path / "new").glob("*_0.mcap")).open("rb") as file:
        (schema,) = make_reader(file).get_summary().schemas.values()  # type: ignore[union-attr]
    assert (schema.name, schema.encoding) == (STRING, "ros2msg")
    assert b"string data" in schema.data


def foreign(path: Path, types: Sequence[tuple[str, str, bytes]], *, attached: bool = False) -> Path:
    """An MCAP file of another recorder with a message on a topic of each type."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", "field")
        if attached:
            writer.add_metadata("calibration", {"f": "1.5"})
            writer.add_attachment(1, 2, "camera.yaml", "text/plain", b"f: 1.5")
        for n, (topic, type, definition) in enumerate(types):
            schema = writer.register_schema(type, "ros2msg" if definition else "", definition)
            channel = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channel, 1000 + n, b"\0\1\0\0" + bytes([n]), 900, 7)
        writer.finish()
    return path


def test_what_others_write_beside_messages_is_kept(tmp_path: Path, capsys: Capture) -> None:
    custom = b"# a comment\nfloat64 x"
    path = foreign(
        tmp_path / "one.mcap",
        [("/x", "own_msgs/msg/X", custom), ("/y", "own_msgs/msg/Y", b"")],
        attached=True,
    )
    other = foreign(
        tmp_path / "two.mcap",
        [("/x", "own_msgs/msg/X", b"float64 x"), ("/y", "own_msgs/msg/Y", b"")],
        attached=True,
    )
    run(capsys, "merge", path, other, "--out", tmp_path / "merged")
    with (tmp_path / "merged" / "merged_0.mcap").open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert summary is not None
        assert {schema.name: (schema.encoding, schema.data) for schema in summary.schemas.values()} == {
            "own_msgs/msg/X": ("ros2msg", custom),
            "own_msgs/msg/Y": ("", b""),
        }
        assert [one.metadata for one in reader.iter_metadata() if one.name == "calibration"] == [{"f": "1.5"}]
        assert [(one.name, one.create_time, one.data) for one in reader.iter_attachments()] == [
            ("camera.yaml", 1, b"f: 1.5")
        ]
    error = run(
        capsys, "merge", path, foreign(tmp_path / "3.mcap", [("/x", "own_msgs/msg/X", b"float32 x")]),
        "--out", tmp_path / "no", status=2,
    )  # fmt: skip
    assert "topic /x has two definitions of own_msgs/msg/X" in error
    error = run(
        capsys, "merge", path, foreign(tmp_path / "4.mcap", [("/x", STRING, b"string data")]),
        "--out", tmp_path / "no", status=2,
    )  # fmt: skip
    assert "topic /x has the types own_msgs/msg/X, std_msgs/msg/String; expected one" in error
    assert not list(tmp_path.glob("*no*"))


def test_memory_holds_a_chunk_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The reader of mcap decompresses all chunks before it yields the first message in the file's order."""
    with BagWriter(tmp_path / "bag", {}, compression="none") as bag:
        bag.add_topic("/a", STRING)
        bag.add_topic("/b", STRING)
        for i in range(40):
            data = text(40_000 * "x")
            bag.write("/ab"[0] + "ab"[i >= 20], data, log_time_ns=1000 - i, publish_time_ns=i)
    read: list[int] = []

    def breakup(*arguments: Any, **options: Any) -> Any:
        read.append(1)
        return breakup_chunk(*arguments, **options)

    monkeypatch.setattr(mcap_storage, "breakup_chunk", breakup)
    with BagReader(tmp_path / "bag") as reader:
        recorded = reader.recorded()
        assert (next(recorded).log_time_ns, len(read)) == (1000, 1)
        assert [message.log_time_ns for message in recorded] == list(range(999, 960, -1))
        n_chunks = len(read)
        assert n_chunks >= 10
        read.clear()
        assert len(list(reader.recorded(["/b"], start_ns=970, end_ns=975))) == 5
        assert len(read) < n_chunks / 3, "by the index"


def test_the_same_command_writes_the_same_bytes(source: Path, tmp_path: Path, capsys: Capture) -> None:
    for name in ("1", "2"):
        run(
            capsys,
            "convert",
            source,
            "--out",
            tmp_path / name / "new",
            "--split-s",
            3,
            "--compression",
            "lz4",
        )
    assert content(tmp_path / "1" / "new") == content(tmp_path / "2" / "new")


@pytest.mark.parametrize(
    ("verb", "options", "expected"),
    [
        ("cut", [], "neither a time nor missions; expected --start, --end or both"),
        ("cut", ["--start", "1", "--steps", "1"], "both a time and missions"),
        ("cut", ["--start", "30"], "--start 30: no message; expected a time within the bag's 9."),
        ("cut", ["--start", "3", "--end", "3"], "--start 3 --end 3: no message"),
        ("cut", ["--missions", "5-3"], "'5-3'; expected a whole number, or two such as 3-5"),
        ("cut", ["--missions", "1-2", "--steps", "1"], "--steps of several missions"),
        ("cut", ["--missions", "0"], "holds no mission: no topic `mission`"),
        ("filter", [], "neither --topics nor --exclude"),
        ("filter", ["--exclude", "/*"], "--exclude /*: no topic is left"),
        ("merge", [], "a single bag; expected at least two"),
        ("convert", ["--compression", "zip"], "--compression: invalid choice: 'zip'"),
    ],
)
def test_options_that_make_no_bag(
    source: Path, tmp_path: Path, capsys: Capture, verb: str, options: list[str], expected: str
) -> None:
    assert expected in run(capsys, verb, source, "--out", tmp_path / "new", *options, status=2)
    assert not list(tmp_path.iterdir())


def test_nothing_is_overwritten_or_left_behind(
    source: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "new").mkdir()
    error = run(capsys, "convert", source, "--out", tmp_path / "new", status=2)
    assert "new exists already; expected a new one" in error

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("uav_dc_ros.bags.part_writer.PartWriter.add_message", full)
    error = run(capsys, "convert", source, "--out", tmp_path / "other", status=2)
    assert "bag other cannot be written: No space left on device; nothing is left of it" in error
    assert [path.name for path in tmp_path.iterdir()] == ["new"]

    def stopped(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("uav_dc_ros.bags.part_writer.PartWriter.add_message", stopped)
    assert "stopped" in run(capsys, "convert", source, "--out", tmp_path / "other", status=130)
    assert [path.name for path in tmp_path.iterdir()] == ["new"]
