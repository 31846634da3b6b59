"""The bridge's node: missions through real nodes over real DDS, beside a fake autopilot on real MAVLink.

The aircraft is what cannot exist here: see tests/support/fake_autopilot/autopilot.py for what its stand-in
    imitates.
"""

import itertools
import json
import os
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from tests.conftest import PATIENCE_S, Ros, finish, read_bag, wait_for
from tests.nodes.conftest import LOW_BATTERY_J
from tests.support.fake_autopilot.flight import Fake, fake
from uav_dc_ros import bag as bag_command
from uav_dc_ros import scenarios
from uav_dc_ros.agents import policy as policies
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.mobility import WalkingUsers
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.env.registration import ENV_ID
from uav_dc_ros.offboard.frames import Enu, Geodetic

STEPS = 7  # of the low world's missions
NODES = ("--nodes", "bridge,world,channel_monitor,policy,recorder")  # without the visualizer


def beside(autopilot: Fake, *options: object) -> tuple[object, ...]:
    # On a busy machine a policy may start again, or decide, later than the bridge usually waits for it.
    patient = ("--set", "bridge.policy_timeout_s=90")
    return "--vehicle", "mavlink", "--connect", autopilot.address, "--datum", "here", *patient, *options


def statuses(bag: Path) -> list[dict[str, Any]]:
    """The reports of the vehicle, in order."""
    with AnyReader([bag]) as reader:
        wanted = [connection for connection in reader.connections if connection.topic == "/mission"]
        texts = [reader.deserialize(data, one.msgtype).data for one, _, data in reader.messages(wanted)]
    return [json.loads(text) for text in texts]


def check_steps(bag: Path, steps: int = STEPS) -> None:
    """Each step was flown once, ended one cell further, and used the energy of the model."""
    reported = statuses(bag)
    moving = [status["step"] for status in reported if status["phase"] == "moving"]
    begun = [step for step, _ in itertools.groupby(moving)]
    assert begun == list(range(steps)), begun
    cells = {status["step"]: status["cell"] for status in reported}
    assert cells == {step: [step, 0, 0] for step in range(steps + 1)}
    used_j = {status["step"]: status["energy_used_j"] for status in reported}
    assert used_j == pytest.approx({step: step * used_j[1] for step in range(steps + 1)})
    assert 1500.0 < used_j[1] < 1700.0
    assert reported[-1]["state_of_charge"] == pytest.approx(1.0 - used_j[steps] / LOW_BATTERY_J)


def check_numbers(bag: list[tuple[str, Any]], datum: Geodetic, at_the_end: Enu) -> None:
    """The battery that the vehicle reports falls, and its last position on the Earth is that of the grid."""
    charges = [message.percentage for topic, message in bag if topic == "/battery"]
    assert len(charges) > 5
    assert 1.0 >= charges[0] >= charges[-1] >= 0.0
    fix = [message for topic, message in bag if topic == "/fix"][-1]
    expected = datum.at(at_the_end)
    assert fix.latitude == pytest.approx(expected.latitude_deg, abs=3e-5)  # three metres
    assert fix.longitude == pytest.approx(expected.longitude_deg, abs=5e-5)
    assert np.isnan(fix.altitude)


def killed(ros: Ros, node: str, run_all: subprocess.Popen[str]) -> float:
    """Kill a node; when."""
    pids = [pid for pid, command in ros.processes().items() if f"uav_dc_ros.nodes.{node} " in command]
    assert len(pids) == 1, (pids, run_all.poll(), finish(run_all)[1])
    os.kill(pids[0], signal.SIGKILL)
    return time.monotonic()


def until(condition: Callable[[], Any], process: subprocess.Popen[str], seconds: float = PATIENCE_S) -> None:
    end_s = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None, process.communicate()[0]
        assert time.monotonic() < end_s
        time.sleep(0.002)


def flies_east(autopilot: Fake, step: int) -> bool:
    """Has it been sent to the cell of a step."""
    return any(event["ned"][1] == pytest.approx(20.0 * step, abs=0.2) for event in autopilot.all("setpoint"))


# Whole missions.


