"""Bags of flights with a real vehicle: read, verified, exported, and shown on a page."""

import csv
import json
import math
import re
import shutil

import msgspec
import numpy as np
import pytest

from tests.conftest import Ros, finish
from tests.nodes.conftest import low  # noqa: F401
from tests.nodes.test_bridge import flies_east, killed, until
from tests.recordings import report_bags
from tests.recordings.made import bag_message, changing, copy, flight, write
from tests.recordings.test_steps import LATER_NS, STEP_NS, InMemory, read
from tests.support import flights
from tests.support.fake_autopilot.flight import fake
from tests.support.worlds import saved, tiny
from uav_dc_ros import bag as command
from uav_dc_ros import cdr, messages
from uav_dc_ros.agents import policy as policies
from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.messages import FaultKind, Phase
from uav_dc_ros.offboard.mission.fault_detector import SafetySettings
from uav_dc_ros.recordings.info.survey import survey_missions
from uav_dc_ros.recordings.pages import missions as pages
from uav_dc_ros.recordings.pages.vehicle import PATH_MAX, VehiclePath
from uav_dc_ros.recordings.recorded_step import PHASE_REPORTS_MAX, RecordedPose
from uav_dc_ros.recordings.step_reader import Steps, vehicle

TINY = tiny()
LONG = tiny(mission={"max_steps": 30})
LAST = TINY.mission.max_steps


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    """A bag of a flight with each fault, and one that a policy flew, by name."""
    folder = tmp_path_factory.mktemp("flown")
    made = {name: flights.bag(folder / name, TINY, name, seed=5) for name in flights.FAULTS}
    own = policies.load(saved(folder / "p", TINY, name="own"))
    recorded = flights.Flight(TINY, seed=5, policy=own, settings=SafetySettings(arm=True)).fly()
    made["policy"] = write(
        folder / "policy", recorded, flights.flown_about(TINY, 5, policy="own", policy_sha256=own.sha256)
    )
    return made


def run(capsys, verb, bag, *options):
    """Exit status and output of a verb."""
    with pytest.raises(SystemExit) as exit:
        command.main([verb, str(bag), *map(str, options)])
    out, err = capsys.readouterr()
    if exit.value.code == 2:
        assert len(err.splitlines()) == 1, err
    return exit.value.code, out + err


def steps_of(bag):
    with BagReader(bag) as reader:
        stream = Steps(reader, "", STEP_NS)
        return list(stream), stream


@pytest.fixture(scope="module")
def not_reached(tmp_path_factory):
    """A bag of a flight of which two steps were not reached; one of them while it lasted."""
    recorded = flights.Flight(TINY, seed=5).fly()
    changed = []
    for message in recorded:
        if message.topic == "/mission":
            payload = messages.decode(cdr.decode_string(message.data), messages.Mission)
            late = payload.step == 2 and payload.phase is not Phase.READY
            n = (payload.step > 1) + (payload.step > 2 or late)
            payload = msgspec.structs.replace(payload, steps_not_reached=n)
            message = message._replace(data=bag_message("mission", payload, 0).data)
        changed.append(message)
    return write(tmp_path_factory.mktemp("late") / "bag", changed, flights.flown_about(TINY, 5))


def test_steps_that_were_not_reached_are_reported(not_reached, capsys, tmp_path):
    assert not any(step.conflicts for step in steps_of(not_reached)[0])
    status, printed = run(capsys, "verify", not_reached)
    assert status == 0
    assert "2 flown steps did not reach their cell within the tolerance" in printed
    _, printed = run(capsys, "info", not_reached)
    assert re.search(r"steps +not reached +users collected", printed)
    _, printed = run(capsys, "info", not_reached, "--json")
    assert json.loads(printed)["missions"][0]["steps_not_reached"] == 2
    run(capsys, "export", not_reached, "--out", tmp_path / "tables", "--format", "csv")
    (row,) = csv.DictReader((tmp_path / "tables" / "missions.csv").open())
    assert row["steps_not_reached"] == "2"
    with BagReader(not_reached) as reader:
        (one,) = pages.read_missions(Steps(reader, "", STEP_NS), TINY, True)
    assert one.summary()["steps_not_reached"] == 2


