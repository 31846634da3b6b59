"""Info: what a bag holds and lacks, for whole and torn bags, ours and others."""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.writer import Writer
from rosbags.rosbag2.metadata import parse_qos

from tests.recordings import made
from tests.support.bags import QOS, STRING, TYPES, content, information, text
from uav_dc_ros import bag as command
from uav_dc_ros import cdr, messages, scenarios, topics
from uav_dc_ros.bags.salvage.recover import recover
from uav_dc_ros.bags.write import BagWriter

N_USERS = 4
STEP_NS = 15 * 10**9


def write_step(
    bag: BagWriter, mission: int, step: int, *, last: int, log_ns: int, without: tuple[str, ...] = ()
) -> None:
    """All messages of a step; the users are collected one after the other."""
    stamp_ns = (mission * (last + 1) + step) * STEP_NS
    payloads: dict[str, messages.Payload] = {
        "users": messages.Users(
            mission=mission, step=step, stamp_ns=stamp_ns, cluster=[0] * N_USERS,
            x_m=[1.0] * N_USERS, y_m=[2.0] * N_USERS,
        ),
        "rates": messages.Rates(
            mission=mission, step=step, sum_rate_bps=0.0, sinr=[0.0] * N_USERS, rate_bps=[0.0] * N_USERS,
            data_bits=[0.0] * N_USERS, served=[False] * N_USERS,
            collected=[user < step for user in range(N_USERS)],
        ),
        "mission": messages.Mission(
            mission=mission, step=step,
            phase=messages.Phase.LANDED if step == last else messages.Phase.READY,
            cell=(0, 0, 0), remaining_steps=9, seed=7 + mission, scenario="five_clusters_hover",
            fingerprint=scenarios.load("five_clusters_hover").fingerprint,
        ),
    }  # fmt: skip
    if step < last:
        payloads["move"] = messages.Move(mission=mission, step=step, action="left")
    t = TYPES.types
    pose = t["geometry_msgs/msg/PoseStamped"](
        t["std_msgs/msg/Header"](t["builtin_interfaces/msg/Time"](stamp_ns // 10**9, 0), "map"),
        t["geometry_msgs/msg/Pose"](
            t["geometry_msgs/msg/Point"](0.0, 0.0, 100.0),
            t["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
        ),
    )
    serialised = {name: cdr.encode_string(messages.encode(payload)) for name, payload in payloads.items()}
    serialised["pose"] = bytes(TYPES.serialize_cdr(pose, topics.POSE))
    for i, (name, data) in enumerate(serialised.items()):
        if name not in without:
            bag.write(f"/{name}", data, log_time_ns=log_ns + i, publish_time_ns=log_ns + i)


def diagnostics(name: str, values: dict[str, str]) -> bytes:
    """A node's diagnostics, serialised."""
    t = TYPES.types
    header = t["std_msgs/msg/Header"](t["builtin_interfaces/msg/Time"](0, 0), "")
    pairs = [t["diagnostic_msgs/msg/KeyValue"](key, value) for key, value in values.items()]
    status = t["diagnostic_msgs/msg/DiagnosticStatus"](0, name, "active", "uav_dc_ros", pairs)
    message = t["diagnostic_msgs/msg/DiagnosticArray"](header, [status])
    return bytes(TYPES.serialize_cdr(message, topics.DIAGNOSTICS))


def flown(
    folder: Path,
    about: dict[str, str] | None = None,
    *,
    without: tuple[str, ...] = (),
    dropped: dict[str, int] | None = None,
    close: bool = True,
) -> Path:
    """Two missions of three steps, 0.1 s each, 2 s between them; `without` some in mission 1, step 1."""
    metadata = {
        "version": "0.2.0",
        "scenario": "five_clusters_hover",
        "policy": "p",
        "policy_sha256": "ab12",
        "seed": "7",
        "missions": "2",
    }
    bag = BagWriter(folder, metadata | (about or {}))
    for name in ("pose", "users", "rates", "mission", "move", "diagnostics"):
        bag.add_topic(f"/{name}", topics.TOPICS[name].type)
    for mission in range(2):
        for step in range(4):
            log_ns = 10**18 + mission * 2_300_000_000 + step * 100_000_000
            gone = without if (mission, step) == (1, 1) else ()
            write_step(bag, mission, step, last=3, log_ns=log_ns, without=gone)
    bag.write(
        "/diagnostics", diagnostics("mission_monitor", {"restarts of policy": "2", "restarts of world": "0"}),
        log_time_ns=10**18 + 5, publish_time_ns=0,
    )  # fmt: skip
    if dropped is not None:
        bag.set_dropped(dropped)
    if close:
        bag.close()
    return folder


def info(path: Path, capsys: pytest.CaptureFixture[str], *options: str) -> str:
    """What the verb prints."""
    with pytest.raises(SystemExit) as stopped:
        command.main(["info", str(path), *options])
    captured = capsys.readouterr()
    assert (stopped.value.code, captured.err) == (0, "")
    return captured.out


def test_a_whole_bag(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = flown(tmp_path / "bag")
    before = content(bag)
    survey = json.loads(info(bag, capsys, "--json"))
    assert (survey["complete"], survey["problems"], survey["recoverable"]) == (True, [], False)
    assert (survey["messages"], survey["ros_distro"], survey["about"]["policy_sha256"]) == (
        39,
        "jazzy",
        "ab12",
    )
    assert survey["duration_s"] == pytest.approx(2.6, abs=1e-6)
    assert survey["restarts"] == {"policy": 2}
    assert survey["parts"][0]["library"].startswith("uav_dc_ros ")
    missions = [
        (m["mission"], m["outcome"], m["steps"], m["collected"], m["users"]) for m in survey["missions"]
    ]
    assert missions == [(0, "landed", 3, 3, 4), (1, "landed", 3, 3, 4)]
    assert [(m["seed"], m["missing"]) for m in survey["missions"]] == [(7, {}), (8, {})]
    [users] = [topic for topic in survey["topics"] if topic["name"] == "/users"]
    assert users["mean_hz"] == pytest.approx(7 / 2.6)
    assert (users["gap_s"], users["gap_at_s"]) == pytest.approx((2.0, 0.3))
    text = info(bag, capsys)
    for expected in (
        "bag complete",
        "five_clusters_hover (",
        "p (ab12)",
        "2: 2 landed; 75.0% of the users",
        "policy 2",
        "uav_dc_ros 0.2.0, ROS 2 jazzy",
        "2.000 s at 0.3 s",
        "3 of 4",
    ):
        assert expected in text
    assert max(map(len, text.splitlines()[1:])) <= 80
    assert content(bag) == before
    info(bag, capsys, "--json", str(tmp_path / "info.json"))
    assert json.loads((tmp_path / "info.json").read_text()) == survey
    (tmp_path / "link.json").symlink_to("info.json")
    (tmp_path / "info.json").unlink()
    info(bag, capsys, "--json", str(tmp_path / "link.json"))
    assert (tmp_path / "link.json").is_symlink()
    assert json.loads((tmp_path / "info.json").read_text()) == survey


def test_what_a_bag_lacks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = flown(
        tmp_path / "bag", {"missions": "3"}, without=("rates", "pose"), dropped={"/pose": 5, "/users": 0}
    )
    (bag / "metadata.yaml").unlink()
    survey = json.loads(info(bag, capsys, "--json"))
    assert not survey["complete"]
    assert survey["problems"] == [
        "metadata.yaml is missing",
        "5 messages of /pose were dropped",
        "steps lack messages: 1 pose, 1 rates",
        "2 of 3 missions have an end",
    ]
    assert {topic["name"]: topic["dropped"] for topic in survey["topics"]}["/pose"] == 5
    assert "dropped" in info(bag, capsys)


def test_metadata_that_differs_from_the_bag(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = flown(tmp_path / "bag")
    shutil.copy(bag / "bag_0.mcap", bag / "bag_1.mcap")
    assert "metadata.yaml lists other files, or other numbers of messages, than the bag has" in info(
        bag, capsys
    )
    (bag / "metadata.yaml").write_text("[}")
    assert "metadata.yaml describes no bag" in info(bag, capsys)


def test_a_torn_bag_and_a_damaged_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Info shows the readable part, and how to recover."""
    file = content(flown(tmp_path / "bag"))["bag_0.mcap"]
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(file[:-700])
    text = info(torn, capsys)
    assert re.search(r"torn.mcap not complete\n  - torn.mcap has no end: its recorder was killed", text)
    assert f"python -m uav_dc_ros.bag recover {torn} --out DIR" in text
    assert "2: 2 landed" in text
    damaged = bytearray(file)
    damaged[file.index(b"\4\0\0\0zstd") + 100] ^= 1  # in the only chunk
    torn.write_bytes(damaged)
    survey = json.loads(info(torn, capsys, "--json"))
    assert (survey["complete"], survey["recoverable"], survey["messages"]) == (False, True, 0)
    assert "a chunk whose content is damaged" in survey["problems"][0]
    assert survey["about"]["seed"] == "7"


def test_a_bag_of_another_recorder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "foreign.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("", "other [bold]")
        schema = writer.register_schema("Thing", "jsonschema", b"{}")
        channel = writer.register_channel("/a/topic/of/a/very/long/name/" + 80 * "x", "json", schema)
        for i in range(3):
            writer.add_message(channel, 10, b"{}", 5, i)  # all at once
        writer.finish()
    text = info(path, capsys)
    assert "foreign.mcap complete" in text
    assert "written by other [bold]" in text
    assert max(map(len, text.splitlines()[1:])) <= 80


@pytest.mark.parametrize(
    ("type", "definition", "expected"),
    [
        ("std_msgs/msg/Int32", b"", "topic /users is of type std_msgs/msg/Int32"),
        (STRING, b"float64 data", "its definition of std_msgs/msg/String differs from"),
    ],
)
def test_a_topic_of_another_type(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], type: str, definition: bytes, expected: str
) -> None:
    path = tmp_path / "odd.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", "test")
        ours, other = writer.register_schema(STRING, "ros2msg", b"string data"), 0
        other = writer.register_schema(type, "ros2msg", definition)
        for topic, schema in (("/mission", ours), ("/users", other)):
            writer.add_message(writer.register_channel(topic, "cdr", schema), 1, text("x"), 1)
        writer.finish()
    assert expected in info(path, capsys).replace("\n", " ")


def test_what_is_no_bag_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty.mcap").write_bytes(b"")
    (tmp_path / "text.mcap").write_text("hello, world")
    for name, expected in (
        ("none", "no such folder"),
        ("empty.mcap", "is empty"),
        ("text.mcap", "starts with"),
    ):
        with pytest.raises(SystemExit) as stopped:
            command.main(["info", str(tmp_path / name)])
        error = capsys.readouterr().err
        assert stopped.value.code == 2
        assert expected in error
        assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("spoil", "why"),
    [
        (lambda data: b"\0\7" + data[2:], "encapsulation: XCDR2 (0x0007); expected CDR (0x0000 or 0x0001)"),
        (lambda data: data[:-9], "malformed: "),
        (
            lambda data: b"\x28\xb5\x2f\xfd" + data,
            "encapsulation: a zstd frame that is damaged; expected CDR",
        ),
    ],
)
def test_payloads_that_cannot_be_decoded_are_reported_by_every_verb(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], spoil: Callable[[bytes], bytes], why: str
) -> None:
    bag = made.copy(
        flown(tmp_path / "bag"),
        tmp_path / "spoilt",
        lambda message: message._replace(data=spoil(message.data)),
    )
    survey = json.loads(info(bag, capsys, "--json"))
    problems = [problem for problem in survey["problems"] if "cannot be read" in problem]
    assert [problem.split(" cannot")[0] for problem in problems] == [
        f"{n} messages of {topic}"
        for topic, n in (("mission", 8), ("move", 6), ("pose", 8), ("rates", 8), ("users", 8))
    ]
    assert all(why in problem for problem in problems)
    for verb, *options in (
        ("verify",),
        ("report", "--out", str(tmp_path / "page.html")),
        ("report", "--compare", "--out", str(tmp_path / "page.html")),
        ("export", "--format", "csv", "--out", str(tmp_path / "tables")),
        ("export", "--transitions", "--out", str(tmp_path / "transitions.npz")),
    ):
        with pytest.raises(SystemExit) as stopped:
            command.main([verb, str(bag), *options, "--scenario", "five_clusters_hover"])
        error = capsys.readouterr().err
        assert stopped.value.code == 2
        assert f"8 messages of users cannot be read: {why}" in error
        assert error.count("\n") == 1


def test_a_bag_of_several_parts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The latched messages that begin each part are of the part, and not of the bag; recovered, too."""
    offers = parse_qos(QOS.replace("volatile", "transient_local"))
    with BagWriter(tmp_path / "bag", {}, split_s=1.0) as bag:
        bag.add_topic("/map", STRING, offers)
        bag.add_topic("/a", STRING)
        for i in range(5):
            log_ns = 10**18 + i * 10**9
            if i != 3:
                bag.write("/map", text(f"{i}"), log_time_ns=log_ns, publish_time_ns=log_ns)
            bag.write("/a", text(f"{i}"), log_time_ns=log_ns + 1, publish_time_ns=log_ns + 1)
    recover(tmp_path / "bag", tmp_path / "again")
    for folder in (tmp_path / "bag", tmp_path / "again"):
        survey = json.loads(info(folder, capsys, "--json"))
        assert survey["problems"] == []
        assert survey["messages"] == 9
        parts = [(part["messages"], part["repeated"]) for part in survey["parts"]]
        assert len(parts) == 5
        assert parts == [
            (counts["message_count"], int(part > 0))
            for part, counts in enumerate(information(folder)["files"])
        ]