def simulated_cells(scenario: Scenario, seed: int) -> list[list[int]]:
    """The cells of the same mission in the environment."""
    policy = policies.load(f"{scenario.name}_dueling")
    env = gymnasium.make(ENV_ID, scenario=scenario).unwrapped
    _, info = env.reset(seed=seed)
    cells, over = [info["cell"].tolist()], False
    while not over:
        seen = {name: info[name] for name in ("cell", "step", "data_bits", "collected")}
        _, _, terminated, truncated, info = env.step(policy.act(policy.observe(scenario, **seen)))
        over = terminated or truncated
        cells.append(info["cell"].tolist())
    return cells


@pytest.mark.parametrize(
    ("kind", "wire", "name", "least"),
    [
        ("ardupilot", "tcp", "three_clusters_hover", 25),
        pytest.param("px4", "udp", "five_clusters_hover", 40, marks=pytest.mark.long),
    ],
)
def test_a_whole_mission(ros: Ros, kind: str, wire: str, name: str, least: int) -> None:
    """It takes off, flies the cells of the simulation with that seed among the same users, and lands.

    Another aircraft is on the same link, and left alone.
    """
    scenario = scenarios.load(name)
    steps = scenario.mission.max_steps
    with fake(kind, wire, speed=200.0 if kind == "ardupilot" else 100.0) as autopilot:
        autopilot.do("second_vehicle 7")
        summary = ros.folder / "summary.json"
        given = ("--compose", "--scenario", name, "--seed", 3, "--bag", "bag", "--summary", summary)
        status, output = ros.run_all(*beside(autopilot, "--arm", "--system", 1, *given, *NODES))
        report = autopilot.report()
    assert not [event for event in autopilot.events if event["event"].startswith("second ")]
    assert status == 0, output
    assert "Traceback" not in output
    kept = json.loads(next((ros.folder / "state").rglob("*.json")).read_text())
    assert f"the grid's corner lies at {kept['datum']}, from the vehicle's position; no earlier" in output
    result = json.loads(summary.read_text())
    assert (result["outcome"], result["steps"], result["seed"]) == ("landed", steps, 3)
    assert result["reason"].startswith(f"step {steps}: at the dock")
    assert not report["armed"]
    dock = np.subtract(scenario.mission.dock_m, scenario.mission.start_m[:2])
    assert report["ned"][:2] == pytest.approx([dock[1], dock[0]], abs=2.0)  # north, east
    bag = read_bag(ros.folder / "bag")
    ready = {p["step"]: p["cell"] for t, p in bag if t == "/mission" and p["phase"] in ("ready", "landed")}
    assert [ready[step] for step in range(steps + 1)] == simulated_cells(scenario, 3)
    phases = [phase for phase, _ in itertools.groupby(p["phase"] for t, p in bag if t == "/mission")]
    assert phases[:5] == ["idle", "connecting", "preflight", "takeoff", "ready"]
    assert phases[5:-2] == ["moving", "ready"] * (steps - 1) + ["moving"]
    assert phases[-2:] == ["landing", "landed"]
    assert all(p["reason"] for t, p in bag if t == "/mission")
    check_numbers(bag, Geodetic.parse(kept["datum"]), Enu(*scenario.mission.dock_m, 0.0))
    crowd = WalkingUsers(scenario, 3)
    users = {p["step"]: p for t, p in bag if t == "/users"}
    assert users.keys() == set(range(steps + 1))
    for step in range(steps + 1):
        crowd.walk(step - crowd.step)
        assert np.array_equal(np.asarray([users[step]["x_m"], users[step]["y_m"]]).T, crowd.positions_m)
    rates = [p for t, p in bag if t == "/rates"]
    assert sorted({p["step"] for p in rates}) == list(range(steps + 1))
    assert sum(rates[-1]["collected"]) == result["users_collected"] >= least
    reported = [p for t, p in bag if t == "/mission"]
    changes = [
        pair.value
        for topic, message in bag
        if topic == "/diagnostics" and message.status[0].name == "bridge"
        for pair in message.status[0].values
        if pair.key.startswith("change ")
    ]
    of_mission = [f"{p['phase']}, step {p['step']}: {p['reason']}" for p in reported]
    assert changes == of_mission, "every change is in the diagnostics, too"