def test_the_last_reason_of_an_aborted_mission_is_its_reason(tmp_path, capsys):
    """An earlier one for the same end is not."""
    recorded = flights.Flight(TINY, seed=5).fly()
    last = max(i for i, message in enumerate(recorded) if message.topic == "/mission")
    payload = messages.decode(cdr.decode_string(recorded[last].data), messages.Mission)
    for i, reason in enumerate(("step 4: there", "the motors were stopped: by hand")):
        ended = msgspec.structs.replace(payload, phase=Phase.ABORTED, reason=reason)
        recorded.insert(
            last + i, bag_message("mission", ended, recorded[last + i - 1].publish_time_ns + 1000)
        )
    del recorded[last + 2 :]
    bag = write(tmp_path / "bag", recorded, flights.flown_about(TINY, 5))
    assert "the motors were stopped: by hand" in run(capsys, "info", bag)[1]
    run(capsys, "export", bag, "--out", tmp_path / "tables", "--format", "csv")
    (row,) = csv.DictReader((tmp_path / "tables" / "missions.csv").open())
    assert (row["outcome"], row["reason"]) == ("aborted", "the motors were stopped: by hand")
    with BagReader(bag) as reader:
        (one,) = pages.read_missions(Steps(reader, "", STEP_NS), TINY, True)
    assert one.summary()["reason"] == "the motors were stopped: by hand"


# Steps.


@pytest.mark.parametrize("fault", flights.FAULTS)
def test_a_step_has_all_phase_reports_of_its_vehicle(bags, fault):
    """Nothing is lost, repeated or too late, whatever happens on the way."""
    found, stream = steps_of(bags[fault])
    with BagReader(bags[fault]) as reader:
        words = flights.phases(list(reader.messages()))
    assert [
        (step.step, report.phase, report.reason) for step in found for report in step.phase_reports
    ] == words
    assert not stream.orphans + stream.repeated + stream.rejected
    assert not any(step.conflicts or step.n_dropped_reports for step in found)
    ends = flights.FAULTS[fault][1]
    assert (found[-1].status.phase, found[-1].status.reason) == (ends, words[-1][2])
    for step in found[:-1]:
        assert step.status.phase is Phase.READY
    for step in found:
        lacks_all = step.users is None and step.rates is None
        assert step.is_measured != lacks_all
        assert step.is_measured == (fault != "ground")


def test_the_status_is_the_same_in_any_order():
    recorded = flights.Flight(TINY, beat=flights.FAULTS["battery"][0]).fly()
    words = [m for m in recorded if m.topic == "/mission"]
    expected, _ = read(recorded)
    times = {m.log_ns: step.step for step in expected for m in step.phase_reports}
    late = []
    for number in range(len(expected)):  # those of a step the other way round
        of_step = [m for m in words if times[m.log_time_ns] == number]
        late += [m._replace(log_time_ns=o.log_time_ns) for m, o in zip(of_step, of_step[::-1], strict=True)]
    found, _ = read([*(m for m in recorded if m.topic != "/mission"), *late])
    assert [step.status for step in found] == [step.status for step in expected]
    assert [[t[:2] for t in step.phase_reports] for step in found] == [
        [t[:2] for t in step.phase_reports] for step in expected
    ]


def test_a_vehicle_that_is_ready_again_has_the_same_users_at_another_time():
    """After a fault while it was ready, the world publishes the users again, with the time of a new pose."""
    frozen = flights.all_of(
        flights.once(flights.in_phase(Phase.READY, 0, 1.0), flights.setting(frozen=True)),
        flights.once(flights.in_phase(Phase.READY, 0, 3.0), flights.setting(frozen=False)),
    )
    flight = flights.Flight(TINY, beat=frozen, patience_s=5.0)
    found, stream = read(flight.fly())
    reasons = [one.reason for one in found[0].phase_reports if one.phase is Phase.READY]
    assert reasons[1:] == ["no position for 0.5 s", f"resumed after: {reasons[1]}"]
    kinds = [one.fault for one in found[0].phase_reports if one.phase is Phase.READY]
    assert kinds == [None, FaultKind.POSITION, None]
    assert found[0].flight == found[-1].flight == 0, "it is no other flight"
    assert found[0].conflicts["users"].stamp_ns > found[0].users.stamp_ns
    assert stream.repeated == {"rates": 1}
    assert len(found) == LAST + 1


