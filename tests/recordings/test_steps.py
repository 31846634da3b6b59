"""The steps of recorded missions, whatever order, repetition and loss their messages were recorded in."""

import random

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.recordings.made import APART_NS, BEGUN_NS, bag_message, flight, pose, write
from tests.support.bags import text
from tests.support.worlds import tiny
from uav_dc_ros import messages
from uav_dc_ros.bags.read import BagMessage, BagReader, RecordedTopic
from uav_dc_ros.errors import BagError
from uav_dc_ros.messages import Phase
from uav_dc_ros.recordings import step_reader
from uav_dc_ros.recordings.step_reader import OPEN_MAX, Steps

SCENARIO = tiny()
STEP_NS = round(SCENARIO.mission.step_s * 1e9)
LAST = SCENARIO.mission.max_steps
FLIGHT = flight(SCENARIO, missions=3)
PER_STEP = 5
LATER_NS = BEGUN_NS + 3600 * 10**9


class InMemory:
    """A reader of messages that lie in no file."""

    def __init__(self, recorded: list[BagMessage]) -> None:
        self.path, self.about = "memory", {}
        self._told = sorted(recorded, key=lambda message: message.log_time_ns)
        self.topics: dict[str, RecordedTopic] = {}
        for message in recorded:
            row = RecordedTopic(name=message.topic, type=message.type)
            self.topics.setdefault(message.topic, row).count += 1

    def messages(self, names):
        return (message for message in self._told if message.topic in names)

    def received(self, names):
        return ((0, message) for message in self.messages(names))


def read(recorded, namespace="", step_ns=STEP_NS):
    stream = Steps(InMemory(recorded), namespace, step_ns)
    return list(stream), stream


def plain(step):
    """A step without its times."""
    position = None if step.position_m is None else tuple(step.position_m)
    return (step.flight, step.mission, step.step), position, step.users, step.rates, step.status, step.move


WHOLE = [plain(step) for step in read(FLIGHT)[0]]


def test_a_flight_in_order():
    found, stream = read(FLIGHT)
    assert [(s.mission, s.step) for s in found] == [(m, s) for m in range(3) for s in range(LAST + 1)]
    for step in found:
        over = step.step == LAST
        assert (step.move is None) == over
        assert step.status.phase.is_over == over
        assert step.users.step == step.rates.step == step.status.step == step.step
        assert step.position_m.tolist() == [100.0 * step.status.cell[0], 100.0 * step.status.cell[1], 100.0]
        assert set(step.log_ns) == set(step_reader.STEP_TOPICS) - ({"move"} if over else set())
        assert step.log_ns == step.publish_ns
        assert not step.conflicts
    assert not stream.orphans + stream.repeated + stream.rejected


def shuffled(recorded, rng, reach, topics_in_order=False):
    """As received: each message up to `reach` messages late; optionally in order within each topic."""
    latest = {}
    late = []
    for message in recorded:
        log_ns = message.log_time_ns + APART_NS * rng.randint(0, reach)
        if topics_in_order:
            log_ns = max(log_ns, latest.get(message.topic, 0))
        latest[message.topic] = log_ns
        late.append(message._replace(log_time_ns=log_ns))
    return sorted(late, key=lambda message: message.log_time_ns)


@given(st.integers(0, 2**32), st.integers(0, 3 * PER_STEP))
@settings(max_examples=30, deadline=None)
def test_any_order_within_a_few_steps_gives_the_same_steps(seed, reach):
    found, stream = read(shuffled(FLIGHT, random.Random(seed), reach))
    assert [plain(step) for step in found] == WHOLE
    assert not stream.orphans


