"""An environment in which ROS cannot start is one line; nodes use UDP, on the interfaces of their range."""

import fcntl
import os
import re
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

from tests.conftest import Ros, finish
from uav_dc_ros.errors import ParameterError
from uav_dc_ros.nodes.ros import environment, fastdds

LOCAL_ONLY = {
    *("transport_descriptors", "userTransports", "useBuiltinTransports"),
    *("metatrafficUnicastLocatorList", "initialPeersList"),
}


@pytest.fixture(autouse=True)
def clean(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """An environment of the test's own."""
    for name in ("ROS_DOMAIN_ID", fastdds.RANGE, fastdds.RMW, fastdds.PEERS, "ROS_LOG_DIR", "ROS_HOME"):
        monkeypatch.delenv(name, raising=False)
    for name in (*fastdds.NAMES, fastdds.TRANSPORTS, environment.LINES):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("ROS_DOMAIN_ID", "300"),
        ("ROS_DOMAIN_ID", "09"),
        ("ROS_DOMAIN_ID", "-1"),
        ("ROS_DOMAIN_ID", "٦١"),
        ("ROS_DOMAIN_ID", "61 "),
        ("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF"),
        ("ROS_AUTOMATIC_DISCOVERY_RANGE", "localhost"),
        ("RMW_IMPLEMENTATION", "rmw_no_such"),
        ("RMW_IMPLEMENTATION", "../rmw"),
        ("ROS_LOG_DIR", "/dev/null/log"),
        ("ROS_HOME", "/dev/null"),
    ],
)
def test_a_variable_that_keeps_ros_from_starting_is_named_with_its_value(
    monkeypatch: pytest.MonkeyPatch, name: str, value: str
) -> None:
    monkeypatch.setenv(name, value)
    with pytest.raises(ParameterError) as refused:
        environment.prepare(local_only=True)
    assert str(refused.value).startswith(f"{name} is ")
    assert value in str(refused.value)
    assert "expected" in str(refused.value)


@pytest.mark.parametrize("domain", ["", "0", "61", "061", "0x3d", "232"])
def test_a_domain_that_ros_takes_is_taken(monkeypatch: pytest.MonkeyPatch, domain: str) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", domain)
    environment.prepare(local_only=True)