def test_what_a_middleware_repeats_is_counted_and_kept_once():
    recorded = flights.Flight(TINY).fly()
    words = [
        m._replace(log_time_ns=recorded[-1].log_time_ns + i)
        for i, m in enumerate(recorded)
        if m.topic == "/mission"
    ]
    found, stream = read([*recorded, *words])
    assert stream.repeated == {"mission": len(words)}
    assert not stream.orphans
    assert [step.phase_reports for step in found] == [step.phase_reports for step in read(recorded)[0]]


def test_a_vehicle_that_waits_for_hours_fills_no_memory():
    recorded = flights.Flight(TINY, beat=flights.FAULTS["ground"][0]).fly()
    i, word = next((i, m) for i, m in enumerate(recorded) if m.topic == "/mission")
    status = messages.decode(cdr.decode_string(word.data), messages.Mission)
    again = [
        bag_message("mission", msgspec.structs.replace(status, reason=f"waits {n}"), word.log_time_ns + n)
        for n in range(1, PHASE_REPORTS_MAX + 50)
    ]
    recorded[i:i] = again
    (step,), stream = read(recorded)
    assert len(step.phase_reports) == PHASE_REPORTS_MAX
    assert step.n_dropped_reports == len(flights.phases(recorded)) - PHASE_REPORTS_MAX
    assert step.status.phase is step.phase_reports[-1].phase is Phase.ABORTED
    assert not stream.repeated


@pytest.fixture(scope="module")
def long_flight():
    """A flight of a quarter of an hour, since the policy thinks for long."""
    return flights.Flight(LONG, patience_s=14.0, tick_s=0.05).fly()


def test_the_poses_of_a_long_flight_are_few_in_memory(long_flight):
    """Twenty poses a second, of which a step keeps some; none is held that no step can want."""
    assert sum(m.topic == "/pose" for m in long_flight) > 9_000
    stream = Steps(InMemory(long_flight), "", STEP_NS)
    most = 0
    for step in stream:
        most = max(most, len(stream._poses))
        assert step.poses[0].stamp_ns == step.users.stamp_ns
    assert most < 2000


def test_a_flight_that_never_left_the_ground_and_one_that_did_are_two(bags):
    one = flights.Flight(TINY, beat=flights.FAULTS["ground"][0]).fly()
    two = flights.Flight(TINY, begun_ns=LATER_NS).fly()
    found, stream = read([*one, *two])
    assert [(s.flight, s.step) for s in found] == [(0, 0), *((1, s) for s in range(LAST + 1))]
    assert (found[0].status.phase, found[-1].status.phase) == (Phase.ABORTED, Phase.LANDED)
    assert not stream.orphans + stream.repeated


# Verify.


@pytest.mark.parametrize("fault", flights.FAULTS)
def test_a_flight_verifies(bags, capsys, fault):
    status, out = run(capsys, "verify", bags[fault])
    assert status == 0, out
    n = len(steps_of(bags[fault])[0])
    measured = 0 if fault == "ground" else n
    expected = (
        f"channel: {n} of {n} steps recomputed, equal to the last bit" if measured else "channel: the bag"
    )
    assert expected in out
    assert f"world: {n} of {n} steps recomputed, equal to the last bit" in out
    assert f"vehicle (mavlink): phases of {n} of {n} steps checked, all changes are allowed" in out
    assert "none twice" in out


def test_a_policys_flight_verifies_wholly(bags, capsys):
    status, out = run(capsys, "verify", bags["policy"], "--policy-dir", bags["policy"].parent, "--complete")
    assert status == 0, out
    assert f"decisions: {LAST} of {LAST} steps recomputed, equal to the last bit" in out
    assert out.endswith("\nverified\n")


