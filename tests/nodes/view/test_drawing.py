"""The markers and the path, read back by ROS itself and by rosbags, which share no code with it."""

import math
import random
import time
from typing import Any

import msgspec
import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path as PathMessage
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.typesys import Stores, get_typestore
from visualization_msgs.msg import Marker, MarkerArray

from tests.nodes.poses import pose as pose_message
from tests.support.worlds import changed
from uav_dc_ros import cdr, scenarios
from uav_dc_ros.errors import MessageError
from uav_dc_ros.messages import Mission, Phase
from uav_dc_ros.nodes.view import markers
from uav_dc_ros.nodes.view.markers import Scene, UserState
from uav_dc_ros.nodes.view.path_history import POSES_MAX, PathHistory

SCENARIO = scenarios.load("five_clusters_hover")
U = SCENARIO.n_users
MISSION = Mission(
    mission=0,
    step=12,
    phase=Phase.READY,
    cell=(3, 4, 0),
    remaining_steps=48,
    seed=0,
    scenario=SCENARIO.name,
    fingerprint=SCENARIO.fingerprint,
)
STEP_NS = 15 * 10**9


def scene(**changed: Any) -> Scene:
    """Users 0 and 1 are served, 1 and 2 collected; the UAV is over (300, 400) at 150 m."""
    served, collected = np.zeros(U, dtype=bool), np.zeros(U, dtype=bool)
    served[[0, 1]] = True
    collected[[1, 2]] = True
    known: dict[str, Any] = {
        "time_ns": 180_000_000_007,
        "position_m": (300.0, 400.0, 150.0),
        "users_m": np.arange(2.0 * U).reshape(U, 2),
        "served": served,
        "collected": collected,
        "mission": MISSION,
        "sum_rate_bps": 1.234e6,
    }
    return Scene(**(known | changed))


def rewritten(data: bytes, type: str) -> bytes:
    """A message, read and written by rosbags; ROS itself leaves rubbish in the gaps."""
    store = get_typestore(Stores.ROS2_JAZZY)
    return bytes(store.serialize_cdr(store.deserialize_cdr(data, type), type))


def read(data: bytes) -> dict[str, list[Any]]:
    """The markers by namespace, as ROS reads them; rosbags must read the same."""
    message = deserialize_message(data, MarkerArray)
    assert rewritten(data, "visualization_msgs/msg/MarkerArray") == data
    found: dict[str, list[Any]] = {}
    for marker in message.markers:
        found.setdefault(marker.ns, []).append(marker)
    return found


def xyz(point: Any) -> tuple[float, float, float]:
    return point.x, point.y, point.z


def test_every_marker_is_in_the_map_at_the_time_of_the_pose() -> None:
    shapes = read(markers.markers(SCENARIO, scene()))
    assert set(shapes) == {"clusters", "dock", "users", "footprint", "uav", "status"}
    for marker in (marker for group in shapes.values() for marker in group):
        assert marker.header.frame_id == "map"
        assert (marker.header.stamp.sec, marker.header.stamp.nanosec) == (180, 7)
        assert marker.pose.orientation.w == 1.0
        assert marker.action == Marker.ADD
    keys = [(m.ns, m.id) for group in shapes.values() for m in group]
    assert len(set(keys)) == len(keys)


def test_users_are_coloured_by_state() -> None:
    users_m = np.arange(2.0 * U).reshape(U, 2)
    expected = {
        UserState.SERVED: users_m[[0]],
        UserState.COLLECTED: users_m[[1, 2]],  # one of them in the step that served it
        UserState.WAITING: users_m[3:],
    }
    shapes = {marker.id: marker for marker in read(markers.markers(SCENARIO, scene()))["users"]}
    assert set(shapes) == set(expected)
    for state, marker in shapes.items():
        assert marker.type == Marker.SPHERE_LIST
        at_m = [xyz(point) for point in marker.points]
        assert at_m == [(x_m, y_m, 0.0) for x_m, y_m in expected[state].tolist()]
        colour = (marker.color.r, marker.color.g, marker.color.b, marker.color.a)
        assert colour == pytest.approx(markers.USER_COLOURS[state], abs=1e-6)
    assert shapes[UserState.SERVED].scale.x > shapes[UserState.WAITING].scale.x