@pytest.mark.long
def test_a_pilot_arms_where_the_bridge_may_not(ros: Ros, low: tuple[object, ...]) -> None:
    with fake("ardupilot", speed=16.0) as autopilot:
        process = ros.start("uav_dc_ros.run_all", *low, *beside(autopilot, "--bag", "bag"))
        assert process.stdout is not None
        shown = wait_for(process.stdout, "waiting for a pilot")
        time.sleep(1.0)
        assert not [event for event in autopilot.all("command") if event["command"] in (176, 400, 22)]
        autopilot.do("mode", "GUIDED")
        autopilot.do("arm")
        status, output = finish(process)
    assert status == 0, shown + output
    check_steps(ros.folder / "bag")


@pytest.mark.long
def test_the_second_flight_has_the_grid_of_the_first(ros: Ros, low: tuple[object, ...]) -> None:
    """It begins at the dock, where the first one landed."""

    def fly(autopilot: Fake, datum: str) -> str:
        given = ("--connect", autopilot.address, "--arm", "--datum", datum, "--no-record")
        given = ("--vehicle", "mavlink", *given, "--set", "bridge.min_battery=0")
        status, output = ros.run_all(*low, *given)
        assert status == 0, output
        return output

    with fake("ardupilot", speed=8.0) as autopilot:
        fly(autopilot, "here")
        first = len(autopilot.all("setpoint"))
        assert "; 0.0 m east and 0.0 m north of that of the last flight (" in fly(autopilot, "last")
        second = [event["ned"] for event in autopilot.all("setpoint")[first:]]
        for step in range(STEPS + 1):
            assert any(ned[:2] == pytest.approx([0.0, 20.0 * step], abs=0.2) for ned in second), step
        assert autopilot.report()["ned"][:2] == pytest.approx([0.0, 20.0 * STEPS], abs=2.0)
        warned = "WARN: the grid's corner lies at "
        output = fly(autopilot, "here")
        assert warned in output
        assert re.search(
            r"; 1[34]\d\.\d m east and \d\.\d m (north|south) of that of the last flight", output
        )