def test_the_distance_from_the_cells_is_reported(bags, capsys):
    found, _ = steps_of(bags["none"])
    off_m = [
        math.dist(s.poses[0].position_m, TINY.grid.centre_m(np.asarray(s.status.cell), like=np.zeros(1)))
        for s in found
    ]
    _, out = run(capsys, "verify", bags["none"])
    at = found[int(np.argmax(off_m))].name
    mean, most = f"{np.mean(off_m):.2f} m", f"{max(off_m):.2f} m ({at})"
    assert f"distance from the centre of the cell: mean {mean}, max {most}" in out
    # A vehicle that cannot descend in the time of a step is reported, and is no difference.
    assert "nearer to the centre of another cell" not in out


def again(change):
    return lambda payload: msgspec.structs.replace(payload, **change)


@pytest.mark.parametrize(
    ("topic", "step", "change", "expected"),
    [
        ("users", 3, lambda p: {"x_m": [x + 1e-9 for x in p.x_m]}, "users: mission 0, step 3, user 0, x_m"),
        ("users", 3, lambda p: {"stamp_ns": p.stamp_ns - 30 * 10**9}, "users: mission 0, step 3, stamp_ns"),
        ("mission", 3, lambda p: {"cell": (0, 0, 0)}, "mission: mission 0, step 3, cell"),
        ("mission", 3, lambda p: {"remaining_steps": 1}, "mission: mission 0, step 3, remaining_steps"),
        ("rates", 3, lambda p: {"sinr": [0.0] * 4}, "rates: mission 0, step 3, user"),
        ("mission", 8, lambda p: {"phase": Phase.TIMEOUT} if p.phase.is_over else {}, "step 8, phase"),
        ("mission", 3, lambda p: {"phase": Phase.TAKEOFF} if p.phase is Phase.READY else {}, "step 3, phase"),
    ],
)
def test_what_is_changed_in_it_is_found(bags, capsys, tmp_path, topic, step, change, expected):
    bag = copy(
        bags["none"],
        tmp_path / "bag",
        changing(topic, 0, step, lambda p: msgspec.structs.replace(p, **change(p))),
    )
    status, out = run(capsys, "verify", bag)
    assert (status, expected in out) == (1, True), out


def test_a_move_that_was_flown_twice_is_found(bags, capsys, tmp_path):
    """What a bridge would publish that restarted a move after it was killed."""
    with BagReader(bags["none"]) as reader:
        recorded = list(reader.messages())
    where = [i for i, m in enumerate(recorded) if m.topic == "/mission"]
    moving = next(
        i
        for i in where
        if (p := messages.decode(cdr.decode_string(recorded[i].data), messages.Mission)).step == 3
        and p.phase is Phase.MOVING
    )
    ready = max(i for i in where if i < moving)
    later_ns = recorded[moving].publish_time_ns
    twice = [
        m._replace(publish_time_ns=later_ns + 1 + n, log_time_ns=recorded[moving].log_time_ns + 1 + n)
        for n, m in enumerate((recorded[ready], recorded[moving]))
    ]
    recorded[moving + 1 : moving + 1] = twice
    bag = write(tmp_path / "bag", recorded, flights.flown_about(TINY, 5))
    status, out = run(capsys, "verify", bag)
    assert status == 1
    assert "phases of 9 of 9 steps checked, 1 have a change that is not allowed; first:" in out
    assert "mission: mission 0, step 3, phase: recorded 'ready', recomputed 'one of landing" in out


def test_the_vehicle_of_another_recorders_bag_is_known_by_its_statuses(bags, capsys, tmp_path):
    with BagReader(bags["hold"]) as reader:
        recorded = list(reader.messages())
        assert vehicle(reader, "") == "mavlink"
    about = {"scenario_values": json.dumps(msgspec.to_builtins(TINY))}
    bag = write(tmp_path / "real", recorded, about)
    with BagReader(bag) as reader:
        assert vehicle(reader, "") == "external"
    status, out = run(capsys, "verify", bag)
    assert status == 0, out
    assert "vehicle (external): phases of 9 of 9" in out
    assert out.endswith("verified in part\n"), "whether the users came from a seed is not known"
    bag = write(tmp_path / "simulated", flight(TINY), about)
    with BagReader(bag) as reader:
        assert vehicle(reader, "") == "simulated"


