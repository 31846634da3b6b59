"""run_all's options: a mistake is one clear line, status 2, and nothing written."""

import os
import shutil
import signal
from datetime import datetime, tzinfo
from pathlib import Path

import pytest

from tests.conftest import WITHOUT_VISUALIZER, Ros
from uav_dc_ros import cli
from uav_dc_ros.runner import run_options


def refused(ros: Ros, *arguments: object) -> str:
    """Run run_all with options that cannot be flown; the one line it must print."""
    before = sorted(ros.folder.rglob("*"))
    status, output = ros.run_fork("uav_dc_ros.run_all", *arguments)
    assert status == 2, output
    assert "Traceback" not in output
    assert sorted(path for path in ros.folder.rglob("*") if path.name != "log") == before
    assert output.startswith("python -m uav_dc_ros.run_all: ")
    assert len(output.splitlines()) == 1, output
    return output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ("--scenario", "mars"),
            "scenario 'mars': no such name or file; expected one of farm, five_clusters, ",
        ),
        (
            ("--policy", "nobody"),
            "policy 'nobody': no such name or folder; expected one of farm_dueling, five_clusters_",
        ),
        (("--policy", "three_clusters_dueling"), "clusters is 5; expected 3"),
        (("--seed", "-1"), "argument --seed: '-1'; expected a whole number of at least 0"),
        (("--seed", "x"), "argument --seed: 'x'; expected a whole number"),
        (("--seed", "1_0"), "argument --seed: '1_0'; expected a whole number"),
        (("--seed", "\u0663"), "argument --seed: '\u0663'; expected a whole number"),
        (("--missions", "0"), "argument --missions: '0'; expected a whole number of at least 1"),
        (("--system", "256"), "argument --system: '256'; expected a MAVLink system number from 1 to 255"),
        (("--system", "7"), "--system: expected --vehicle mavlink with it"),
        (("--datum", "here"), "--datum: expected --vehicle mavlink, mavros, px4 with it"),
        (("--pace", "0"), "argument --pace: '0'; expected 'lockstep' or a number above 0"),
        (("--pace", "1e6"), "pace: 1e+06; expected at most 3560, which makes steps of 5 ms, or 'lockstep'"),
        (
            ("--missions", "3000000"),
            "missions: 3000000 of 46 steps of 17.8 s are 2.5098e+09 s; expected less than",
        ),
        (("--bag", "/dev/null/bag"), "--bag /dev/null/bag: /dev/null is not a folder that can be written"),
        (
            ("--bag", os.fsdecode(b"\xff")),
            "\\udcff: a ROS parameter cannot hold this path; expected one in UTF-8",
        ),
        (("--bag", "x", "--summary", "x"), "--summary x: it is the folder of the bag; expected another path"),
        (("--pace", "nan"), "argument --pace: 'nan'; expected 'lockstep' or a number above 0"),
        (("--pace", "1_0"), "argument --pace: '1_0'; expected 'lockstep' or a number above 0"),
        (("--pace", "fast"), "argument --pace: 'fast'; expected 'lockstep' or a number above 0"),
        (("--no-record", "--bag", "b"), "not allowed with argument"),
        (
            ("--summary", "nowhere/s.json"),
            "--summary nowhere/s.json cannot be written: No such file or directory; expected a file in an",
        ),
        (("--summary", "."), "--summary . cannot be written: Is a directory; expected a file in an existing"),
        (("--summary", "/dev/fd/99"), "--summary /dev/fd/99 cannot be written: Bad file descriptor"),
        (("--sead", "1"), "unrecognized arguments: --sead"),
        (
            ("--objective", "1.1"),
            "argument --objective: '1.1'; expected a weight between 0 (time only)",
        ),
        (
            ("--objective", "0.5"),
            "the moves of 'five_clusters_dueling' do not depend on it; expected it",
        ),
        (
            ("--policy", "search", "--search", "8"),
            "search 8: 'search' is a planner; expected it with a policy only",
        ),
        (("--scenario", "random:"), "scenario 'random:': no such name or file; expected one of "),
        (
            ("--policy", "search", "--set", "policy.objective_weight=0.5"),
            "--set policy.objective_weight=0.5: expected --objective, which sets it for all nodes",
        ),
    ],
)
def test_an_option_that_cannot_be_flown(ros: Ros, arguments: tuple[str, ...], message: str) -> None:
    assert message in refused(ros, *arguments)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("v_max_mps", "v_max", "users.v_max = 1.0; did you mean 'v_max_mps'?"),
        ("step_s = 10.0", 'step_s = "10"', "mission.step_s = '10'; expected float, got str"),
        ("max_steps = 30", "max_steps = -30", "mission.max_steps = -30; expected int >= 1"),
    ],
)
def test_a_scenario_file_with_a_slip(
    ros: Ros, small_scenario: Path, small_policy: Path, old: str, new: str, message: str
) -> None:
    small_scenario.write_text(small_scenario.read_text().replace(old, new))
    line = refused(ros, "--scenario", small_scenario, "--policy", small_policy)
    assert message in line
    assert str(small_scenario) in line