def test_the_users_colours_differ_in_lightness_too() -> None:
    """CIE lightness L*, 0 to 100; equal steps look equal."""

    def lightness(rgb: tuple[float, ...]) -> float:
        linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in rgb[:3]]
        return 116.0 * float(np.dot([0.2126, 0.7152, 0.0722], linear)) ** (1 / 3) - 16.0

    steps = np.diff(sorted(lightness(colour) for colour in markers.USER_COLOURS.values()))
    assert (steps > 15.0).all()


def test_the_discs_are_the_clusters() -> None:
    discs = read(markers.markers(SCENARIO, scene()))["clusters"]
    assert [(m.pose.position.x, m.pose.position.y) for m in discs] == list(SCENARIO.users.cluster_centres_m)
    for marker in discs:
        assert marker.type == Marker.CYLINDER
        assert marker.scale.x == marker.scale.y == 2 * SCENARIO.users.cluster_radius_m
        assert 0 < marker.color.a < 1


def test_the_footprint_is_where_users_can_be_served() -> None:
    (marker,) = read(markers.markers(SCENARIO, scene()))["footprint"]
    assert (marker.pose.position.x, marker.pose.position.y) == (300.0, 400.0)
    assert marker.scale.x == marker.scale.y == pytest.approx(2 * math.sqrt(250.0**2 - 150.0**2))
    for altitude_m in (250.0, 400.0):
        (marker,) = read(markers.markers(SCENARIO, scene(position_m=(300.0, 400.0, altitude_m))))["footprint"]
        assert marker.action == Marker.DELETE


def test_the_uav_the_dock_and_the_text() -> None:
    shapes = read(markers.markers(SCENARIO, scene()))
    body, line = shapes["uav"]
    assert xyz(body.pose.position) == (300.0, 400.0, 150.0)
    assert [xyz(point) for point in line.points] == [(300.0, 400.0, 150.0), (300.0, 400.0, 0.0)]
    (dock,) = shapes["dock"]
    assert xyz(dock.pose.position) == (*SCENARIO.mission.dock_m, 0.0)
    (text,) = shapes["status"]
    assert text.text == "step 12 of 60\n2 of 50 users collected\n1.23 Mbit/s"
    landed = scene(mission=msgspec.structs.replace(MISSION, step=60, phase=Phase.LANDED))
    (text,) = read(markers.markers(SCENARIO, landed))["status"]
    assert text.text.startswith("step 60 of 60: landed\n")


def test_obstacles_are_drawn_with_walls_and_a_top() -> None:
    tower = {"polygon_m": [[350.0, 350.0], [450.0, 350.0], [400.0, 450.0]], "height_m": 170.0}
    zone = {"kind": "no_fly", "polygon_m": [[600.0, 0.0], [700.0, 0.0], [700.0, 90.0], [600.0, 90.0]]}
    scenario = changed(
        "five_clusters_hover", radio={"obstruction_loss_db": 20.0}, obstacles=[tower, tower, zone]
    )
    shapes = read(markers.markers(scenario, scene()))
    for kind, n_triangles, top_m in (("building", 2 * (1 + 6), 170.0), ("no_fly", 2 + 8, 250.0)):
        (marker,) = shapes[kind]
        assert marker.type == Marker.TRIANGLE_LIST
        assert xyz(marker.scale) == (1.0, 1.0, 1.0)
        points_m = np.asarray([xyz(point) for point in marker.points])
        assert points_m.shape == (3 * n_triangles, 3)
        assert (points_m[:, 2].min(), points_m[:, 2].max()) == (0.0, top_m)


