"""The companion guide's commands, parameters, figures and units are those of the code."""

import argparse
import configparser
import itertools
import json
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import PATIENCE_S
from tests.doc_commands import parameter, parsed
from uav_dc_ros import files, run_all, scenarios
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.nodes.framework.node_table import NODES
from uav_dc_ros.nodes.ros import liveliness
from uav_dc_ros.offboard import datums, setpoint_stream
from uav_dc_ros.offboard.mavlink import systems
from uav_dc_ros.offboard.mavlink.connection import Address
from uav_dc_ros.offboard.mission import geofence
from uav_dc_ros.offboard.mission.fault_detector import SafetySettings
from uav_dc_ros.runner import run_options, supervisor

ROOT = Path(__file__).parents[1]
GUIDE = (ROOT / "docs" / "companion.md").read_text("utf-8")
UNITS = sorted((ROOT / "docs" / "systemd").glob("*.service"))
THERE = "/opt/uav_dc_ros/"  # where the units have the checkout
OWN = {"my_field.toml", "policies/my_field", "bags/B"}  # what the reader makes

# Of systemd.unit(5), systemd.service(5), systemd.exec(5), systemd.kill(5) and systemd.resource-control(5).
KEYS = {
    "Unit": {"Description", "After", "StartLimitIntervalSec", "StartLimitBurst"},
    "Service": {
        *("Type", "User", "SupplementaryGroups", "WorkingDirectory", "Environment", "ExecStart", "Restart"),
        *("RestartSec", "RestartPreventExitStatus", "KillMode", "KillSignal", "TimeoutStopSec", "Nice"),
        *("SuccessExitStatus", "OOMScoreAdjust", "StateDirectory", "LogsDirectory", "DevicePolicy"),
        *("DeviceAllow", "ProtectSystem", "ProtectHome", "PrivateTmp", "ProtectKernelTunables"),
        *("ProtectKernelModules", "ProtectControlGroups", "RestrictAddressFamilies", "RestrictNamespaces"),
        *("RestrictSUIDSGID", "LockPersonality", "NoNewPrivileges", "CapabilityBoundingSet"),
        *("SystemCallArchitectures", "LimitRTPRIO"),
    },
}


def unit(path: Path) -> dict[str, dict[str, list[str]]]:
    """A unit file: the values of each key of each section."""
    sections: dict[str, dict[str, list[str]]] = {}
    for line in path.read_text("utf-8").splitlines():
        if header := re.fullmatch(r"\[(\w+)\]", line):
            section = sections.setdefault(header[1], {})
        elif line and not line.startswith("#"):
            key, equals, value = line.partition("=")
            assert equals, f"{path.name}: {line}"
            section.setdefault(key, []).append(value)
    return sections


def commands() -> Iterator[list[str]]:
    """Each command line of this project in the guide and in the units, without the interpreter."""
    blocks = re.findall(r"^```sh\n(.*?)^```", GUIDE, re.MULTILINE | re.DOTALL)
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    lines += re.findall(r"`(python -m uav_dc_ros[^`]*)`", GUIDE)
    for path in UNITS:
        (started,) = unit(path)["Service"]["ExecStart"]
        shell, flag, script = shlex.split(started)
        assert (shell, flag) == ("/bin/bash", "-c")
        lines.append(
            script.partition(f"exec {THERE}.venv/bin/")[2].replace("%S", "/state").replace("%i", "f1")
        )
    for line in lines:
        words = shlex.split(line, comments=True)
        if words[:2] == ["python", "-m"]:
            yield words[2:]


COMMANDS = list(commands())
RUNS = [words[1:] for words in COMMANDS if words[0] == "uav_dc_ros.run_all"]
NODES_ALONE = [words for words in COMMANDS if words[0].startswith("uav_dc_ros.nodes.")]