def test_a_user_s_scenario_without_a_policy_asks_for_one(ros: Ros, small_scenario: Path) -> None:
    assert "policy 'small_dueling': no such name or folder" in refused(ros, "--scenario", small_scenario)


def test_a_truncated_model(ros: Ros, small_scenario: Path, small_policy: Path) -> None:
    model = small_policy / "model.safetensors"
    model.write_bytes(model.read_bytes()[:-100])
    line = refused(ros, "--scenario", small_scenario, "--policy", small_policy)
    assert str(model) in line
    assert "damaged" in line


def test_an_existing_bag_folder(ros: Ros) -> None:
    bag = ros.folder / "bag"
    bag.mkdir()
    assert f"--bag {bag}: it exists already" in refused(ros, "--bag", bag)


def test_the_end_of_a_terminal_is_a_stop_unless_it_is_ignored(monkeypatch: pytest.MonkeyPatch) -> None:
    handled: list[int] = []
    monkeypatch.setattr(signal, "signal", lambda number, handler: handled.append(number))
    for before, expected in ((signal.SIG_DFL, [2, 15, 1]), (signal.SIG_IGN, [2, 15])):  # a background job's
        monkeypatch.setattr(signal, "getsignal", lambda number, before=before: before)
        cli.on_stop(print)
        assert handled == expected, before
        handled.clear()


def test_a_machine_without_ros(ros: Ros) -> None:
    """None in sys.modules is how Python itself marks a module as not there."""
    blocked = ros.folder / "blocked"
    blocked.mkdir()
    (blocked / "sitecustomize.py").write_text("import sys\nsys.modules['rclpy'] = None\n")
    ros.environment["PYTHONPATH"] = f"{blocked}:{ros.environment['PYTHONPATH']}"
    for module in ("run_all", "nodes.world"):
        status, output = ros.run(f"uav_dc_ros.{module}")
        assert status == 2
        assert "ROS 2 is missing: no module rclpy." in output
        assert "pip install 'uav_dc_ros[ros]'" in output
        assert len(output.splitlines()) == 1


def test_a_domain_that_does_not_exist(ros: Ros) -> None:
    for domain in ("abc", "300"):
        ros.environment["ROS_DOMAIN_ID"] = domain
        assert f"ROS_DOMAIN_ID is '{domain}'; expected a whole number from 0 to 232" in refused(ros)


def test_help_and_version_need_no_ros(ros: Ros) -> None:
    status, output = ros.run_all("--help")
    assert status == 0
    for option in ("scenario", "policy", "seed", "missions", "pace", "bag", "no-record", "summary"):
        assert f"--{option}" in output
    assert ros.run_all("--version")[0] == 0


def test_the_default_bag_is_dated(ros: Ros, small_scenario: Path, small_policy: Path) -> None:
    """A policy's folder may lie anywhere; a note reports that it was trained in another world."""
    folder = ros.folder / "a b 'c'" / "my policy"
    shutil.copytree(small_policy, folder)
    small_scenario.write_text(small_scenario.read_text().replace("v_max_mps = 1.0", "v_max_mps = 2.0"))
    given = ("--scenario", small_scenario, "--policy", folder, "--pace", "lockstep")
    status, output = ros.run_all(*given, *WITHOUT_VISUALIZER)
    assert status == 0, output
    assert "timeout" in output
    assert "note: policy untrained was trained in another world" in output
    (bag,) = (ros.folder / "bags").iterdir()
    assert bag.name.startswith("20")
    assert (bag / "metadata.yaml").is_file()


def test_no_bag_is_overwritten_by_another_of_the_same_second(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    class Still(datetime):
        @classmethod
        def now(cls, tz: tzinfo | None = None) -> "Still":
            return cls(2026, 11, 22, 3, 52, 10, tzinfo=tz)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(run_options, "datetime", Still)
    for name in ("2026-11-22_03-52-10", "2026-11-22_03-52-10_2", "2026-11-22_03-52-10_3"):
        bag = run_options.new_bag(None)
        assert bag == tmp_path / "bags" / name
        bag.mkdir(parents=True, exist_ok=True)
