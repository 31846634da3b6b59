"""The visualizer beside real nodes: it draws what they publish."""

import re
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import WITHOUT_VISUALIZER, Ros, each_once, finish, read_bag, wait_for
from tests.nodes.conftest import Observed
from uav_dc_ros.nodes.view.markers import UserState

STEPS = 30  # of the small world
ADD = 0


class Bag:
    """The messages of each topic."""

    def __init__(self, folder: Path, namespace: str = "") -> None:
        self.namespace, self.messages = namespace, read_bag(folder)

    def __getitem__(self, topic: str) -> list[Any]:
        return [message for name, message in self.messages if name == f"{self.namespace}/{topic}"]


def way(path: Any) -> list[tuple[int, float, float, float]]:
    """Stamps, seconds, and positions of a path."""
    return [stop(pose) for pose in path.poses]


def stop(pose: Any) -> tuple[int, float, float, float]:
    at = pose.pose.position
    return pose.header.stamp.sec, at.x, at.y, at.z


def shown(markers: Any, ns: str) -> dict[int, Any]:
    return {marker.id: marker for marker in markers.markers if marker.ns == ns and marker.action == ADD}


def check_is_the_end(bag: Bag) -> None:
    """The last picture is the mission's last state."""
    markers, rates, users, mission = (bag[t][-1] for t in ("markers", "rates", "users", "mission"))
    assert rates["step"] == users["step"] == mission["step"] == STEPS
    collected = sum(rates["collected"])
    text = shown(markers, "status")[0].text.splitlines()
    assert text[:2] == [f"step 30 of 30: {mission['phase']}", f"{collected} of 4 users collected"]
    states = shown(markers, "users")
    assert len(states[UserState.COLLECTED].points if collected else []) == collected
    drawn = {(point.x, point.y) for marker in states.values() for point in marker.points}
    assert drawn == set(zip(users["x_m"], users["y_m"], strict=True))
    body = shown(markers, "uav")[0]
    assert (body.header.stamp.sec, *vars(body.pose.position).values())[:4] == stop(bag["pose"][-1])


def test_a_mission_is_drawn_as_it_was_flown(observed: Observed) -> None:
    bag = Bag(observed.bag, "/uav1")
    poses = [stop(pose) for pose in bag["pose"]]
    assert len(poses) == STEPS + 1
    drawn = [way(path) for path in bag["path"]]
    assert drawn[-1] == poses
    for path in drawn:
        assert path == poses[: len(path)]
    # Three seconds at five a second; not one for each step.
    assert 5 <= len(bag["markers"]) <= 22
    check_is_the_end(bag)


@pytest.mark.long
def test_in_lockstep_each_mission_has_its_own_path(
    ros: Ros, small_scenario: Path, small_policy: Path
) -> None:
    bag_folder = ros.folder / "bag"
    status, output = ros.run_all(
        *("--scenario", small_scenario, "--policy", small_policy, "--pace", "lockstep"),
        *("--missions", 20, "--bag", bag_folder),
    )
    assert status == 0, output
    bag = Bag(bag_folder)
    poses = each_once([stop(pose) for pose in bag["pose"]])
    missions = [poses[i : i + STEPS + 1] for i in range(0, len(poses), STEPS + 1)]
    assert len(missions) == 20
    for path in bag["path"]:
        drawn = way(path)
        assert any(drawn == mission[: len(drawn)] for mission in missions)
    assert way(bag["path"][-1]) == missions[-1]
    assert len(bag["path"]) < len(poses) / 10
    check_is_the_end(bag)


def by_hand(ros: Ros, scenario: object) -> Any:
    return ros.start(
        *("uav_dc_ros.nodes.visualizer", "--ros-args", "-p", f"scenario:={scenario}", "-r", "/clock:=clock")
    )


@pytest.mark.long
def test_who_joins_late_draws_the_whole_mission(ros: Ros, small_scenario: Path, small_policy: Path) -> None:
    bag_folder = ros.folder / "bag"
    options = ("--scenario", small_scenario, "--policy", small_policy, "--pace", 10, "--bag", bag_folder)
    flight = ros.start("uav_dc_ros.run_all", *options, *WITHOUT_VISUALIZER)
    assert flight.stdout is not None
    wait_for(flight.stdout, "step 10/30")
    late = by_hand(ros, small_scenario)
    status, output = finish(flight)
    assert status == 0, output
    late.terminate()
    status, output = finish(late)
    assert status == 0, output
    bag = Bag(bag_folder)
    poses = [stop(pose) for pose in bag["pose"]]
    assert bag["path"], "it was started too late"
    drawn = way(bag["path"][-1])
    assert len(drawn) > 20
    assert drawn == poses[: len(drawn)]
    # Users, rates and mission were latched; the very first picture may come before they do.
    soon = bag["markers"][min(3, len(bag["markers"]) - 1)]
    assert re.match(r"step \d+ of 30\n\d of 4 users collected\n", shown(soon, "status")[0].text)
    assert sum(len(marker.points) for marker in shown(soon, "users").values()) == 4


@pytest.mark.long
@pytest.mark.parametrize("scenario", ["five_clusters_hover"])
def test_another_world_s_mission_is_refused(
    ros: Ros, small_scenario: Path, small_policy: Path, scenario: str
) -> None:
    by_hand_node = by_hand(ros, scenario)
    status, output = ros.run_all(
        *("--scenario", small_scenario, "--policy", small_policy, "--pace", 100, "--no-record"),
        *("--nodes", "world,channel_monitor,policy"),
    )
    assert status == 0, output
    by_hand_node.terminate()
    status, output = finish(by_hand_node)
    assert status == 0, output
    assert "the mission flies 'small'" in output
    assert "Traceback" not in output