@pytest.mark.parametrize(
    "seeds", [range(7, 13), pytest.param(range(300), marks=pytest.mark.long)], ids=["some", "many"]
)
def test_whatever_happens_on_the_way_the_bag_verifies(tmp_path, capsys, seeds):
    """Faults at random moments: no report of a bridge counts as a difference."""
    ends = set()
    for seed in seeds:
        recorded = flights.Flight(TINY, seed=seed, beat=flights.at_random(seed)).fly(cut_s=400.0)
        bag = write(tmp_path / str(seed), recorded, flights.flown_about(TINY, seed))
        status, out = run(capsys, "verify", bag)
        assert status == 0, (seed, out)
        with BagReader(bag) as reader:
            (mission,) = survey_missions(reader, "", [])
        assert mission.reason
        # A bridge that dies between a status and the next pose leaves a step that is not measured.
        assert max(mission.missing.values(), default=0) <= 1, (seed, mission.missing)
        ends.add(mission.outcome)
        shutil.rmtree(bag)
    assert ends >= {"landed", "aborted"}


@pytest.mark.long
def test_real_nodes_that_were_killed_leave_a_bag_that_verifies(ros: Ros, low, capsys):  # noqa: F811
    """Through real DDS and real MAVLink, beside a fake autopilot: both policy and bridge die on the way."""
    bag = ros.folder / "bag"
    with fake("ardupilot", speed=4.0) as autopilot:
        options = (
            "--vehicle",
            "mavlink",
            "--connect",
            autopilot.address,
            "--arm",
            "--datum",
            "here",
            "--bag",
            bag,
        )
        process = ros.start("uav_dc_ros.run_all", *low, *options)
        for step, node in ((2, "policy"), (5, "bridge")):
            until(lambda step=step: flies_east(autopilot, step), process)
            killed(ros, node, process)
        status, output = finish(process)
    assert status == 0, output
    status, out = run(capsys, "verify", bag, "--policy-dir", low[-1], "--complete")
    assert status == 0, out
    assert out.endswith("\nverified\n")
    assert "phases of 8 of 8 steps checked, all changes are allowed; 7 moves were started" in out
    recorded = [one for step in steps_of(bag)[0] for one in step.phase_reports]
    gone = (True, FaultKind.POLICY, "policy lost")
    assert gone in {(one.held, one.fault, one.reason) for one in recorded}
    assert sum(one.phase is Phase.TAKEOFF for one in recorded) == 2
    status, out = run(capsys, "info", bag)
    assert "vehicle   mavlink" in out
    assert "pace" not in out, "it has its own"
    assert "bridge 1, policy 1" in out
    assert "mission 0: landed: step 7: at the dock" in out
    timeline = page_of(capsys, bag, ros.folder)["mission-0"]["timeline"]
    assert max(timeline["path"]["z"]) == pytest.approx(10.0, abs=2.0)


def as_version_0_1(message):
    """A status as in version 0.1: a fault had no field, and was part of the reason."""
    payload = json.loads(cdr.decode_string(message.data))
    held, _ = payload.pop("held"), payload.pop("fault")
    payload["reason"] = f"holds: {payload['reason']}" if held else payload["reason"]
    return message._replace(data=cdr.encode_string(json.dumps(payload).encode()))


