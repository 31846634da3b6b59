"""Missions over a bad network: the world flies on one host, policy and recorder are on another.

What must hold however bad the link is: every step is flown once, in lockstep exactly as on a good network;
at a pace the vehicle hovers while no move comes, and goes on when moves come again.
"""

import dataclasses
import itertools
import json
import re
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import uav_dc_ros
from tests.conftest import PATIENCE_S, Ros, but_run, finish, read_bag
from tests.nodes.conftest import Alone
from tests.nodes.link import Carried, Link, unavailable
from uav_dc_ros import scenarios
from uav_dc_ros.core.grid import Action

pytestmark = pytest.mark.skipif(unavailable() is not None, reason=f"no link: {unavailable()}")

STEPS = 30
# What a mission is. The other topics tell of it, and of the nodes, a few times a second.
RECORDED = ["users", "rates", "mission", "move", "pose", "target"]
LOSS = {"loss": 0.2}
DELAY = {"delay_s": 0.1, "jitter_s": 0.02}


@dataclass
class Mission:
    """What a mission consists of, and how it went undisturbed."""

    scenario: Path
    policy: Path
    undisturbed: dict[str, list[Any]] = field(default_factory=dict)


@dataclass
class Flown:
    """What was heard of a mission: its states beside the world, everything else in the bag."""

    said: list[dict[str, Any]]
    bag: list[tuple[str, Any]]
    output: dict[str, str]
    counts: dict[str, Carried]

    def hovered(self) -> int:
        """Steps for which no move came in time, as the world tells."""
        told = re.search(r"(\d+) steps were hovered", self.output["world"])
        return int(told[1]) if told else 0


@pytest.fixture(scope="module")
def mission(alone: Alone) -> Mission:
    """A small mission, as it was flown on a good network: the first of several."""
    messages = read_bag(alone.bag)
    last = {topic: STEPS if topic == "move" else STEPS + 1 for topic in RECORDED}
    undisturbed = {topic: steps(messages, topic)[: last[topic]] for topic in RECORDED}
    return Mission(alone.scenario, alone.policy, undisturbed)


