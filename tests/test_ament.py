"""The project as a ROS 2 package: what colcon builds from it, that it flies, and what the launch file starts.

The launch file is read by a stand-in (ament_launch.py): it has not run under `ros2 launch`, which PyPI lacks.
"""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tests import ament_launch
from tests.conftest import PATIENCE_S, ROOT, copy_repository, finish, read_bag, wait_for
from uav_dc_ros import run_all
from uav_dc_ros.nodes.framework.node_table import NODES

# One worker builds the workspace, once.
pytestmark = pytest.mark.xdist_group("ament")

LAUNCH = ROOT / "uav_dc_ros" / "share" / "launch" / "mission.launch.xml"
PROCESSES = [name for name, row in NODES.items() if row.process]
STARTED = [name for name in PROCESSES if not NODES[name].on_request]
PEERS = [name for name in PROCESSES if NODES[name].needed and name != "bridge"]

# Options of run_all without an argument of their name, and why.
OTHERWISE = {
    "no_record": "record:=false",
    "summary": "run_all itself follows the missions and sums them up; under launch nobody does",
    "compose": "a node of a launch file is a process; `ros2 run uav_dc_ros container` has several",
    "settings": "launch has ways of its own to set a node's parameters",
    "help": "ros2 launch --show-args",
    "version": "in package.xml",
}
# Arguments without an option of their name, and why.
OF_LAUNCH_ONLY = {
    "record": "--no-record",
}


def manifest(path=ROOT / "package.xml"):
    from catkin_pkg.package import parse_package

    warnings = []
    package = parse_package(path, warnings=warnings)
    assert warnings == []
    return package