@given(st.data())
@settings(max_examples=30, deadline=None)
def test_repetitions_change_nothing_and_are_counted(data):
    """A lockstep that stands still publishes its step again; a middleware repeats old messages."""
    rng = random.Random(data.draw(st.integers(0, 2**32)))
    recorded = list(FLIGHT)
    n = 0
    for _ in range(data.draw(st.integers(1, 5))):
        i = rng.randrange(len(FLIGHT))
        one = FLIGHT[i]
        if one.topic == "/pose":
            continue
        if rng.random() < 0.5:  # bag_message again at once, and published anew
            again_ns = one.log_time_ns + rng.randrange(1, APART_NS)
            recorded.append(one._replace(log_time_ns=again_ns, publish_time_ns=again_ns))
        else:  # repeated at any time later
            recorded.append(
                one._replace(log_time_ns=one.log_time_ns + rng.randrange(1, APART_NS * len(FLIGHT)))
            )
        n += 1
    found, stream = read(recorded)
    assert [plain(step) for step in found] == WHOLE
    assert (stream.repeated.total(), stream.orphans.total()) == (n, 0)


def test_a_latched_history_that_comes_again_whole_is_no_new_flight():
    history = [
        message._replace(log_time_ns=FLIGHT[-1].log_time_ns + i)
        for i, message in enumerate(m for m in FLIGHT if m.topic in ("/users", "/mission", "/rates"))
    ]
    found, stream = read(FLIGHT + history)
    assert [plain(step) for step in found] == WHOLE
    assert stream.repeated.total() == len(history)
    assert not stream.orphans


@given(st.sets(st.integers(0, len(FLIGHT) - 1), min_size=1, max_size=40))
@settings(max_examples=30, deadline=None)
def test_what_is_missing_is_none_and_nothing_else_changes(lost):
    """Whatever is lost, every step has what is left of it, and only that."""
    kept = [message for i, message in enumerate(FLIGHT) if i not in lost]
    found = {(step.mission, step.step): step for step in read(kept)[0]}
    begins = [i for i, message in enumerate(FLIGHT) if message.topic == "/pose"]
    for first, (key, position, *recorded) in zip(begins, WHOLE, strict=True):
        names = ("users", "rates", "status", "move")
        at = dict(zip(("pose", "users", "status", "rates", "move"), range(first, first + 5), strict=True))
        step = found.get(key[1:])
        expected = {
            name: None if at[name] in lost else value for name, value in zip(names, recorded, strict=True)
        }
        if step is None:
            assert not any(expected.values())
            continue
        assert {name: getattr(step, name) for name in names} == expected
        has_pose = at["pose"] not in lost and at["users"] not in lost
        assert (None if step.position_m is None else tuple(step.position_m)) == (
            position if has_pose else None
        )


@pytest.mark.parametrize("topic", ["users", "rates", "mission", "move", "pose"])
def test_a_message_that_was_lost_and_sent_again_much_later_finds_its_step(topic):
    scenario = tiny(mission={"max_steps": 300})
    recorded = flight(scenario)
    i = next(i for i, m in enumerate(recorded) if m.topic == f"/{topic}" and i > 50)
    recorded[i] = recorded[i]._replace(log_time_ns=recorded[i].log_time_ns + 200 * PER_STEP * APART_NS)
    found, stream = read(recorded)
    assert [plain(step) for step in found] == [plain(step) for step in read(flight(scenario))[0]]
    assert not stream.orphans


def test_one_that_comes_too_late_is_an_orphan_and_few_steps_are_held():
    recorded = flight(tiny(mission={"max_steps": 3 * OPEN_MAX}))
    i = next(i for i, m in enumerate(recorded) if m.topic == "/rates" and i > 50)
    recorded[i] = recorded[i]._replace(
        log_time_ns=recorded[i].log_time_ns + (OPEN_MAX + 10) * PER_STEP * APART_NS
    )
    stream = Steps(InMemory(recorded), "", STEP_NS)
    most = 0
    for _ in stream:
        most = max(most, len(stream._open))
    assert stream.orphans == {"rates": 1}
    assert most <= OPEN_MAX


def test_steps_in_memory_are_few_where_nothing_is_missing():
    stream = Steps(InMemory(flight(tiny(mission={"max_steps": 500}))), "", STEP_NS)
    assert max(len(stream._open) + len(stream._poses) for _ in stream) < 12


