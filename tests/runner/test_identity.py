"""One mission beside another, and beside a player of bags: never the other's summary, always a reason."""

import json
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from rosbags.highlevel import AnyReader

from tests.conftest import WITHOUT_VISUALIZER, Ros, but_run, finish, read_bag, wait_for
from tests.nodes.conftest import SMALL
from tests.support.worlds import saved
from uav_dc_ros import cdr, scenarios

TRIES = [1, pytest.param(20, marks=pytest.mark.long)]
COMPARED = ("/users", "/rates", "/mission", "/move")


@pytest.fixture(scope="module")
def options(module_ros: Ros) -> list[object]:
    """A small mission with seed 0."""
    scenario = module_ros.folder / "small.toml"
    scenario.write_text(SMALL)
    policy = saved(module_ros.folder / "untrained", scenarios.load(scenario), name="untrained")
    return ["--scenario", scenario, "--policy", policy, *WITHOUT_VISUALIZER]


@pytest.fixture(scope="module")
def bag(module_ros: Ros, options: list[object]) -> Path:
    """A bag of that mission, flown alone."""
    given = ("--pace", "lockstep", "--bag", "alone", "--summary", "alone.json")
    status, output = module_ros.run_all(*options, *given)
    assert status == 0, output
    return module_ros.folder / "alone"


def payloads(bag: Path) -> tuple[dict[tuple[str, int], list[Any]], set[str]]:
    """What was published of each step of mission 0, without repetitions; and the runs of all missions."""
    found: dict[tuple[str, int], list[Any]] = {}
    runs: set[str] = set()
    with AnyReader([bag]) as reader:
        for connection, _, data in reader.messages([c for c in reader.connections if c.topic in COMPARED]):
            text = cdr.decode_string(bytes(data)).decode()
            runs.update(re.findall(r'"run":"(\w+)"', text))
            if '"mission":0,' in text:
                payload = json.loads(text)
                published = found.setdefault((connection.topic, payload["step"]), [])
                if but_run(payload) not in published:
                    published.append(but_run(payload))
    return found, runs


def refused(ros: Ros, options: list[object], name: str) -> tuple[str, dict[str, Any]]:
    """A run_all that must not fly: what it printed, and its summary."""
    given = ("--pace", "lockstep", "--bag", name, "--summary", f"{name}.json")
    status, output = ros.run_all(*options, *given)
    assert status == 1, output
    assert "Traceback" not in output
    summary = json.loads((ros.folder / f"{name}.json").read_text())
    assert (summary["outcome"], summary["steps"], summary["users_collected"]) == ("aborted", 0, 0), output
    assert f"error: {summary['reason']}" in output
    return output, summary


def stopped(process: subprocess.Popen[str]) -> tuple[int, str]:
    """End a process as Ctrl-C does."""
    process.send_signal(signal.SIGINT)
    return finish(process)


@pytest.mark.long  # the refusal itself: test_rivals
@pytest.mark.parametrize("tries", [20])
def test_a_mission_beside_a_looping_player_is_refused_by_the_player_s_name(
    ros: Ros, options: list[object], bag: Path, tries: int
) -> None:
    """The bag's mission has the same seed: only its run differs from the one that was to be flown."""
    (run,) = {payload["run"] for topic, payload in read_bag(bag) if topic == "/mission"}
    player = ros.start("uav_dc_ros.bag", "play", bag, "--loop", "--rate", 5)
    assert player.stdout is not None
    wait_for(player.stdout, "messages")
    for i in range(tries):
        _, summary = refused(ros, options, f"try{i}")
        assert summary["reason"].startswith("/player publishes "), summary
        assert f"here (run {run}), and is no node of this mission: give this one" in summary["reason"]
    assert "Traceback" not in stopped(player)[1]