def test_what_is_not_known_is_not_drawn() -> None:
    no_users = np.zeros(0, dtype=bool)
    nothing = scene(
        position_m=None,
        users_m=np.empty((0, 2)),
        served=no_users,
        collected=no_users,
        mission=None,
        sum_rate_bps=None,
    )
    shapes = read(markers.markers(SCENARIO, nothing))
    for ns in ("users", "uav", "footprint", "status"):
        assert {marker.action for marker in shapes[ns]} == {Marker.DELETE}
    for ns in ("clusters", "dock"):
        assert {marker.action for marker in shapes[ns]} == {Marker.ADD}


def test_ten_thousand_users_are_drawn_within_milliseconds() -> None:
    users = msgspec.structs.replace(SCENARIO.users, users_per_cluster=2000)
    crowded = msgspec.structs.replace(SCENARIO, users=users)
    users_m = np.random.default_rng(0).random((10_000, 2)) * 1000.0
    no_users = np.zeros(10_000, dtype=bool)
    many = scene(users_m=users_m, served=no_users, collected=no_users)
    durations_s = []
    for _ in range(5):
        began_s = time.thread_time()
        data = markers.markers(crowded, many)
        durations_s.append(time.thread_time() - began_s)
    waiting = read(data)["users"][0]
    assert len(waiting.points) == 10_000
    assert xyz(waiting.points[-1]) == (*users_m[-1], 0.0)
    assert waiting.scale.x < 5.0  # smaller where they crowd
    assert min(durations_s) < 0.04  # of the processor; an object for each takes twice that and more


def test_a_path_holds_its_poses() -> None:
    given = [pose_message(np.array([1.5 * i, -2.0 * i, 100.0]), i * STEP_NS + i) for i in range(4)]
    for n in range(1, 5):
        poses = [cdr.Pose(serialize_message(pose)) for pose in given[:n]]
        message = deserialize_message(cdr.encode_path(poses), PathMessage)
        assert message.poses == given[:n]
        assert message.header == given[n - 1].header
        assert rewritten(cdr.encode_path(poses), "nav_msgs/msg/Path") == cdr.encode_path(poses)


def test_a_pose_is_read_in_either_byte_order() -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    little = serialize_message(pose_message(np.array([1.0, 2.0, 3.0]), 4_000_000_005))
    message = store.deserialize_cdr(little, "geometry_msgs/msg/PoseStamped")
    big = bytes(store.serialize_cdr(message, "geometry_msgs/msg/PoseStamped", little_endian=False))
    for data in (little, big):
        pose = cdr.Pose(data)
        assert (pose.stamp_ns, pose.position_m) == (4_000_000_005, (1.0, 2.0, 3.0))


@pytest.mark.parametrize("frame", ["odom", "", "map2"])
def test_a_pose_in_another_frame_is_refused(frame: str) -> None:
    message = PoseStamped()
    message.header.frame_id = frame
    with pytest.raises(MessageError, match="expected 'map'"):
        cdr.Pose(serialize_message(message))


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_pose_that_is_nowhere_is_refused(bad: float) -> None:
    with pytest.raises(MessageError, match="expected finite metres"):
        cdr.Pose(serialize_message(pose_message(np.array([0.0, bad, 0.0]), 0)))


class Flight:
    """Adds steps to a path, in the order in which the world publishes them."""

    def __init__(self, track: PathHistory) -> None:
        self.track, self.clock_ns = track, 0

    def published_ns(self) -> int:
        self.clock_ns += 1
        return self.clock_ns

    def step(
        self, mission: int, step: int, *, received: tuple[str, ...] = ("pose", "users", "target")
    ) -> Any:
        """One step; the executor may deliver its topics in another order."""
        time_ns = (mission * 61 + step) * STEP_NS
        pose = cdr.Pose(serialize_message(pose_message(np.array([mission, step, 100.0]), time_ns)))
        at_ns = {topic: self.published_ns() for topic in ("pose", "users", "target")}
        calls = {
            "pose": lambda: self.track.add_pose(pose, at_ns["pose"]),
            "target": lambda: self.track.add_target(pose),
            "users": lambda: self.track.add_users(
                mission=mission, step=step, stamp_ns=time_ns, published_ns=at_ns["users"]
            ),
        }
        return [calls[topic] for topic in ("pose", "target", "users") if topic in received]

    @property
    def steps(self) -> list[tuple[float, float]]:
        return [pose.position_m[:2] for pose in self.track.poses]


