"""The end of a mission is in its bag, even if it arrives late; what never arrives is reported."""

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from rclpy.duration import Duration
from rclpy.publisher import Publisher
from ruamel.yaml import YAML

from tests.conftest import PATIENCE_S, Ros, finish, until
from tests.nodes.conftest import Alone
from tests.support.fake_autopilot.mavros_flight import node_in
from uav_dc_ros import cdr, scenarios
from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.nodes.record.last_step import LastStep
from uav_dc_ros.nodes.ros import qos
from uav_dc_ros.topics import TOPICS

LAST = (3, 30)  # mission and step
ALL = ("users", "rates", "mission", "move", "pose", "target")
RECORDER = """
import sys
from uav_dc_ros.nodes.framework import node_main
from uav_dc_ros.nodes.recorder import RecorderNode
node_main.AWAIT_S = float(sys.argv.pop(1))
node_main.main(RecorderNode)
"""


def end_of(alone: Alone) -> dict[str, list[bytes]]:
    """The last two messages of each topic, serialised."""
    with BagReader(alone.bag) as reader:
        return {topic: [one.data for one in reader.messages([f"/{topic}"])][-2:] for topic in ALL}


def without(data: bytes, **changed: object) -> bytes:
    """A JSON payload with other values."""
    return cdr.encode_string(json.dumps(json.loads(cdr.decode_string(data)) | changed).encode())


def test_the_last_step_lacks_what_its_topics_have_not_reached(alone: Alone) -> None:
    scenario, end = scenarios.load(alone.scenario), end_of(alone)
    complete = {topic: two[-1] for topic, two in end.items()}

    def missing(
        missions: int = 4, lockstep: bool = True, **changed: bytes | None
    ) -> dict[str, tuple[int, int]]:
        newest = {topic: data for topic, data in (complete | changed).items() if data is not None}
        return LastStep(scenario, newest, missions=missions, lockstep=lockstep).missing()

    assert missing() == {}
    for topic in ALL:
        expected = (3, 29) if topic == "move" else LAST
        assert missing(**{topic: end[topic][0]}) == {topic: expected}
        assert missing(**{topic: None}) == {}, "not recorded, or nothing was published"
        assert missing(**{topic: b"\0\1\0\0garbage"}) == {}
    assert missing(missions=5, rates=end["rates"][0]) == {}, "stopped between two missions"
    assert missing(lockstep=False, move=end["move"][0]) == {}, "hovered"
    assert missing(users=without(end["users"][0], run="0" * 16)) == {}, "of another run"
    assert missing(users=without(complete["users"], mission=4, step=0)) == {"mission": (4, 0)}
    in_flight = without(complete["mission"], phase="ready")
    assert missing(mission=in_flight, pose=end["pose"][0]) == {}
    aborted = without(complete["mission"], phase="aborted", reason="a test", step=0, mission=0)
    assert missing(mission=aborted, **dict.fromkeys(("users", "rates", "pose", "target", "move"))) == {}

    # What was decoded is kept until a newer message replaces it.
    newest = complete | {"pose": end["pose"][0]}
    last_step = LastStep(scenario, newest, missions=4, lockstep=True)
    assert last_step.missing() == last_step.missing() == {"pose": LAST}
    newest["pose"] = complete["pose"]
    assert last_step.missing() == {}


class Recording:
    """A recorder that was stopped when the last pose of a mission was still missing."""

    def __init__(self, ros: Ros, alone: Alone, publishers: dict[str, Publisher], await_s: float) -> None:
        self.bag = ros.folder / "bag"
        given = [f"scenario:={alone.scenario}", f"bag:={self.bag}"]
        arguments = ["--ros-args", *(part for one in given for part in ("-p", one))]
        self._process: subprocess.Popen[str] = ros.start_command(
            sys.executable, "-c", RECORDER, await_s, *arguments
        )
        until(lambda: all(one.get_subscription_count() for one in publishers.values()))
        end = end_of(alone)
        self.last_pose = end["pose"].pop()
        for topic, publisher in publishers.items():
            for data in end[topic]:
                publisher.publish(data)
        for publisher in publishers.values():
            assert publisher.wait_for_all_acked(Duration(seconds=PATIENCE_S))
        self._process.terminate()

    def ended(self) -> str:
        """What the recorder printed until it ended."""
        status, output = finish(self._process)
        assert status == 0, output
        return output

    def poses(self) -> list[bytes]:
        """Those in the bag."""
        with BagReader(self.bag) as reader:
            return [one.data for one in reader.messages(["/pose"])]


@contextmanager
def publishing(ros: Ros) -> Iterator[dict[str, Publisher]]:
    """Publishers of the topics of a mission, in this process."""
    with node_in(ros) as (node, _):
        yield {
            topic: node.create_publisher(
                qos.MESSAGE_TYPES[TOPICS[topic].type], topic, qos.offered(TOPICS[topic])
            )
            for topic in ALL
        }


def test_a_recorder_waits_for_the_last_message_of_a_mission(ros: Ros, alone: Alone) -> None:
    with publishing(ros) as publishers:
        recording = Recording(ros, alone, publishers, await_s=PATIENCE_S)
        time.sleep(0.7)  # longer than a recorder waits for messages that it does not expect
        publishers["pose"].publish(recording.last_pose)
        output = recording.ended()
    assert "lacks" not in output
    assert recording.poses()[-1] == recording.last_pose
    assert "not_received" not in custom(recording.bag)


@pytest.mark.parametrize("publisher", ["leaves", "stays"])
def test_what_never_arrives_is_reported(ros: Ros, alone: Alone, publisher: str) -> None:
    """It is not waited for once its publisher has left, nor for long while the publisher stays."""
    with publishing(ros) as publishers:
        await_s = 10 * PATIENCE_S if publisher == "leaves" else 0.4
        recording = Recording(ros, alone, publishers, await_s)
        if publisher == "leaves":
            publishers["pose"].destroy()
        output = recording.ended()
    assert output.count("the bag lacks messages that did not arrive: /pose of step 30 of mission 3") == 1
    assert json.loads(custom(recording.bag)["not_received"]) == {"/pose": "of step 30 of mission 3"}
    assert recording.last_pose not in recording.poses()


def custom(bag: Path) -> dict[str, str]:
    """The custom data in metadata.yaml."""
    about: dict[str, str] = YAML(typ="safe").load(bag / "metadata.yaml")["rosbag2_bagfile_information"][
        "custom_data"
    ]
    return about