@pytest.mark.parametrize("tries", TRIES)
def test_a_mission_beside_another_is_refused_and_the_first_one_is_whole(
    ros: Ros, options: list[object], bag: Path, tries: int
) -> None:
    given = ("--pace", "lockstep", "--bag", "first", "--summary", "first.json", "--missions", 100_000)
    first = ros.start("uav_dc_ros.run_all", *options, *given)
    assert first.stdout is not None
    printed = wait_for(first.stdout, "mission 2 of")
    run = ros.run_id()
    for i in range(tries):
        _, summary = refused(ros, options, f"try{i}")
        expected = f"another mission is being flown here by /world (run {run}): give this one a namespace"
        assert summary["reason"].startswith(expected)
        assert not (ros.folder / f"try{i}").exists()
    status, rest = stopped(first)
    assert status == 130, rest
    # Path and markers keep the newest only: a recorder on a busy machine misses some.
    warnings = re.findall(r".*WARN(?!: dropped messages: /(?:markers|path) ).*", printed + rest)
    assert warnings == [], "it was touched"
    (published, runs), (alone, _) = payloads(ros.folder / "first"), payloads(bag)
    assert published == alone
    assert runs == {run}
    summaries = json.loads((ros.folder / "first.json").read_text())
    expected = json.loads((bag.parent / "alone.json").read_text())
    assert summaries[0] == expected | {"bag": str(ros.folder / "first")}
    assert summaries[-1]["reason"] == "run_all was interrupted"


@pytest.mark.long
def test_of_two_missions_that_start_at_once_one_is_flown(ros: Ros, options: list[object], bag: Path) -> None:
    """Before either is found by discovery, the kernel knows."""
    given = [("--pace", "lockstep", "--bag", name, "--summary", f"{name}.json") for name in ("one", "other")]
    ended = [finish(each) for each in [ros.start("uav_dc_ros.run_all", *options, *one) for one in given]]
    (flown,) = [i for i, (status, _) in enumerate(ended) if status == 0]
    assert ended[1 - flown][0] == 1, ended
    assert "another mission is being flown here by /world" in ended[1 - flown][1]
    name = ("one", "other")[flown]
    assert payloads(ros.folder / name)[0] == payloads(bag)[0]
    assert not (ros.folder / ("one", "other")[1 - flown]).exists()


# A player that does not check for other publishers, as those of other projects.
HEEDLESS = """
import sys
from uav_dc_ros import bag
from uav_dc_ros.nodes.play.playback_publisher import SubscriberMonitor
SubscriberMonitor.mission = lambda *_: None
sys.exit(bag.main())
"""


@pytest.mark.long
def test_a_player_that_comes_later_changes_nothing(ros: Ros, options: list[object], bag: Path) -> None:
    """The bag has another seed, so that every payload and, but for the first, every pose is another."""
    given = (*options, "--seed", 7, "--pace", "lockstep")
    status, output = ros.run_all(*given, "--bag", "seven", "--summary", "seven.json")
    assert status == 0, output
    paced = (*options, "--seed", 7, "--pace", 60, "--bag", "beside", "--summary", "beside.json")
    flight = ros.start("uav_dc_ros.run_all", *paced)
    assert flight.stdout is not None
    printed = wait_for(flight.stdout, "mission: step 0/30")
    player = ros.start_command(sys.executable, "-c", HEEDLESS, "play", bag, "--loop", "--rate", 2)
    status, output = finish(flight)
    stopped(player)
    assert status == 0, output
    assert "note: /player publishes " in output, output
    assert "mission: another_run: it belongs to run" in printed + output
    alone, beside = payloads(ros.folder / "seven")[0], payloads(ros.folder / "beside")[0]
    if "hovered" not in output:  # otherwise this machine was too busy to fly it as it was flown alone
        assert beside == alone
        told = [json.loads((ros.folder / f"{name}.json").read_text()) for name in ("seven", "beside")]
        assert told[1] == told[0] | {"bag": str(ros.folder / "beside")}