def start(
    ros: Ros, link: Link, host: str, nodes: dict[str, dict[str, object]]
) -> dict[str, subprocess.Popen[str]]:
    """Start one host's share of the nodes, given with their parameters."""
    profiles = str(Path(uav_dc_ros.__file__).parent / "nodes" / "ros" / "fastdds.xml")
    environment = ros.environment | {
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET",
        "FASTRTPS_DEFAULT_PROFILES_FILE": profiles,
        # The two hosts share this machine's memory; real ones would not.
        "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
    }
    started = {}
    for name, parameters in nodes.items():
        given = [f"{key}:={json.dumps(value)}" for key, value in parameters.items()]
        arguments = [argument for text in given for argument in ("-p", text)]
        started[name] = subprocess.Popen(
            link.command(host, [sys.executable, "-m", f"uav_dc_ros.nodes.{name}", "--ros-args", *arguments]),
            env=environment,
            cwd=ros.folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
    return started


class Listener:
    """Hears `mission` on the world's own host, where nothing is lost."""

    def __init__(self, ros: Ros, link: Link) -> None:
        self.said: list[dict[str, Any]] = []
        self._news = threading.Condition()
        self._process = subprocess.Popen(
            link.command("a", [sys.executable, Path(__file__).with_name("probe.py"), "/mission"]),
            env=ros.environment
            | {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET", "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            with self._news:
                self.said.append(json.loads(json.loads(line)["data"]))
                self._news.notify()

    def wait_for(self, step: int) -> None:
        """Wait until the world has come to a step."""
        with self._news:
            came = self._news.wait_for(lambda: self.said and self.said[-1]["step"] >= step, PATIENCE_S)
        assert came, f"step {step} never came; heard of {[said['step'] for said in self.said]}"

    def stop(self) -> None:
        """End it."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        self._process.wait(PATIENCE_S)
        self._reader.join(PATIENCE_S)
        self._process.stdout.close()


def fly(
    ros: Ros,
    mission: Mission,
    *,
    pace: object = "lockstep",
    bad: dict[str, float] | None = None,
    from_the_start: bool = False,
    cut_s: float = 0.0,
) -> Flown:
    """Fly a mission on two hosts; the link turns bad before it, and is cut at step 5, if it lasts so long."""
    bag = ros.folder / "bag"
    nodes = ["world", "channel_monitor", "policy", "recorder"]
    shared = {"scenario": str(mission.scenario), "peers": nodes}
    policy = {"policy": str(mission.policy)}
    bad = bad or {}
    started: dict[str, subprocess.Popen[str]] = {}
    output: dict[str, str] = {}
    with Link(seed=1, **bad if from_the_start else {}) as link:
        listener = Listener(ros, link)
        try:
            started |= start(ros, link, "b", {"recorder": shared | policy | {"bag": str(bag)}})
            started |= start(ros, link, "b", {"policy": shared | policy})
            started |= start(ros, link, "a", {"channel_monitor": shared})
            link.set(**bad)  # before the world starts: its lockstep may take less time than this
            started |= start(ros, link, "a", {"world": shared | {"pace": str(pace)}})
            listener.wait_for(0)
            if cut_s:
                listener.wait_for(5)
                link.partition()
                time.sleep(cut_s)
                link.heal()
            listener.wait_for(STEPS)
            # How much of the very last steps still gets through to a node that is asked to stop, is not
            # the question here.
            counts = link.statistics()
            link.set(loss=0.0, jitter_s=0.0, delay_s=0.0)
            time.sleep(1.0)
            for name in nodes:
                started[name].terminate()
                status, output[name] = finish(started[name])
                assert status == 0, output[name]
                assert "Traceback" not in output[name]
        finally:
            for process in started.values():
                if process.poll() is None:
                    process.kill()
                    finish(process)
            listener.stop()
    return Flown(listener.said, read_bag(bag), output, counts)


def steps(messages: list[tuple[str, Any]], topic: str) -> list[Any]:
    """What a topic said of each step, repetitions left out: they must not differ, nor come late."""
    told: list[Any] = []
    for name, message in messages:
        if name != f"/{topic}":
            continue
        values = but_run(message) if isinstance(message, dict) else dataclasses.asdict(message)
        if values not in told[-1:]:
            told.append(values)
    return told


def check_every_step_was_flown_once(flown: Flown) -> None:
    said = steps([("/mission", said) for said in flown.said], "mission")
    assert [m["step"] for m in said] == list(range(STEPS + 1))
    assert [m["phase"] for m in said] == ["ready"] * STEPS + ["timeout"]
    assert steps(flown.bag, "mission") == said


def check_it_was_flown_as_undisturbed(flown: Flown, mission: Mission, but: tuple[str, ...] = ()) -> None:
    check_every_step_was_flown_once(flown)
    for topic in [topic for topic in RECORDED if topic not in but]:
        assert steps(flown.bag, topic) == mission.undisturbed[topic], topic


def check_each_step_was_a_move_or_hovered(flown: Flown, mission: Mission) -> None:
    """Users walk as at any pace; the vehicle flew what the policy said for that very step, or hovered."""
    check_every_step_was_flown_once(flown)
    assert steps(flown.bag, "users") == mission.undisturbed["users"]
    assert [r["step"] for r in steps(flown.bag, "rates")] == list(range(STEPS + 1))
    grid = scenarios.load(mission.scenario).grid
    moves = {m["step"]: Action[m["action"].upper()] for m in steps(flown.bag, "move")}
    said = steps(flown.bag, "mission")
    other = 0
    for before, after in itertools.pairwise(said):
        action = moves.get(before["step"], Action.HOVER)
        if after["cell"] != grid.move(np.asarray(before["cell"]), np.asarray(int(action))).tolist():
            assert after["cell"] == before["cell"]
            other += 1
    assert other <= flown.hovered()


def check_it_was_lossy(flown: Flown) -> None:
    for counts in flown.counts.values():
        assert 0.1 <= counts.lost / (counts.lost + counts.carried) <= 0.3


@pytest.mark.long
def test_two_hosts_and_a_good_link(ros: Ros, mission: Mission) -> None:
    flown = fly(ros, mission)
    check_it_was_flown_as_undisturbed(flown, mission)
    assert all(counts.carried > STEPS and counts.lost == counts.cut == 0 for counts in flown.counts.values())


@pytest.mark.long
def test_lockstep_with_loss(ros: Ros, mission: Mission) -> None:
    flown = fly(ros, mission, bad=LOSS)
    check_it_was_flown_as_undisturbed(flown, mission)
    assert sum(counts.lost for counts in flown.counts.values()) > STEPS


def test_run_all_on_two_hosts_with_loss(ros: Ros, mission: Mission) -> None:
    """As its users do it: the hosts' shares with `--nodes`, each ending by itself."""
    ros.environment["FASTDDS_BUILTIN_TRANSPORTS"] = "UDPv4"
    del ros.environment["ROS_AUTOMATIC_DISCOVERY_RANGE"]  # run_all knows that there are other hosts
    given = ["--scenario", mission.scenario, "--policy", mission.policy, "--pace", "lockstep"]
    run_all = [sys.executable, "-m", "uav_dc_ros.run_all", *map(str, given)]
    shares = {"a": ["--nodes", "world,channel_monitor"], "b": ["--nodes", "policy,recorder", "--bag", "bag"]}
    with Link(seed=1, **LOSS) as link:
        flights = [
            subprocess.Popen(
                link.command(host, [*run_all, *share]),
                env=ros.environment,
                cwd=ros.folder,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
            )
            for host, share in shares.items()
        ]
        for flight in flights:
            status, output = finish(flight, PATIENCE_S)
            assert status == 0, output
        assert sum(counts.lost for counts in link.statistics().values()) > STEPS
    bag = read_bag(ros.folder / "bag")
    for topic in RECORDED:
        assert steps(bag, topic) == mission.undisturbed[topic], topic


@pytest.mark.long
def test_lockstep_with_delay(ros: Ros, mission: Mission) -> None:
    begun_s = time.monotonic()
    check_it_was_flown_as_undisturbed(fly(ros, mission, bad=DELAY), mission)
    assert time.monotonic() - begun_s > STEPS * 2 * (DELAY["delay_s"] - DELAY["jitter_s"])


@pytest.mark.long
def test_lockstep_with_a_partition(ros: Ros, mission: Mission) -> None:
    flown = fly(ros, mission, bad={"delay_s": 0.02}, cut_s=3.0)
    check_it_was_flown_as_undisturbed(flown, mission)
    assert all(counts.cut > 0 for counts in flown.counts.values())


@pytest.mark.long
def test_a_pace_with_delay(ros: Ros, mission: Mission) -> None:
    """Steps of a third of a second: there and back takes a fifth."""
    flown = fly(ros, mission, pace=30, bad=DELAY)
    check_each_step_was_a_move_or_hovered(flown, mission)
    assert flown.hovered() < STEPS / 2


@pytest.mark.long
def test_a_pace_with_a_partition(ros: Ros, mission: Mission) -> None:
    """Steps of a fifth of a second, cut at step 5 for ten of them: it hovered, and flew afterwards."""
    flown = fly(ros, mission, pace=50, bad={"delay_s": 0.02}, cut_s=2.0)
    check_each_step_was_a_move_or_hovered(flown, mission)
    cells = {said["step"]: said["cell"] for said in flown.said}
    assert all(cells[step] == cells[6] for step in range(6, 14))
    assert 8 <= flown.hovered() < STEPS - 6


@pytest.mark.long
@pytest.mark.parametrize("bad", [LOSS, LOSS | DELAY], ids=["loss", "loss and delay"])
def test_lockstep_with_loss_from_the_start(ros: Ros, mission: Mission, bad: dict[str, float]) -> None:
    """The nodes must even find each other through it."""
    flown = fly(ros, mission, bad=bad, from_the_start=True)
    check_it_was_flown_as_undisturbed(flown, mission)
    check_it_was_lossy(flown)


@pytest.mark.long
def test_lockstep_with_loss_and_a_partition_of_ten_seconds(ros: Ros, mission: Mission) -> None:
    check_it_was_flown_as_undisturbed(fly(ros, mission, bad=LOSS | DELAY, cut_s=10.0), mission)


@pytest.mark.long
def test_lockstep_with_a_partition_after_which_the_hosts_have_forgotten_each_other(
    ros: Ros, mission: Mission
) -> None:
    """Fast DDS forgets a participant that was silent for twenty seconds.

    When it finds it again, latched topics are told again; of the others, what was on its way is lost.
    """
    flown = fly(ros, mission, bad={"delay_s": 0.02}, cut_s=30.0)
    check_it_was_flown_as_undisturbed(flown, mission, but=("pose",))  # which is not latched


@pytest.mark.long
def test_a_pace_with_loss(ros: Ros, mission: Mission) -> None:
    flown = fly(ros, mission, pace=10, bad=LOSS)
    check_each_step_was_a_move_or_hovered(flown, mission)
    check_it_was_lossy(flown)
    assert flown.hovered() < STEPS / 2


@pytest.mark.long
def test_a_pace_with_a_partition_of_ten_seconds(ros: Ros, mission: Mission) -> None:
    """Steps of half a second: cut at step 5 for twenty of thirty steps."""
    flown = fly(ros, mission, pace=20, bad=DELAY, cut_s=10.0)
    check_each_step_was_a_move_or_hovered(flown, mission)
    cells = {said["step"]: said["cell"] for said in flown.said}
    assert all(cells[step] == cells[6] for step in range(6, 24))
    assert 18 <= flown.hovered() < STEPS - 5