def build(folder, files, *options):
    """The environment of a shell that has sourced a new workspace with this package in it."""
    copy_repository(files, folder / "src" / "uav_dc_ros")
    clean = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    command = [sys.executable, "-m", "colcon", "--log-base", "log", "build", *options]
    done = subprocess.run(command, cwd=folder, env=clean, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "WARNING" not in done.stderr, done.stderr
    printer = shlex.join([sys.executable, "-c", "import json, os; print(json.dumps(dict(os.environ)))"])
    sourced = f". {shlex.quote(str(folder / 'install' / 'local_setup.bash'))} && exec {printer}"
    told = subprocess.run(["bash", "-c", sourced], env=clean, capture_output=True, text=True, check=True)
    assert told.stderr == ""
    # The executables run the `python3` of the shell: for this test, the one that runs it.
    return json.loads(told.stdout) | {"PATH": f"{Path(sys.executable).parent}:{clean['PATH']}"}


@pytest.fixture(scope="module")
def workspace(tmp_path_factory, repository_files):
    """A workspace that colcon has built, and the environment of who has sourced it."""
    folder = tmp_path_factory.mktemp("workspace")
    return folder / "install" / "uav_dc_ros", build(folder, repository_files)


def in_workspace(ros, environment):
    """Let `ros` run in a sourced workspace."""
    own = {key: ros.environment[key] for key in ros.environment if key not in ("PATH", "PYTHONPATH")}
    ros.environment = environment | own | {"PYTHONSAFEPATH": "1"}


def executables(prefix):
    return {path.name for path in (prefix / "lib" / "uav_dc_ros").iterdir()}


def test_package_xml_says_what_pyproject_says():
    package = manifest()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    assert package.package_format == 3
    assert package.get_build_type() == "ament_python"
    assert (package.name, package.version) == (project["name"], project["version"])
    assert package.description == project["description"]
    assert list(package.licenses) == [project["license"]] == ["Apache-2.0"]
    assert package.licenses[0].file == project["license-files"][0] == "LICENSE"
    assert "Version 2.0, January 2004" in (ROOT / "LICENSE").read_text("utf-8")
    # Each dependency is a rosdep key, or is named in the comment on what pip brings.
    comment = re.search(r"<!-- pip brings .*?-->", (ROOT / "package.xml").read_text("utf-8"), re.DOTALL)[0]
    keys = {depend.name for depend in package.exec_depends}
    for need in project["dependencies"]:
        name = re.match(r"[\w.-]+", need)[0]
        assert (f"python3-{name}" in keys) != (re.search(rf"\b{re.escape(name)}\b", comment) is not None), (
            name
        )


def test_package_xml_depends_on_the_message_packages_in_use():
    keys = {depend.name for depend in manifest().exec_depends}
    source = "".join(path.read_text("utf-8") for path in (ROOT / "uav_dc_ros" / "nodes").rglob("*.py"))
    imported = set(re.findall(r"^from (\w+(?:_msgs|_interfaces))\.", source, re.MULTILINE))
    assert "std_msgs" in imported
    assert imported | {"rclpy"} <= keys


def test_the_workspace_holds_what_ros2_looks_for(workspace):
    prefix, environment = workspace
    assert str(prefix) in environment["AMENT_PREFIX_PATH"].split(":")
    assert (prefix / "share/ament_index/resource_index/packages/uav_dc_ros").is_file()
    share = prefix / "share" / "uav_dc_ros"
    assert (share / "package.xml").read_bytes() == (ROOT / "package.xml").read_bytes()
    shipped = ROOT / "uav_dc_ros" / "share"
    for path in shipped.rglob("*"):
        installed = share / path.relative_to(shipped)
        assert installed.is_dir() if path.is_dir() else installed.read_bytes() == path.read_bytes(), path
    assert executables(prefix) == {*PROCESSES, "container", "run_all"}
    for name in executables(prefix):
        assert os.access(prefix / "lib" / "uav_dc_ros" / name, os.X_OK)


@pytest.mark.parametrize(
    "options",
    [
        pytest.param([], id="copied"),
        pytest.param(["--symlink-install"], id="linked", marks=pytest.mark.long),
    ],
)
def test_a_workspace_flies(options, workspace, tmp_path_factory, repository_files, ros):
    prefix, environment = workspace
    if options:
        folder = tmp_path_factory.mktemp("linked")
        prefix, environment = folder / "install" / "uav_dc_ros", build(folder, repository_files, *options)
    in_workspace(ros, environment)
    program = """
import json, uav_dc_ros
from ament_index_python.packages import get_package_share_directory
from uav_dc_ros import files, scenarios
print(json.dumps([uav_dc_ros.__file__, get_package_share_directory("uav_dc_ros"),
                  str(files.shipped_folder("policies")), scenarios.names()]))
"""
    told = subprocess.run(
        [sys.executable, "-c", program], env=ros.environment, capture_output=True, text=True, check=True
    )
    package, share, policies, names = json.loads(told.stdout)
    workspace_folder = str(prefix.parents[1])
    assert package.startswith(workspace_folder)
    assert policies.startswith(workspace_folder)
    assert share == str(prefix / "share" / "uav_dc_ros")
    assert "three_clusters_hover" in names
    executable = prefix / "lib" / "uav_dc_ros" / "run_all"
    status, output = finish(ros.start_command(executable, "--help"))
    assert status == 0, output
    assert "--scenario" in output
    status, output = finish(
        ros.start_command(executable, "--scenario", "three_clusters_hover", "--pace", "lockstep")
    )
    assert status == 0, output
    assert "landed" in output
    assert "error" not in output.lower(), output
    (bag,) = (ros.folder / "bags").iterdir()
    assert (bag / "metadata.yaml").is_file()


def test_the_arguments_of_the_launch_file_are_the_options_of_run_all():
    options = {action.dest: action for action in run_all.parser()._actions}
    arguments = ament_launch.arguments(LAUNCH)
    assert all(arguments[name]["description"] for name in arguments)
    assert options.keys() - OTHERWISE.keys() <= arguments.keys()
    assert arguments.keys() - options.keys() <= OF_LAUNCH_ONLY.keys()
    assert not arguments.keys() & OTHERWISE.keys()
    for name in ("scenario", "seed", "missions"):
        assert arguments[name]["default"] == str(options[name].default)
    assert float(arguments["pace"]["default"]) == options["pace"].default
    assert arguments["nodes"]["default"].split(",") == [*STARTED, "bridge"]


@pytest.mark.parametrize(
    ("given", "started", "peers"),
    [
        ({}, STARTED, PEERS),
        (
            {"record": "false"},
            [n for n in STARTED if n != "recorder"],
            [n for n in PEERS if n != "recorder"],
        ),
        ({"nodes": "policy,recorder"}, ["policy", "recorder"], PEERS),
        (
            {"vehicle": "mavlink", "connect": "tcp:127.0.0.1:5760", "arm": "true"},
            [STARTED[0], "bridge", *STARTED[1:]],
            [*PEERS, "bridge"],
        ),
    ],
    ids=["all", "no bag", "two of them", "a bridge"],
)
def test_the_launch_file_starts(given, started, peers):
    nodes = ament_launch.nodes(LAUNCH, given)
    assert [node.executable for node in nodes] == started
    for node in nodes:
        assert (node.package, node.name, node.namespace) == ("uav_dc_ros", node.executable, "")
        assert node.parameters["peers"] == peers
        assert node.parameters["scenario"] == "five_clusters"
        assert node.parameters.get("policy", "five_clusters_dueling") == "five_clusters_dueling"
        assert re.fullmatch(r"bags/[\d_-]+", node.parameters.get("bag", "bags/1"))
        if node.name in ("world", "bridge", "recorder"):
            given_for = given.get("vehicle", "simulated")
            inside = "external" if "vehicle" in given else "simulated"
            assert node.parameters["vehicle"] == (inside if node.name == "world" else given_for)
        if node.name == "bridge":
            assert (node.parameters["connect"], node.parameters["arm"]) == (given["connect"], True)


def test_the_launch_file_starts_a_live_view_if_asked():
    (view,) = (node for node in ament_launch.nodes(LAUNCH, {"live": "8765"}) if node.name == "live_view")
    assert view.parameters == {"port": 8765}
    (view,) = (node for node in ament_launch.nodes(LAUNCH, {"view": "8766"}) if node.name == "web_view")
    assert view.parameters == {"scenario": "five_clusters", "port": 8766}


def test_the_launch_file_s_nodes_fly(workspace, ros):
    prefix, environment = workspace
    in_workspace(ros, environment)
    given = {
        "scenario": "three_clusters_hover",
        "seed": "3",
        "pace": "lockstep",
        "bag": "here",
        "namespace": "uav1",
    }
    listener = [sys.executable, str(ROOT / "tests" / "nodes" / "probe.py"), "/uav1/mission"]
    probe = subprocess.Popen(
        listener,
        env=ros.environment | {"PYTHONSAFEPATH": ""},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    running = {}
    nodes = ament_launch.nodes(LAUNCH, given)
    for node in nodes:
        parameters = ros.folder / f"{node.name}.yaml"  # JSON is YAML
        parameters.write_text(json.dumps({f"/uav1/{node.name}": {"ros__parameters": node.parameters}}))
        running[node.name] = ros.start_command(
            prefix / "lib" / node.package / node.executable,
            *("--ros-args", "-r", f"__node:={node.name}", "-r", f"__ns:=/{node.namespace}"),
            *("--params-file", parameters),
        )
    wait_for(probe.stdout, '\\"remaining_steps\\":0')
    asked = subprocess.run(
        [sys.executable, str(ROOT / "tests" / "ament_parameters.py"), *(f"/uav1/{name}" for name in running)],
        env=ros.environment,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    probe.stdin.close()
    probe.wait(90)
    probe.stdout.close()
    for process in running.values():
        process.send_signal(signal.SIGINT)  # to all at once, as launch does
    for name, process in running.items():
        status, output = finish(process)
        assert status == 0, f"{name}: {output}"
        assert "Traceback" not in output, output
    assert asked.returncode == 0, asked.stderr
    declared = json.loads(asked.stdout)
    for node in nodes:
        assert node.parameters.keys() <= set(declared[f"/uav1/{node.name}"]), node.name
    said = [payload for topic, payload in read_bag(ros.folder / "here") if topic == "/uav1/mission"]
    assert said[-1]["phase"] == "landed"
    assert said[0]["seed"] == 3