def test_a_bag_of_version_0_1_is_read_as_before(bags, capsys, tmp_path):
    recorded = flights.Flight(TINY, seed=5, beat=flights.FAULTS["hold"][0]).fly()
    old = [as_version_0_1(one) if one.topic == "/mission" else one for one in recorded]
    bag = write(tmp_path / "old", old, flights.flown_about(TINY, 5))
    words = [[one for step in steps_of(it)[0] for one in step.phase_reports] for it in (bag, bags["hold"])]
    assert [one.held for one in words[0]] == [one.held for one in words[1]]
    prefixes = ["holds: " if one.held else "" for one in words[1]]
    assert any(prefixes)
    assert [one.reason for one in words[0]] == [
        prefix + one.reason for prefix, one in zip(prefixes, words[1], strict=True)
    ]
    texts = [run(capsys, "verify", it) for it in (bag, bags["hold"])]
    assert texts[0] == (0, texts[1][1].replace(str(bags["hold"]), str(bag)))
    pages = [page_of(capsys, it, tmp_path)["data"]["health"]["faults"] for it in (bag, bags["hold"])]
    assert len(pages[0]) == len(pages[1]) == sum(map(bool, prefixes))
    assert all(fault["what"].partition(": ")[2].startswith("holds: ") for fault in pages[0])


# Info, export.


@pytest.mark.parametrize("fault", ["none", "pilot", "ground"])
def test_info_shows_the_outcome_with_its_reason(bags, capsys, fault):
    status, out = run(capsys, "info", bags[fault])
    found, _ = steps_of(bags[fault])
    ended = found[-1].status
    assert (status, "complete" in out.splitlines()[0]) == (0, True), out
    assert "not complete" not in out
    assert f" mission 0: {ended.phase}: {ended.reason}" in out
    assert "vehicle   mavlink" in out


def test_a_reason_that_commands_the_terminal_does_not(bags, capsys, tmp_path):
    hostile = changing("mission", 0, LAST, again({"reason": "\x1b[2J\nin"}))
    out = run(capsys, "info", copy(bags["none"], tmp_path / "bag", hostile))[1]
    assert "mission 0: landed: \\x1b[2J\\nin" in out


