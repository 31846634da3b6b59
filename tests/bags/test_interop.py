"""What we write is what others read, message for message: rosbags, mcap, and @mcap/core in Node.js."""

import base64
import json
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.bags.test_foreign import run
from tests.conftest import PATIENCE_S
from tests.recordings import made
from tests.support.bags import STRING, in_bag, in_mcap, information, text
from tests.support.worlds import tiny
from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.bags.salvage.recover import recover
from uav_dc_ros.bags.write import BagWriter

INTEROP = Path(__file__).with_name("interop")
INSTALL_S = 90


@pytest.fixture(scope="module")
def node_reader(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The script that reads with @mcap/core, its packages beside it."""
    npm = shutil.which("npm")
    if npm is None or shutil.which("node") is None:
        pytest.skip("needs Node.js: no node, or no npm, on this machine")
    folder = tmp_path_factory.mktemp("interop")
    shutil.copytree(INTEROP, folder, dirs_exist_ok=True)
    try:
        installed = subprocess.run(
            [npm, "install", "--no-audit", "--no-fund", "--ignore-scripts", "--fetch-retries=1"],
            cwd=folder, capture_output=True, text=True, check=False, timeout=INSTALL_S,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        pytest.skip(f"needs @mcap/core: npm install took longer than {INSTALL_S} s")
    if installed.returncode != 0:
        pytest.skip(f"needs @mcap/core: npm install failed: {installed.stderr.strip()[:200]}")
    return folder / "read.mjs"


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A bag of several chunks as it was written, and one that was recovered after a cut."""
    folder = tmp_path_factory.mktemp("bags")
    with BagWriter(folder / "written", {"seed": "3"}) as bag:
        bag.add_topic("/a", STRING)
        bag.add_topic("/ns/b", STRING)
        for i in range(1500):
            bag.write(
                ("/a", "/ns/b")[i % 2],
                text(f"{i} äöü" + (i % 500) * "x"),
                log_time_ns=2**60 + i,
                publish_time_ns=2**60 - i,
            )
    (folder / "cut.mcap").write_bytes((folder / "written" / "written_0.mcap").read_bytes()[:-3000])
    assert 500 < recover(folder / "cut.mcap", folder / "recovered").whole.message_count < 1500
    return {name: folder / name for name in ("written", "recovered")}


@pytest.mark.parametrize("name", ["written", "recovered"])
def test_node_reads_what_python_reads(node_reader: Path, bags: dict[str, Path], name: str) -> None:
    part = bags[name] / f"{name}_0.mcap"
    done = subprocess.run(
        ["node", node_reader, part], capture_output=True, text=True, check=True, timeout=PATIENCE_S
    )  # fmt: skip
    found = [
        (topic, sequence, int(log_time), int(publish_time), base64.b64decode(data))
        for topic, sequence, log_time, publish_time, data in map(json.loads, done.stdout.splitlines())
    ]
    assert found == in_mcap(part)


@pytest.mark.parametrize("name", ["written", "recovered"])
def test_rosbags_and_mcap_and_we_read_the_same(bags: dict[str, Path], name: str) -> None:
    by_mcap = in_mcap(bags[name] / f"{name}_0.mcap")
    with BagReader(bags[name]) as reader:
        ours = [(m.topic, m.log_time_ns, m.publish_time_ns, m.data) for m in reader.messages()]
    assert ours == [(topic, log, publish, data) for topic, _, log, publish, data in by_mcap]
    assert in_bag(bags[name]) == [(topic, log, data[8:-1].decode()) for topic, log, _, data in ours]
    info = information(bags[name])
    assert (info["version"], info["storage_identifier"], info["ros_distro"]) == (9, "mcap", "jazzy")
    assert info["message_count"] == len(ours)
    assert info["starting_time"]["nanoseconds_since_epoch"] == ours[0][1]
    assert info["duration"]["nanoseconds"] == ours[-1][1] - ours[0][1]


def test_node_validates_json_channels_against_their_schemas(
    node_reader: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    world = tiny()
    bag = made.write(tmp_path / "bag", made.flight(world), made.about(world))
    run(capsys, "convert", bag, "--out", tmp_path / "json", "--json-channels")
    done = subprocess.run(
        ["node", node_reader.with_name("read_json.mjs"), tmp_path / "json" / "json_0.mcap"],
        capture_output=True, text=True, check=False, timeout=PATIENCE_S,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    with BagReader(bag) as reader:
        counts = {name: topic.count for name, topic in reader.topics.items() if topic.type == STRING}
    assert json.loads(done.stdout) == counts
    assert set(counts) == {"/users", "/rates", "/mission", "/move"}