def test_the_guide_has_commands_of_every_kind() -> None:
    modules = [words[0].removeprefix("uav_dc_ros.") for words in COMMANDS]
    assert {"run_all", "train", "evaluate", "bag", "nodes.bridge"} == set(modules)
    assert {vehicle for run in RUNS for vehicle in ("mavlink", "mavros", "px4") if vehicle in run} == {
        *("mavlink", "mavros", "px4")
    }


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_every_command_parses(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    if words in NODES_ALONE:
        assert (ROOT / Path(*words[0].split("."))).with_suffix(".py").is_file()
        assert words[1] == "--ros-args"
        assert words[2::2] == ["-p"] * len(words[2::2])
        for assignment in words[3::2]:
            parameter(words[0].removeprefix("uav_dc_ros.nodes."), assignment)
    else:
        parsed(monkeypatch, words)


def test_a_wrong_command_would_be_found(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SystemExit):
        parsed(monkeypatch, ["uav_dc_ros.run_all", "--vehicel", "mavlink"])
    with pytest.raises(KeyError):
        parameter("bridge", "conect:=tcp:127.0.0.1:5760")


@pytest.mark.parametrize("words", RUNS, ids=" ".join)
def test_run_all_would_start_what_the_guide_says(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = parsed(monkeypatch, ["uav_dc_ros.run_all", *words])
    started = run_options.nodes(run_all._config(argparse.Namespace(**vars(wanted))))
    real = wanted.vehicle != "simulated"
    assert ("bridge" in started) == (real and wanted.nodes is None)
    assert wanted.datum is not None or not wanted.arm, "who arms says where the grid lies"
    if wanted.vehicle == "mavlink" and "bridge" in started:
        Address.parse(wanted.connect)
    else:
        assert wanted.connect is None


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_every_scenario_and_policy_exists(words: list[str]) -> None:
    told = [word.partition(":=")[2] if word.startswith("scenario:=") else "" for word in words]
    told += [word for option, word in itertools.pairwise(words) if option == "--scenario"]
    for name in filter(None, told):
        if name not in OWN:
            scenarios.load(ROOT / name.removeprefix(THERE))
    for option, word in itertools.pairwise(words):
        if option == "--policy" and word not in OWN:
            assert (files.shipped_folder("policies") / word / "config.json").is_file()


def test_every_link_leads_somewhere() -> None:
    links = re.findall(r"\]\(([^)]+)\)", GUIDE)
    assert len(links) >= 4
    for link in links:
        assert (ROOT / "docs" / link.partition("#")[0]).exists(), link


def test_the_table_of_parameters_is_the_bridge_s() -> None:
    section = GUIDE.partition("| parameter | default | | parameter | default |")[2].partition("\n\n")[0]
    told = dict(re.findall(r"\| `(\w+)` \| ([^ |]+)", section))
    rows = {row.name: row.default for row in NODES["bridge"].parameters}
    expected = {name: str(default).lower() for name, default in rows.items()}
    for name in ("vehicle", "connect", "system", "datum", "scenario", "seed", "journal", "arm"):
        del expected[name]  # told of elsewhere: options of run_all
    assert told == expected


def test_every_parameter_in_the_text_is_the_bridge_s() -> None:
    known = {row.name for row in NODES["bridge"].parameters}
    elsewhere = {"start_m", "step_s", "max_steps"}  # of a scenario
    scenario: Scenario = scenarios.load(ROOT / "docs" / "field.toml")
    assert all(hasattr(scenario.mission, name) for name in elsewhere)
    told = set(re.findall(r"`([a-z]+(?:_[a-z]+)*_(?:s|m|mps|steps|battery|start|tries))`", GUIDE))
    assert len(told) >= 14
    assert told <= known | elsewhere
    for node, name, value in re.findall(r"--set (\w+)\.([a-z_]+)=(\w+)`", GUIDE):
        parameter(node, f"{name}:={value}")


def test_the_numbers_in_the_text_are_the_code_s() -> None:
    assert f"system {systems.SYSTEM}, component {systems.COMPONENT}" in GUIDE
    assert setpoint_stream.STREAM_S == 1 / 20
    assert (setpoint_stream.HEARTBEAT_S, setpoint_stream.STREAM_TIMEOUT_S) == (1.0, 1.0)
    assert "streams the setpoint 20 times a second" in GUIDE
    assert "end a second after its last decision" in GUIDE
    assert geofence.MARGIN_M == 20.0
    assert "The fence is the grid with 20 m around it and above its top layer" in GUIDE
    assert SafetySettings().max_return_attempts == 3
    assert "refuses to return three times" in GUIDE.replace("\n", " ")
    assert NODES["policy"].max_restarts == 3
    assert supervisor.RESTART_WINDOW_S == 60
    assert "three times within a minute" in GUIDE
    assert liveliness.MISSED_S + liveliness.CONFIRMED_S < 2.0
    assert "stops where it is, within two seconds" in GUIDE
    assert datums.MOVED_M == 5.0
    assert "as a warning from 5 m on" in GUIDE


def test_the_field_is_five_clusters_hover_at_a_fifth() -> None:
    field, paper = scenarios.load(ROOT / "docs" / "field.toml"), scenarios.load("five_clusters_hover")
    fifth = 0.2
    small, large = values_of(field), values_of(paper)
    lengths = {
        *("grid.cell_m", "grid.altitude_min_m", "grid.altitude_step_m", "users.cluster_centres_m"),
        *("users.cluster_radius_m", "users.v_max_mps", "mission.start_m", "mission.dock_m"),
        "mission.d_cons_m",
    }
    assert lengths <= small.keys()
    for key, value in large.items():
        if key in lengths:
            assert small[key] == pytest.approx([fifth * one for one in value]), key
        else:
            assert small[key] == value, key


def values_of(scenario: Scenario) -> dict[str, list[Any]]:
    """Every value of a scenario but its name, as flat lists."""
    values: dict[str, list[Any]] = {}
    for section in ("grid", "users", "mission", "radio", "reward"):
        part = getattr(scenario, section)
        for name in part.__struct_fields__:
            values[f"{section}.{name}"] = list(flat(getattr(part, name)))
    return values


def flat(value: Any) -> Iterator[Any]:
    """The numbers and texts in nested sequences."""
    if isinstance(value, tuple | list):
        for one in value:
            yield from flat(one)
    else:
        yield value


def test_the_figure_of_the_field_is_what_its_command_prints(tmp_path: Path) -> None:
    (words,) = [words for words in COMMANDS if words[0].endswith("evaluate") and "docs/field.toml" in words]
    told = re.search(
        r"seeds 0 to (\d+)\s+`(\w+)`\s+lands\s+in\s+all\s+and\s+collects\s+([\d.]+)\s+of\s+50", GUIDE
    )
    assert told is not None
    summary = tmp_path / "summary.json"
    command = [sys.executable, "-m", *words, "--json", str(summary)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert done.returncode == 0, done.stderr
    seeds = words[words.index("--seeds") + 1]
    assert int(told[1]) == int(seeds) - 1
    flown = {one["policy"]: one for one in json.loads(summary.read_text("utf-8"))["evaluations"]}[told[2]]
    assert flown["landing_rate"]["mean"] == 1
    assert f"{flown['users_collected']['mean']:.1f}" == told[3]


@pytest.mark.parametrize("path", UNITS, ids=lambda path: path.name)
def test_a_unit_has_only_keys_that_systemd_knows(path: Path) -> None:
    found = unit(path)
    assert {name: set(keys) - KEYS[name] for name, keys in found.items()} == {name: set() for name in found}
    strict = configparser.ConfigParser(strict=False, interpolation=None, delimiters="=")
    strict.read_string(path.read_text("utf-8"))
    assert set(strict.sections()) == {"Unit", "Service"}


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd is not installed here")
def test_systemd_has_nothing_to_say_against_the_units(tmp_path: Path) -> None:
    for path in UNITS:
        text = path.read_text("utf-8")
        (tmp_path / path.name).write_text(text)
        (tmp_path / f"bad-{path.name}").write_text(text.replace("KillMode=", "KilMode="))
    assert verified(UNITS[0]) == ""
    for path in UNITS:
        assert verified(tmp_path / path.name) == ""
        assert "KilMode" in verified(tmp_path / f"bad-{path.name}")


def verified(path: Path) -> str:
    """What systemd says of a unit."""
    command = ["systemd-analyze", "verify", "--man=no", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    return done.stdout + done.stderr


@pytest.mark.parametrize("path", UNITS, ids=lambda path: path.name)
def test_a_unit_cannot_fly_by_accident(path: Path) -> None:
    found = unit(path)
    service = {key: values[0] for key, values in found["Service"].items()}
    assert "Install" not in found, "it would start at boot"
    assert "--arm" not in service["ExecStart"]
    assert "arm:=true" not in service["ExecStart"]
    if "run_all" in service["ExecStart"]:
        assert service["Restart"] == "no", "a second start is a second flight"
    else:
        assert "%i" in service["ExecStart"].partition("journal:=")[2], "each flight has a journal of its own"
        assert service["Restart"] == "on-failure"
        assert service["RestartPreventExitStatus"] == "2 3"
    timeouts_s = {row.rank: row.stop_timeout_s for row in NODES.values()}  # one rank after the other
    timeout_s = (
        sum(timeouts_s.values()) if "run_all" in service["ExecStart"] else NODES["bridge"].stop_timeout_s
    )
    assert service["KillMode"] == "mixed"
    assert int(service["TimeoutStopSec"]) > timeout_s


@pytest.mark.parametrize("path", UNITS, ids=lambda path: path.name)
def test_a_unit_may_open_the_line_that_it_names(path: Path) -> None:
    found = unit(path)
    service = found["Service"]
    address = re.search(r"serial:(/dev/(\w+)):\d+", service["ExecStart"][0])
    assert address is not None
    assert service["DevicePolicy"] == ["closed"]
    assert service["DeviceAllow"] == [f"{address[1]} rw"]
    assert f"dev-{address[2]}.device" in found["Unit"]["After"][0]
    assert service["SupplementaryGroups"] == ["dialout"]
    families = service["RestrictAddressFamilies"][0].split()
    assert {"AF_UNIX", "AF_INET", "AF_NETLINK"} <= set(families), "what DDS needs"


def test_the_units_and_the_guide_s_other_nodes_hear_each_other() -> None:
    environments = [
        [line for line in unit(path)["Service"]["Environment"] if "ROS_LOG" not in line] for path in UNITS
    ]
    assert environments[0] == environments[1]
    exported = re.search(r"^export (.*)$", GUIDE, re.MULTILINE)
    assert exported is not None
    assert set(exported[1].split()) <= set(environments[0])
