"""`bag cut` by missions and steps: what is cut verifies as the original does."""

import re
from itertools import pairwise
from pathlib import Path

import pytest

from tests.bags.test_edit import messages
from tests.bags.test_foreign import run
from tests.recordings import made
from tests.support.bags import in_mcap
from tests.support.worlds import tiny
from uav_dc_ros import messages as contract
from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.recordings.info.survey import survey
from uav_dc_ros.recordings.step_reader import Steps

Capture = pytest.CaptureFixture[str]
WORLD = tiny()


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four missions; the last rates of each are recorded after the first messages of the next one."""
    recorded = made.flight(WORLD, missions=4, seed=5)
    late = [
        one._replace(log_time_ns=one.log_time_ns + 2 * made.APART_NS + 1)
        if (one.topic, other.topic) == ("/rates", "/pose")
        else one
        for one, other in pairwise([*recorded, recorded[0]])
    ]
    late.sort(key=lambda message: message.log_time_ns)
    about = made.about(WORLD, 5, missions="4")
    return made.write(tmp_path_factory.mktemp("flown") / "B", late, about, latched=True)


def steps(bag: Path, **options: bool) -> list[tuple[int, int, bool]]:
    """Mission and step of what a bag holds, and whether it is all there."""
    with BagReader(bag, **options) as reader:
        return [
            (
                step.mission,
                step.step,
                all(one is not None for one in (step.users, step.rates, step.position_m)),
            )
            for step in Steps(reader, "", WORLD.step_ns)
        ]


@pytest.mark.parametrize(("wanted", "missions"), [("0", [0]), ("1-2", [1, 2])])
def test_a_cut_mission_verifies_as_the_original_does(
    flown: Path, tmp_path: Path, capsys: Capture, wanted: str, missions: list[int]
) -> None:
    run(capsys, "cut", flown, "--out", tmp_path / "cut", "--missions", wanted)
    assert steps(tmp_path / "cut") == [one for one in steps(flown) if one[0] in missions]
    whole, cut = (run(capsys, "verify", bag).splitlines() for bag in (flown, tmp_path / "cut"))
    n = sum(mission in missions for mission, *_ in steps(flown))
    assert f"channel: {n} of {n} steps recomputed, equal to the last bit" in cut
    assert f"world: {n} of {n} steps recomputed, equal to the last bit" in cut
    assert [line.split(":")[0] for line in cut[1:]] == [line.split(":")[0] for line in whole[1:]]
    found = survey(tmp_path / "cut")
    assert found.complete, found.problems
    assert found.about["missions"] == str(len(missions))
    assert re.search(r"made by +bag cut, mission", run(capsys, "info", tmp_path / "cut"))


def test_all_missions_cut_and_merged_are_the_original(flown: Path, tmp_path: Path, capsys: Capture) -> None:
    for mission in range(4):
        run(capsys, "cut", flown, "--out", tmp_path / f"{mission}", "--missions", mission)
    run(capsys, "merge", *(tmp_path / f"{mission}" for mission in (2, 0, 3, 1)), "--out", tmp_path / "all")
    assert messages(tmp_path / "all") == messages(flown)
    with BagReader(tmp_path / "all") as reader:
        about = {**reader.about, "made_by": ""}
    assert about == made.about(WORLD, 5, missions="4", made_by="")


def test_a_mission_in_two_bags_is_one_mission_of_the_merged(
    flown: Path, tmp_path: Path, capsys: Capture
) -> None:
    for wanted in ("0-1", "1-3"):
        run(capsys, "cut", flown, "--out", tmp_path / wanted, "--missions", wanted)
    run(capsys, "merge", tmp_path / "0-1", tmp_path / "1-3", "--out", tmp_path / "all")
    assert messages(tmp_path / "all") == messages(flown)
    found = survey(tmp_path / "all")
    assert (found.complete, len(found.missions)) == (True, 4)


def test_a_cut_of_steps_begins_with_the_state_before_them(
    flown: Path, tmp_path: Path, capsys: Capture
) -> None:
    run(capsys, "cut", flown, "--out", tmp_path / "cut", "--missions", 2, "--steps", "2-3")
    assert steps(tmp_path / "cut", repeats=False) == [(2, 2, True), (2, 3, True)]
    head = [row for row in in_mcap(tmp_path / "cut" / "cut_0.mcap") if row[1] == 0]
    assert {row[0] for row in head} == {"/users", "/rates", "/mission"}
    # The rates before them give the data before them: the channel of both steps is recomputed.
    assert "channel: 2 of 3 steps recomputed, equal" in run(capsys, "verify", tmp_path / "cut")
    run(capsys, "cut", flown, "--out", tmp_path / "first", "--steps", "0-1")
    assert steps(tmp_path / "first") == [(0, 0, True), (0, 1, True)]


def test_missions_that_the_bag_does_not_hold(flown: Path, tmp_path: Path, capsys: Capture) -> None:
    last = max(step for mission, step, _ in steps(flown) if mission == 3)
    holds = f"it holds mission 0, step 0 to mission 3, step {last}"
    for options, missing in (
        (["--missions", "3-4"], "no missions 3 to 4 in flight 0"),
        (["--missions", "9"], "no mission 9 in flight 0"),
        (["--missions", "3", "--steps", f"1-{last + 1}"], f"no mission 3, steps 1 to {last + 1} in flight 0"),
    ):
        error = run(capsys, "cut", flown, "--out", tmp_path / "no", *options, status=2)
        assert f"{missing}; {holds}" in error
    error = run(capsys, "cut", flown, "--out", tmp_path / "no", "--missions", 0, "--flight", 1, status=2)
    assert "in flight 1; it holds none" in error
    assert not list(tmp_path.iterdir())


def test_of_two_flights_and_after_a_clock_that_was_set_back(tmp_path: Path, capsys: Capture) -> None:
    one = made.flight(WORLD, seed=1)
    begun_ns = one[-1].log_time_ns + 10**9
    two = made.flight(WORLD, seed=2, begun_ns=begun_ns)
    bag = made.write(tmp_path / "bag", [*one, *two], made.about(WORLD, 1))
    run(capsys, "cut", bag, "--out", tmp_path / "second", "--missions", 0, "--flight", 1)
    assert messages(tmp_path / "second") == sorted(two, key=lambda m: (m.log_time_ns, *m))
    earlier = made.flight(WORLD, seed=2, begun_ns=made.BEGUN_NS - 60 * 10**9)
    bag = made.write(tmp_path / "back", [*one, *earlier], made.about(WORLD, 1))
    error = run(capsys, "cut", bag, "--out", tmp_path / "no", "--missions", 0, status=2)
    assert "its clock was set back by 60" in error
    # A conversion keeps the order of recording, by which readers see that.
    run(capsys, "convert", bag, "--out", tmp_path / "same")
    with BagReader(bag) as before, BagReader(tmp_path / "same") as after:
        assert list(after.recorded()) == list(before.recorded())
        assert after.set_back_ns == before.set_back_ns > 0


def test_messages_that_are_no_payloads_are_cut_by_time(flown: Path, tmp_path: Path, capsys: Capture) -> None:
    whole = messages(flown)
    times = [m.log_time_ns for m in whole if m.topic == "/move"]
    stray = whole[0]._replace(
        topic="/move", type=contract_type(), data=b"\0\1\0\0\3\0\0\0{}\0", log_time_ns=times[3]
    )
    bag = made.write(
        tmp_path / "bag", sorted([*whole, stray], key=lambda m: m.log_time_ns), made.about(WORLD, 5)
    )
    run(capsys, "cut", bag, "--out", tmp_path / "cut", "--missions", 0)
    assert stray in messages(tmp_path / "cut")


def contract_type() -> str:
    """The type of JSON topics."""
    return made.bag_message("move", contract.Move(mission=0, step=0, action="hover"), 0).type