def test_what_the_user_left_open_is_set(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(fastdds.RANGE, "")
    environment.prepare(local_only=False)
    assert os.environ[fastdds.RANGE] == "SUBNET"


def test_without_a_home_the_password_database_knows_where_logs_go(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delenv("HOME")
    monkeypatch.setattr(os.path, "expanduser", lambda path: path.replace("~", str(tmp_path / "pw")))
    environment.prepare(local_only=True)
    assert os.environ["ROS_LOG_DIR"] == str(tmp_path / "pw" / ".ros" / "log")
    assert Path(os.environ["ROS_LOG_DIR"]).is_dir()


def test_a_home_that_cannot_be_written_is_said_and_logs_go_elsewhere(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("HOME", "/dev/null")
    environment.prepare(local_only=True)
    folder = Path(os.environ["ROS_LOG_DIR"])
    assert folder.is_dir()
    assert str(folder) in capsys.readouterr().err
    folder.rmdir()


def test_a_full_shared_memory_is_refused_before_it_ends_the_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fastdds, "free_mb", lambda: 0.0)
    with pytest.raises(ParameterError, match=r"is full \(0\.00 MB free\).*expected 0.1 MB"):
        environment.prepare(local_only=True)


def test_segments_of_the_dead_are_removed_and_those_of_the_living_are_not(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(fastdds, "SHARED_MEMORY", tmp_path)
    dead, living, young = (f"fastrtps_{digit * 16}" for digit in "0a5")
    others = ["fastrtps_port7000", "fastrtps_port7000_el", "sem.fastrtps_port7000_mutex", f"my_{dead}_el"]
    for name in (*others, *(f"{segment}{end}" for segment in (dead, living, young) for end in ("", "_el"))):
        (tmp_path / name).touch()
        if not name.startswith(young):
            os.utime(tmp_path / name, (0.0, 0.0))
    with (tmp_path / f"{living}_el").open() as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert fastdds.remove_segments_of_the_dead() == 1
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {*others, living, f"{living}_el", young, f"{young}_el"}


LOCALHOST = ("fastdds_localhost.xml", "SUBNET", None)  # the profile limits the range


@pytest.mark.parametrize(
    ("given", "local_only", "selected"),
    [
        ({}, True, LOCALHOST),
        ({fastdds.RANGE: "LOCALHOST"}, False, LOCALHOST),
        ({fastdds.RMW: "rmw_fastrtps_dynamic_cpp"}, True, LOCALHOST),
        ({}, False, ("fastdds.xml", "SUBNET", "UDPv4")),
        ({fastdds.RANGE: "SUBNET"}, True, ("fastdds.xml", "SUBNET", "UDPv4")),
        ({fastdds.PEERS: "10.0.0.2"}, True, ("fastdds.xml", "LOCALHOST", "UDPv4")),
        ({fastdds.RMW: "rmw_cyclonedds_cpp"}, True, ("fastdds.xml", "LOCALHOST", "UDPv4")),
        ({fastdds.TRANSPORTS: "SHM"}, True, ("fastdds.xml", "LOCALHOST", "SHM")),
        ({fastdds.NAMES[0]: "mine.xml"}, True, ("mine.xml", "LOCALHOST", None)),
    ],
)
def test_nodes_use_udp_unless_the_user_selects_transports(
    monkeypatch: pytest.MonkeyPatch,
    given: dict[str, str],
    local_only: bool,
    selected: tuple[str, str, str | None],
) -> None:
    for name, value in given.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(environment, "check", lambda: None)  # another middleware is not installed here
    environment.prepare(local_only=local_only)
    for _ in range(2):  # a node selects in the environment of its run_all
        fastdds.select_transports()
        profile, range_, transports = selected
        assert Path(os.environ[fastdds.NAMES[0]]).name == profile
        assert os.environ[fastdds.RANGE] == range_
        assert os.environ.get(fastdds.TRANSPORTS) == transports


@pytest.mark.parametrize(
    ("free_mb", "selected"), [(400.0, ("fastdds.xml", "LOCALHOST", None)), (4.0, LOCALHOST)]
)
def test_bag_verbs_use_shared_memory_unless_it_is_small(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    free_mb: float,
    selected: tuple[str, str, str | None],
) -> None:
    monkeypatch.setattr(fastdds, "free_mb", lambda: free_mb)
    environment.prepare(local_only=True)
    environment.select_shared_memory()
    assert (Path(os.environ[fastdds.NAMES[0]]).name, os.environ[fastdds.RANGE]) == selected[:2]
    assert fastdds.TRANSPORTS not in os.environ
    note = "4.0 MB free; expected 16: messages travel over UDP alone"
    assert (note in capsys.readouterr().err) == (free_mb < 16.0)


def test_both_profiles_have_the_same_settings() -> None:
    """But for the transport and the peers of the local one."""
    everywhere, local = (
        ElementTree.parse(Path(fastdds.__file__).with_name(name)).getroot()
        for name in ("fastdds.xml", "fastdds_localhost.xml")
    )
    for element in list(local.iter()):
        for child in list(element):
            if child.tag.rpartition("}")[2] in LOCAL_ONLY:
                element.remove(child)
    both = [re.sub(r"\s", "", ElementTree.tostring(root, "unicode")) for root in (everywhere, local)]
    assert both[0] == both[1]


MISSIONS = """
import glob, os, subprocess, sys
run_all = [sys.executable, "-m", "uav_dc_ros.run_all", "--scenario", "three_clusters_hover", "--no-record"]
run_all += ["--nodes", "world,channel_monitor,policy"] * (sys.argv[1] == "nodes")
def shared(): return sorted(n for n in os.listdir("/dev/shm") if "fast" in n)
subprocess.run([*run_all, "--pace", "lockstep"], check=True, stdout=subprocess.DEVNULL)
assert not shared(), ("after a mission", shared())
assert not glob.glob("/dev/shm/uav_dc_ros_*")
mission = subprocess.Popen([*run_all, "--pace", "1"], stdout=subprocess.PIPE, text=True)
while "step 0/" not in mission.stdout.readline():
    assert mission.poll() is None
assert not shared(), ("during a mission", shared())
assert glob.glob("/dev/shm/uav_dc_ros_*/world"), "a disk holds the journals"
sockets = open("/proc/net/udp").read().splitlines()[1:]
print("local" if all(line.split()[1].startswith("0100007F:") for line in sockets) else "every interface")
mission.kill()
mission.wait()
"""


@pytest.mark.parametrize(("nodes", "reach"), [("all", "local"), ("nodes", "every interface")])
def test_missions_use_udp_on_the_interfaces_of_their_range_and_journals_in_memory(
    ros: Ros, nodes: str, reach: str
) -> None:
    """In mount and network namespaces of its own: other tests use /dev/shm and sockets, too."""
    private = ["unshare", "--mount", "--net", "--propagation", "private", "sh", "-c"]
    mount = 'mount -t tmpfs tmpfs /dev/shm && ip link set lo up multicast on && exec "$@"'
    try:
        subprocess.run([*private, mount, "-", "true"], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("no namespaces can be made here: it takes root and iproute2")
    del ros.environment[fastdds.RANGE]
    ros.environment.pop("XDG_RUNTIME_DIR", None)
    status, output = finish(ros.start_command(*private, mount, "-", sys.executable, "-c", MISSIONS, nodes))
    assert (status, output.splitlines()[-1:]) == (0, [reach]), output