def table(folder, name):
    with (folder / f"{name}.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_an_export_has_reasons_phases_and_times(bags, capsys, tmp_path):
    status, out = run(capsys, "export", bags["restart"], "--out", tmp_path / "t", "--format", "csv")
    assert status == 0, out
    found, _ = steps_of(bags["restart"])
    rows = table(tmp_path / "t", "steps")
    assert [row["reason"] for row in rows] == [step.status.reason for step in found]
    assert [row["phase"] for row in rows] == ["ready"] * LAST + ["landed"]
    assert rows[0]["flown_s"] == ""
    for before, step, row in zip(found, found[1:], rows[1:], strict=False):
        begun = next(t for t in before.phase_reports if t.phase is Phase.MOVING)
        there = next(t for t in step.phase_reports if t.phase in (Phase.READY, Phase.LANDING))
        assert float(row["flown_s"]) == pytest.approx((there.publish_ns - begun.publish_ns) / 1e9)
    assert sum(float(row["flown_s"]) for row in rows[1:5]) > 40.0, "a hundred metres take ten seconds"
    words = [(int(r["step"]), r["phase"], r["reason"], r["held"]) for r in table(tmp_path / "t", "phases")]
    assert words == [
        (s.step, t.phase.value, t.reason, str(t.held).lower()) for s in found for t in s.phase_reports
    ]
    (mission,) = table(tmp_path / "t", "missions")
    assert (mission["vehicle"], mission["outcome"], mission["reason"]) == (
        "mavlink", "landed", found[-1].status.reason,
    )  # fmt: skip


def test_a_simulated_flight_has_none_of_these(capsys, tmp_path):
    bag = write(tmp_path / "bag", flight(TINY), flights.about(TINY))
    status, out = run(capsys, "export", bag, "--out", tmp_path / "t", "--tables", "phases")
    assert (status, "--tables phases: for real vehicles only; expected steps, users" in out) == (2, True)
    assert run(capsys, "export", bag, "--out", tmp_path / "t", "--format", "csv")[0] == 0
    assert sorted(path.name for path in (tmp_path / "t").iterdir()) == [
        "missions.csv",
        "steps.csv",
        "users.csv",
    ]
    assert not {"reason", "flown_s"} & set(table(tmp_path / "t", "steps")[0])


def test_transitions_are_those_of_the_steps_that_were_flown(bags, capsys, tmp_path):
    """An abort in mid-move ends the mission where it was; no state follows from it."""
    for fault, n in (("restart", LAST), ("pilot", 3), ("battery", 3)):
        out = tmp_path / f"{fault}.npz"
        assert run(capsys, "export", bags[fault], "--out", out, "--transitions")[0] == 0
        with np.load(out) as made:
            assert made["step"].tolist() == list(range(n))
            assert not made["truncated"].any()
            assert made["terminated"].any() == (fault == "restart"), "at the dock"
    assert run(capsys, "export", bags["ground"], "--out", tmp_path / "g.npz", "--transitions")[0] == 2


# Report.


def page_of(capsys, bag, tmp_path):
    status, out = run(capsys, "report", bag, "--out", tmp_path / "page.html")
    assert status == 0, out
    return report_bags.unpacked(tmp_path / "page.html")


@pytest.mark.parametrize("fault", flights.FAULTS)
def test_a_report_shows_phases_faults_and_the_path(bags, capsys, tmp_path, fault):
    data = page_of(capsys, bags[fault], tmp_path)
    found, _ = steps_of(bags[fault])
    recorded = [(step.step, one.phase.value, one.reason) for step in found for one in step.phase_reports]
    timeline = data["mission-0"]["timeline"]
    assert [(row["step"], row["phase"], row["reason"]) for row in timeline["phases"]] == recorded
    assert [row["s"] for row in timeline["phases"]] == sorted(row["s"] for row in timeline["phases"])
    (mission,) = data["data"]["missions"]
    assert (mission["outcome"], mission["reason"]) == (recorded[-1][1], recorded[-1][2])
    whats = [one["what"] for one in data["data"]["health"]["faults"]]
    held = [f"step {step.step}: {one.reason}" for step in found for one in step.phase_reports if one.held]
    assert bool(held) == (fault in ("hold", "frozen"))
    ended = (
        [f"aborted, after step {found[-1].step}: {recorded[-1][2]}"] if recorded[-1][1] == "aborted" else []
    )
    assert whats == held + ended
    cells = timeline["cells"]
    assert cells["step"] == ([] if fault == "ground" else [step.step for step in found])
    assert all(distance_m < 2.0 for distance_m in cells["distance_m"])
    path = timeline["path"]
    assert len(path["s"]) == len(path["x"]) == len(path["z"])
    if fault in ("none", "hold", "restart", "battery"):
        assert max(path["z"]) == pytest.approx(100.0, abs=1.0)
        assert path["z"][-1] < 3.0, "down to the ground"
        assert np.hypot(np.diff(path["x"]), np.diff(path["y"])).sum() > 300.0


def test_the_path_of_a_long_flight_stays_small():
    """Ten hours of poses, now flying, now standing."""
    path = VehiclePath(TINY)
    for i in range(0, 36_000 * 20, 7):
        at_ns = round(i / 20 * 1e9)
        x_m = (i // 20_000) * 500.0 + (i % 20_000) * 0.5 * (i // 20_000 % 2)
        path.add(RecordedPose(at_ns, np.asarray([x_m, 0.0, 100.0]), at_ns, at_ns))
    columns = path.columns(0, 10**18)
    assert 1000 < len(columns["s"]) == len(columns["x"]) == len(columns["z"]) <= PATH_MAX
    assert columns["s"][0] == 0.0
    assert max(np.diff(columns["s"])) < 80.0, "no part of it is lost"
    part = path.columns(10**12, 2 * 10**12)
    assert (part["s"][0] >= 0.0, part["s"][-1] <= 1000.0) == (True, True)


def test_a_long_flight_has_a_report(long_flight, capsys, tmp_path):
    data = page_of(capsys, write(tmp_path / "bag", long_flight, flights.flown_about(LONG)), tmp_path)
    timeline = data["mission-0"]["timeline"]
    assert len(timeline["cells"]["step"]) == LONG.mission.max_steps + 1
    assert (tmp_path / "page.html").stat().st_size < 3_000_000