@pytest.mark.parametrize(
    ("steps_of_first", "same_seed"),
    # Not (0, True): a flight that never moved cannot be distinguished from one with the same start.
    [(0, False), (1, False), (1, True), (2, True), (5, True), (None, True), (None, False)],
)
def test_two_flights_in_one_bag(steps_of_first, same_seed):
    first = flight(SCENARIO, steps=steps_of_first)
    second = flight(SCENARIO, missions=2, seed=0 if same_seed else 9, begun_ns=LATER_NS)
    found, stream = read(first + second)
    one, two = ([plain(s)[1:] for s in read(recorded)[0]] for recorded in (first, second))
    assert [plain(s)[1:] for s in found if s.flight == 0] == one
    assert [plain(s)[1:] for s in found if s.flight == 1] == two
    assert not stream.orphans + stream.repeated
    assert not any(step.conflicts for step in found)


@given(st.integers(0, 2**32))
@settings(max_examples=20, deadline=None)
def test_two_flights_of_which_topics_are_late(seed):
    """Each writer's messages come in its order: by that a start that comes again is known."""
    rng = random.Random(seed)
    second = flight(SCENARIO, seed=4, begun_ns=LATER_NS)
    found, stream = read(
        [m for recorded in (FLIGHT, second) for m in shuffled(recorded, rng, 2 * PER_STEP, True)]
    )
    assert [plain(step) for step in found if step.flight == 0] == WHOLE
    assert len([step for step in found if step.flight == 1]) == LAST + 1 == len(found) - len(WHOLE)
    assert all(None not in plain(step)[1:-1] for step in found)
    assert not stream.orphans


def test_an_abort_ends_the_step_that_was_ready():
    found, _ = read(flight(SCENARIO, steps=3))
    assert [step.status.phase for step in found] == [Phase.READY] * 3 + [Phase.ABORTED]
    assert not found[-1].conflicts


def test_a_vehicle_that_was_stopped_and_goes_on_is_ready_again():
    recorded = flight(SCENARIO)
    i, ready = next((i, m) for i, m in enumerate(recorded) if m.topic == "/mission" and i > 10)
    status = next(s.status for s in read(recorded)[0] if s.publish_ns["mission"] == ready.publish_time_ns)
    aborted = msgspec.structs.replace(status, phase=Phase.ABORTED)
    recorded.insert(i + 1, bag_message("mission", aborted, ready.log_time_ns + 1))
    recorded.insert(i + 2, bag_message("mission", status, ready.log_time_ns + 2))
    found, stream = read(recorded)
    assert not any(step.conflicts for step in found)
    assert stream.repeated == {"mission": 1}
    assert found[-1].status.phase is not Phase.ABORTED


def test_what_is_said_again_differently_is_kept_beside_the_first():
    i, one = next((i, m) for i, m in enumerate(FLIGHT) if m.topic == "/move")
    other = messages.Move(mission=0, step=0, action="hover")
    recorded = [*FLIGHT, bag_message("move", other, one.log_time_ns + 1)]
    found, _ = read(recorded)
    assert found[0].move.action == "left"
    assert found[0].conflicts == {"move": other}
    assert [plain(step) for step in found] == WHOLE
    assert i < PER_STEP


def test_the_first_pose_of_the_steps_own_time_is_its_position():
    """An aircraft publishes many; stamps of another time do not belong to the step."""
    users = next(m for m in FLIGHT if m.topic == "/users")
    now_ns = users.log_time_ns
    recorded = [
        bag_message("pose", pose((9, 9, 9), 10 * STEP_NS), now_ns - 3),  # of the future
        users,
        bag_message("pose", pose((3, 3, 3), 700), now_ns + 3),
        bag_message("pose", pose((1, 1, 1), 500), now_ns + 4),  # overtaken on its way
        bag_message("pose", pose((1, 1, 1), 500), now_ns + 5),
        bag_message("pose", pose((2, 2, 2), 500), now_ns + 6),
        bag_message("pose", pose((4, 4, 4), STEP_NS), now_ns + 7),  # of the next step
        bag_message("pose", pose((5, 5, 5), 100, frame="odom"), now_ns + 8),
        bag_message("pose", pose((float("nan"), 5, 5), 100), now_ns + 9),
        bag_message("pose", pose((5, 5, 5), 100)[:40], now_ns + 10),
    ]
    (step,), stream = read(recorded)
    assert step.position_m.tolist() == [1.0, 1.0, 1.0]
    assert [p.position_m[0] for p in step.poses] == [1.0, 2.0, 3.0]
    assert (step.log_ns["pose"], step.publish_ns["pose"]) == (now_ns + 4, now_ns + 4)
    assert stream.rejected == {("pose", "frame"): 1, ("pose", "not_finite"): 1, ("pose", "malformed"): 1}