def test_a_new_mission_starts_a_new_path_whatever_the_order_of_topics() -> None:
    """All poses of a turn come before all users of it."""
    flight = Flight(PathHistory(SCENARIO))
    turns = [(0, step) for step in range(61)] + [(1, step) for step in range(5)]
    calls = [flight.step(*turn, received=("pose", "users")) for turn in turns]
    for pose, _ in calls:
        pose()
    for _, users in calls:
        users()
    assert flight.steps == [(1.0, float(step)) for step in range(5)]


@pytest.mark.parametrize("seed", range(10))
def test_no_path_has_poses_of_two_missions(seed: int) -> None:
    """Each topic keeps its order, but any of them may be ahead of the others, also where a path is drawn."""
    dice = random.Random(seed)
    flight = Flight(PathHistory(SCENARIO))
    turns = [(mission, step) for mission in range(4) for step in range(61)]
    waiting = [list(calls) for calls in zip(*(flight.step(*turn) for turn in turns), strict=True)]
    waiting[2].pop(0)()  # the first users
    while any(waiting):
        calls = dice.choice([calls for calls in waiting if calls])
        for _ in range(min(dice.randrange(40), len(calls))):
            calls.pop(0)()
        drawn = flight.steps
        # Targets stand for poses that were missed: the first ones may be late.
        mission, first = drawn[0] if drawn else (0.0, 0.0)
        assert drawn == [(mission, first + step) for step in range(len(drawn))]
    assert flight.steps == [(3.0, float(step)) for step in range(61)]


def test_what_is_flown_between_two_missions_belongs_to_none() -> None:
    """An aircraft publishes its pose all the time."""
    flight = Flight(PathHistory(SCENARIO))
    for call in flight.step(0, 60):
        call()
    between = cdr.Pose(serialize_message(pose_message(np.array([9.0, 9.0, 100.0]), 61 * STEP_NS - 1)))
    flight.track.add_pose(between, flight.published_ns())
    for call in flight.step(1, 0):
        call()
    assert flight.steps == [(1.0, 0.0)]


def test_a_step_that_is_repeated_is_one_pose() -> None:
    flight = Flight(PathHistory(SCENARIO))
    for step in (0, 1, 1, 1, 2):
        for call in flight.step(0, step):
            call()
    assert flight.steps == [(0.0, 0.0), (0.0, 1.0), (0.0, 2.0)]


def test_another_run_of_the_same_mission_starts_a_new_path() -> None:
    flight = Flight(PathHistory(SCENARIO))
    for run in range(2):
        for step in range(8 - run):
            for call in flight.step(0, step):
                call()
    assert flight.steps == [(0.0, float(step)) for step in range(7)]


@pytest.mark.parametrize("pose_first", [False, True])
def test_who_joins_late_knows_the_way_by_the_targets(pose_first: bool) -> None:
    """What is latched comes from where it is kept, and may arrive after newer messages."""
    flight = Flight(PathHistory(SCENARIO))
    missed = [(0, 59), (0, 60), (1, 0), (1, 1), (1, 2)]
    latched = [call for step in missed for call in flight.step(*step, received=("target",))]
    now = [call for step in [(1, 3), (1, 4)] for call in flight.step(*step)]
    for call in now + latched if pose_first else latched + now:
        call()
    assert flight.steps == [(1.0, float(step)) for step in range(5)]