@pytest.mark.long
def test_the_scenario_s_battery_ends_a_mission_and_not_the_aircraft_s(
    ros: Ros, low: tuple[object, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    """Seven steps east need less than it has, but this policy hovers: it is spent after six of seven."""
    path, policy = Path(str(low[1])), Path(str(low[3]))
    path.write_text(path.read_text().replace(str(LOW_BATTERY_J), "11600.0"))
    parameters = dict(policies.load(policy).parameters)
    parameters["advantage.bias"] = np.eye(7, dtype=np.float32)[Action.HOVER]
    own = policies.load(policy).config
    policies.save(ros.folder / "hovers", own, parameters, lambda _: "# test\n")
    options = ("--scenario", path, "--policy", ros.folder / "hovers")
    with fake("ardupilot", speed=16.0) as autopilot:
        given = ("--bag", "bag", "--summary", "summary.json")
        status, output = ros.run_all(*options, *beside(autopilot, "--arm", *given, *NODES))
        assert status == 0, output
        assert autopilot.report()["mode"] == "RTL"
    (result,) = [json.loads((ros.folder / "summary.json").read_text())]
    assert (result["outcome"], result["steps"]) == ("timeout", 6)
    assert "out of the scenario's battery away from the dock" in result["reason"]
    shown = [
        pair.value
        for topic, message in read_bag(ros.folder / "bag")
        if topic == "/diagnostics" and message.status[0].name == "bridge"
        for pair in message.status[0].values
        if pair.key == "battery by the model"
    ]
    assert (shown[0], shown[-1]) == ("100%", "13%")
    with pytest.raises(SystemExit) as exit:
        bag_command.main(["verify", str(ros.folder / "bag"), "--policy-dir", str(ros.folder / "hovers")])
    assert exit.value.code == 0, capsys.readouterr().out


# What dies.


@pytest.mark.parametrize("kind", ["ardupilot", pytest.param("px4", marks=pytest.mark.long)])
def test_a_killed_policy_makes_the_vehicle_hold_and_a_killed_bridge_takes_the_mission_up_again(
    ros: Ros, low: tuple[object, ...], kind: str
) -> None:
    """It flies on to its cell; the policy is started again, and the mission goes on.

    Without a bridge ArduCopter hovers; PX4 misses the stream, and returns: then the mission is over.
    """
    with fake(kind, speed=16.0) as autopilot:
        process = ros.start("uav_dc_ros.run_all", *low, *beside(autopilot, "--arm", "--bag", "bag", *NODES))
        until(lambda: flies_east(autopilot, 2), process)
        killed(ros, "policy", process)
        until(lambda: flies_east(autopilot, 4), process)
        armed = autopilot.n_arms  # more than one where an acknowledgement came late
        if kind == "px4":  # so that the bridge is not restarted before PX4 misses the stream
            process.send_signal(signal.SIGSTOP)
        killed(ros, "bridge", process)
        if kind == "px4":
            until(lambda: autopilot.report()["mode"] == "AUTO.RTL", process)
            process.send_signal(signal.SIGCONT)
        status, output = finish(process)
        assert autopilot.n_arms == armed >= 1, "the second bridge does not arm"
        assert not autopilot.report()["armed"]
    assert "node policy was killed by SIGKILL" in output
    assert "node bridge was killed by SIGKILL" in output
    assert output.count("it is restarted (1 of 3") == 2
    if kind == "ardupilot":
        assert status == 0, output
        check_steps(ros.folder / "bag")
        assert statuses(ros.folder / "bag")[-1]["phase"] == "landed"
    else:
        assert status == 1, output
        last = statuses(ros.folder / "bag")[-1]
        assert last["phase"] == "aborted"
        assert "AUTO.RTL" in last["reason"]


@pytest.mark.long
def test_a_killed_bridge_lands_where_that_is_wanted(ros: Ros, low: tuple[object, ...]) -> None:
    with fake("ardupilot", speed=8.0) as autopilot:
        options = beside(autopilot, "--arm", "--bag", "bag", "--set", "bridge.flying_at_start=land")
        process = ros.start("uav_dc_ros.run_all", *low, *options, "--set", "bridge.failsafe_action=land")
        until(lambda: flies_east(autopilot, 3), process)
        killed(ros, "bridge", process)
        status, output = finish(process)
        down = autopilot.report()["ned"]
    assert status == 1, output
    last = statuses(ros.folder / "bag")[-1]
    assert (last["phase"], last["reason"]) == ("aborted", "in the air when the bridge started")
    assert 20.0 < down[1] < 80.0, "not at home"


@pytest.mark.parametrize(
    ("number", "wanted"),
    [
        (signal.SIGINT, 130),
        pytest.param(signal.SIGKILL, -9, marks=pytest.mark.long),
    ],
)
def test_who_is_stopped_in_the_air_brings_the_vehicle_home(
    ros: Ros, low: tuple[object, ...], number: signal.Signals, wanted: int
) -> None:
    with fake("ardupilot", speed=16.0) as autopilot:
        options = beside(autopilot, "--arm", "--bag", "bag", "--summary", "summary.json", "--compose", *NODES)
        process = ros.start("uav_dc_ros.run_all", *low, *options)
        until(lambda: flies_east(autopilot, 2), process)
        process.send_signal(number)
        status, output = finish(process)
        assert status == wanted, output
        end_s = time.monotonic() + PATIENCE_S
        while (report := autopilot.report())["armed"]:
            assert time.monotonic() < end_s
            time.sleep(0.05)
        assert report["ned"][:2] == pytest.approx([0.0, 0.0], abs=1.0)
        assert report["mode"] == "RTL"
        if number != signal.SIGKILL:
            assert "aborted" in output
            assert statuses(ros.folder / "bag")[-1]["reason"] == "the bridge was stopped"
            result = json.loads((ros.folder / "summary.json").read_text())
            assert (result["outcome"], result["reason"]) == ("aborted", "the bridge was stopped")
        assert ros.gone()


@pytest.mark.long
def test_broken_moves_and_moves_out_of_turn_change_nothing(ros: Ros, low: tuple[object, ...]) -> None:
    broken = {
        '{"mission":0': "malformed",
        '{"mission":0,"step":0}': "invalid",
        '{"mission":1,"step":2,"action":"upward"}': "wrong_step",
        '{"mission":0,"step":99,"action":"upward"}': "not_now",
    }
    with fake("ardupilot", speed=4.0) as autopilot:
        process = ros.start("uav_dc_ros.run_all", *low, *beside(autopilot, "--arm", "--bag", "bag"))
        until(lambda: flies_east(autopilot, 1), process)
        probe, run = ros.stranger("probe"), ros.run_id()
        assert probe.stdin is not None
        for data in broken:
            command = {"topic": "move", "data": data.replace("{", f'{{"run":"{run}",'), "hearing": 2}
            probe.stdin.write((json.dumps(command) + "\n") * 5)
        probe.stdin.close()
        status, output = finish(process)
        probe.wait(90)
    assert status == 0, output
    assert "Traceback" not in output
    check_steps(ros.folder / "bag")
    for reason in broken.values():
        assert f"move {reason} 5" in output


@pytest.mark.long
def test_a_journal_that_cannot_be_written_stops_no_flight(ros: Ros, low: tuple[object, ...]) -> None:
    folder = ros.folder / "kept"
    folder.mkdir()
    with fake("ardupilot", speed=8.0) as autopilot:
        options = beside(autopilot, "--arm", "--bag", "bag", "--set", f"bridge.journal={folder / 'flight'}")
        process = ros.start("uav_dc_ros.run_all", *low, *options)
        until(lambda: flies_east(autopilot, 2), process)
        shutil.rmtree(folder)
        status, output = finish(process)
    assert status == 0, output
    assert output.count("a bridge that is restarted now cannot resume the mission: journal") == 1
    check_steps(ros.folder / "bag")


@pytest.mark.long
def test_a_pilot_who_takes_over_keeps_the_vehicle(ros: Ros, low: tuple[object, ...]) -> None:
    with fake("ardupilot", speed=8.0) as autopilot:
        process = ros.start("uav_dc_ros.run_all", *low, *beside(autopilot, "--arm", "--bag", "bag"))
        until(lambda: flies_east(autopilot, 2), process)
        autopilot.do("mode", "LOITER")
        n_sent = len(autopilot.all("command"))
        status, output = finish(process)
        assert status == 1, output
        assert len(autopilot.all("command")) == n_sent, "nothing more is sent to it"
        report = autopilot.report()
        assert (report["mode"], report["armed"]) == ("LOITER", True)
    last = statuses(ros.folder / "bag")[-1]
    assert last["phase"] == "aborted"
    assert "LOITER" in last["reason"]


@pytest.mark.long
def test_the_stream_keeps_its_pace_while_policies_load_and_die(ros: Ros, low: tuple[object, ...]) -> None:
    """20 Hz, measured where it arrives; 99 of 100 setpoints within 10 ms of their time."""
    with fake("ardupilot", "udp", speed=1.0, ready_s=1.0) as autopilot:
        given = (*low, *beside(autopilot, "--arm", "--no-record"))
        process = ros.start("uav_dc_ros.run_all", *given)
        until(lambda: flies_east(autopilot, 1), process)
        autopilot.do("times")
        for _ in range(3):
            killed(ros, "policy", process)
            time.sleep(4.0)  # it is found dead, started again, loads, and decides
        times = autopilot.report()["times"]
        process.send_signal(signal.SIGINT)
        finish(process)
    beats = [times[0]]
    for time_s in times:
        if time_s - beats[-1] > 0.04:  # another goal goes out at once, between the beats
            beats.append(time_s)
    gaps_ms = np.diff(beats) * 1e3
    assert len(gaps_ms) > 200
    off_ms = np.percentile(np.abs(gaps_ms - 50.0), 99)
    assert off_ms < 10.0, np.sort(gaps_ms)[-5:]