def test_poses_without_users_do_not_fill_the_memory():
    recorded = [
        bag_message("pose", pose((0, 0, 100), i * 10**6), BEGUN_NS + i)
        for i in range(step_reader.POSES_MAX + 50)
    ]
    stream = Steps(InMemory(recorded), "")
    assert list(stream) == []
    assert len(stream._poses) == step_reader.POSES_MAX


def test_what_cannot_be_read_is_counted(tmp_path):
    garbage = [
        BagMessage("/move", "std_msgs/msg/String", text("{"), BEGUN_NS + 1, 0),
        BagMessage("/move", "std_msgs/msg/String", text("{}"), BEGUN_NS + 2, 0),
        BagMessage("/rates", "std_msgs/msg/String", b"\0\1\0\0\xff\0\0\0", BEGUN_NS + 3, 0),
    ]
    found, stream = read(FLIGHT + garbage)
    assert [plain(step) for step in found] == WHOLE
    assert stream.rejected == {("move", "malformed"): 1, ("move", "invalid"): 1, ("rates", "malformed"): 1}


def test_namespaces(tmp_path):
    """Each namespace has its own missions; topics of another type do not count."""
    second = [m._replace(topic=f"/uav2{m.topic}") for m in flight(SCENARIO, seed=5)]
    foreign = BagMessage("/uav3/mission", "std_msgs/msg/Bool", b"\0\1\0\0\1", BEGUN_NS, BEGUN_NS)
    recorded = sorted([*FLIGHT, *second], key=lambda message: message.log_time_ns)
    bag = write(tmp_path / "bag", [foreign, *recorded])
    with BagReader(bag) as reader:
        assert step_reader.namespaces(reader) == ["", "/uav2"]
        with pytest.raises(BagError, match=r"holds missions in /, /uav2; expected one of them"):
            step_reader.namespace(reader)
        with pytest.raises(BagError, match=r"no mission in namespace 'uav3'; expected /, /uav2"):
            step_reader.namespace(reader, "uav3")
        assert [plain(s) for s in Steps(reader, step_reader.namespace(reader, "/"), STEP_NS)] == WHOLE
        other = list(Steps(reader, step_reader.namespace(reader, "uav2"), STEP_NS))
    assert {step.status.seed for step in other} == {5}
    assert len(other) == LAST + 1


def test_a_topic_of_another_type_is_told():
    odometry = [m._replace(type="nav_msgs/msg/Odometry") if m.topic == "/pose" else m for m in FLIGHT]
    with pytest.raises(
        BagError, match=r"topic /pose is of type nav_msgs/msg/Odometry \(cdr\); expected geom"
    ):
        read(odometry)


def test_the_scenario_of_a_bag(tmp_path):
    from uav_dc_ros import scenarios

    shipped = scenarios.load("three_clusters_hover")
    bag = write(tmp_path / "foreign", flight(shipped, steps=1))
    with BagReader(bag) as reader:
        assert step_reader.scenario(reader, "") == shipped, "by the fingerprint of its missions"
        assert step_reader.scenario(reader, "", "five_clusters_hover").name == "five_clusters_hover"
    bag = write(tmp_path / "unknown", flight(SCENARIO, steps=1))
    with (
        BagReader(bag) as reader,
        pytest.raises(BagError, match=r"fly 'tiny' \([0-9a-f]{12}\); expected --sc"),
    ):
        step_reader.scenario(reader, "")