def test_who_joins_after_the_end_sees_where_it_ended() -> None:
    flight = Flight(PathHistory(SCENARIO))
    for step in (0, 1, 2):
        for call in flight.step(0, step, received=("target", "users")):
            call()
    assert flight.steps == [(0.0, 0.0), (0.0, 1.0), (0.0, 2.0)]


def real_poses(seconds: float, mps: float, *, from_s: float = 0.0) -> Any:
    """Twenty poses a second, straight to the east."""
    for i in range(round(seconds * 20)):
        at_s = from_s + i / 20
        yield cdr.Pose(cdr.encode_pose(np.array([i / 20 * mps, 0.0, 100.0]), round(at_s * 1e9)))


def test_the_way_of_a_real_vehicle_is_thinned() -> None:
    """A pose each five metres, or two seconds; and the newest one is known to the last."""
    track = PathHistory(SCENARIO)
    poses = list(real_poses(60.0, 10.0))
    for i, pose in enumerate(poses):
        track.add_pose(pose, i)
    east_m = [pose.position_m[0] for pose in track.poses]
    assert np.diff(east_m) == pytest.approx(5.0, abs=0.51)
    assert (track.version, track.newest) == (len(east_m), poses[-1])
    version = track.version
    standing = [
        cdr.Pose(cdr.encode_pose(np.array([600.0, 0.0, 100.0]), round(t * 1e9))) for t in (60.0, 60.5, 61.0)
    ]
    for i, pose in enumerate(standing):
        track.add_pose(pose, 10_000 + i)
    assert (track.version, track.newest) == (version + 1, standing[-1]), "the path need not be drawn again"


def test_a_way_of_any_length_stays_small() -> None:
    """Ten hours of poses: from its beginning to its end, at most so many."""
    track = PathHistory(SCENARIO)
    most = 0
    for i in range(36_000 * 2):
        place_m = np.array([i * 5.0, 0.0, 100.0])
        track.add_pose(cdr.Pose(cdr.encode_pose(place_m, i * 5 * 10**8)), i)
        most = max(most, len(track._path.kept))
    assert 500 < len(track.poses) <= most <= POSES_MAX
    assert track.poses[0].stamp_ns == 0
    apart_ns = np.diff([pose.stamp_ns for pose in track.poses])
    assert apart_ns.max() <= 36_000 * 1e9 / len(track.poses) * 4, "no part of it is lost"


@pytest.mark.parametrize(
    ("phase", "reason", "expected"),
    [
        (Phase.READY, "", "step 12 of 60"),
        (Phase.READY, "step 12: there", "step 12 of 60"),
        (Phase.READY, "no heartbeat for 3 s", "step 12 of 60: ready (held)\nno heartbeat for 3 s"),
        (Phase.MOVING, "up to cell (3, 4, 1)", "step 12 of 60: moving\nup to cell (3, 4, 1)"),
        (Phase.ABORTED, "", "step 12 of 60: aborted"),
        (Phase.LANDING, "a " * 99, "step 12 of 60: landing" + 3 * ("\n" + " ".join("a" * 20))),
    ],
)
def test_the_text_tells_what_a_real_vehicle_does_and_why(phase: Phase, reason: str, expected: str) -> None:
    held = reason.startswith("no ")
    mission = msgspec.structs.replace(MISSION, phase=phase, reason=reason, held=held)
    text = markers.status_text(SCENARIO, scene(mission=mission))
    assert text == f"{expected}\n2 of 50 users collected\n1.23 Mbit/s"


def test_the_text_holds_the_charge_of_a_world_with_a_battery() -> None:
    mission = msgspec.structs.replace(MISSION, phase=Phase.READY, reason="", state_of_charge=0.634)
    lines = markers.status_text(SCENARIO, scene(mission=mission)).splitlines()
    assert lines[:2] == ["step 12 of 60", "battery by the model: 63%"]
