"""An environment in which ROS cannot start is one line; shared memory holds what the living have in it."""

import fcntl
import mmap
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.conftest import Ros, finish
from uav_dc_ros.errors import ParameterError
from uav_dc_ros.nodes.ros import environment, fastdds


@pytest.fixture(autouse=True)
def clean(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """An environment of the test's own, and an empty folder in place of /dev/shm."""
    for name in ("ROS_DOMAIN_ID", environment.RANGE, "RMW_IMPLEMENTATION", "ROS_LOG_DIR", "ROS_HOME"):
        monkeypatch.delenv(name, raising=False)
    for name in (*fastdds.NAMES, fastdds.TRANSPORTS, environment.LINES):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    shared = tmp_path / "shm"
    shared.mkdir()
    monkeypatch.setattr(fastdds, "SHARED_MEMORY", shared)
    return shared


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
    monkeypatch.setenv(environment.RANGE, "")
    environment.prepare(local_only=False)
    assert os.environ[environment.RANGE] == "SUBNET"


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
    with pytest.raises(ParameterError, match=r"is full \(0\.00 MB free\).*expected 16 MB"):
        environment.prepare(local_only=True)


def test_a_small_shared_memory_is_not_used(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(fastdds, "free_mb", lambda: 4.0)
    environment.prepare(local_only=True)
    assert os.environ[fastdds.TRANSPORTS] == "UDPv4"
    assert "4.0 MB free; expected 16: messages travel over UDP alone" in capsys.readouterr().err


def test_leftovers_go_and_what_the_living_have_stays(clean: Path) -> None:
    old_s = time.time() - 60.0
    living = {"fastrtps_00000000000000aa", "fastrtps_port7001"}
    dead = {"fastrtps_00000000000000bb", "fastrtps_port7002", "fastdds_00000000000000cc"}
    for name in living | dead:
        (clean / name).write_bytes(b"x")
        (clean / f"{name}_el").touch()
        (clean / f"sem.{name}_mutex").touch()
    (clean / "fastrtps_port7003").touch()  # closed in good order: without a lock
    for name in ("fastrtps_00000000000000dd", "fastrtps_00000000000000dd_el"):  # just made, not locked yet
        (clean / name).touch()
    (clean / "fastrtps_port7004").touch()  # just made: its lock comes in a moment
    (clean / "fastrtps_port7005").touch()
    (clean / "fastrtps_port7005_sl").touch()
    for name in ("another", "fastrtps_short", "sem.another"):
        (clean / name).touch()
    for name in clean.iterdir():
        if name.name not in ("fastrtps_port7004", "fastrtps_00000000000000dd_el"):
            os.utime(name, (old_s, old_s))
    mapped = (clean / "fastrtps_port7006").open("wb+")  # its listener has ended, and others may send there
    mapped.write(b"x")
    mapped.flush()
    sender = mmap.mmap(mapped.fileno(), 1)
    os.utime(clean / "fastrtps_port7006", (old_s, old_s))
    held = [(clean / f"{name}_el").open("rb+") for name in living]
    for file in held:
        fcntl.flock(file, fcntl.LOCK_EX)
    shared = (clean / "fastrtps_port7005_sl").open("rb+")
    fcntl.flock(shared, fcntl.LOCK_SH)

    assert fastdds.remove_leftovers() == 4

    kept = {path.name for path in clean.iterdir()}
    assert kept == {
        *(part for name in living for part in (name, f"{name}_el", f"sem.{name}_mutex")),
        *("fastrtps_port7004", "fastrtps_port7005", "fastrtps_port7005_sl"),
        *("fastrtps_00000000000000dd", "fastrtps_00000000000000dd_el"),
        *("another", "fastrtps_short", "sem.another", "fastrtps_port7006"),
    }
    sender.close()
    for file in (*held, shared, mapped):
        file.close()


MISSIONS = """
import os, signal, subprocess, sys, time
from pathlib import Path
missions, kills = int(sys.argv[1]), int(sys.argv[2])
run_all = [sys.executable, "-m", "uav_dc_ros.run_all", "--scenario", "three_clusters", "--no-record"]
run_all += ["--nodes", "world,channel_monitor,policy"]
def shared(): return sorted(n for n in os.listdir("/dev/shm") if "lttng" not in n)
before = shared()
for _ in range(missions):
    subprocess.run([*run_all, "--pace", "lockstep"], check=True, stdout=subprocess.DEVNULL)
    assert shared() == before, ("after a mission", shared())
for _ in range(kills):
    world = subprocess.Popen([sys.executable, "-m", "uav_dc_ros.nodes.world"], stdout=subprocess.DEVNULL)
    while not any(name.endswith("_el") for name in shared()):
        assert world.poll() is None
        time.sleep(0.05)
    time.sleep(2.0)  # files that are younger are let alone: they may not be locked yet
    world.kill()
    world.wait()
    assert shared() != before, "the world that was killed left nothing: nothing is tested"
    for _ in range(3):  # what a busy machine left behind is removed at the next start
        subprocess.run([*run_all, "--pace", "lockstep"], check=True, stdout=subprocess.DEVNULL)
        if shared() == before:
            break
        time.sleep(2.0)
    assert shared() == before, ("after a kill", shared())
node = subprocess.Popen([sys.executable, "-m", "uav_dc_ros.nodes.world"], stdout=subprocess.DEVNULL)
while not any(name.endswith("_el") for name in shared()):
    time.sleep(0.05)
time.sleep(1.0)
node.terminate()
assert node.wait() == 0
assert shared() == before, ("after a node alone", shared())
print("equal")
"""


@pytest.mark.parametrize(
    ("missions", "kills"), [(1, 1), pytest.param(20, 5, marks=pytest.mark.long)], ids=["one", "many"]
)
def test_shared_memory_is_as_before_after_missions_and_kills(ros: Ros, missions: int, kills: int) -> None:
    """In a mount namespace of its own: other tests use /dev/shm, too."""
    private = ["unshare", "--mount", "--propagation", "private", "sh", "-c"]
    mount = 'mount -t tmpfs tmpfs /dev/shm && exec "$@"'
    try:
        subprocess.run([*private, mount, "-", "true"], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("no mount namespace can be made here: it takes root")
    process = ros.start_command(*private, mount, "-", sys.executable, "-c", MISSIONS, missions, kills)
    status, output = finish(process, 60.0 + 60.0 * (missions + kills))
    assert (status, output.splitlines()[-1:]) == (0, ["equal"]), output


def test_participants_are_created_one_after_the_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not for ever: a process that hangs meanwhile, or is killed, stops no other."""
    name = f"\0uav_dc_ros/participant_of_{os.getpid()}"
    monkeypatch.setattr(fastdds, "CREATION_LOCK", name)
    code = f"""
from uav_dc_ros.nodes.ros import fastdds
fastdds.CREATION_LOCK = {name!r}
with fastdds.one_participant_at_a_time():
    print("created", flush=True)
    input()
"""
    command = [sys.executable, "-c", code]
    holder = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert holder.stdout is not None
    assert holder.stdout.readline() == "created\n"
    monkeypatch.setattr(fastdds, "CREATION_MAX_S", 0.3)
    begun_s = time.monotonic()
    with fastdds.one_participant_at_a_time():
        assert time.monotonic() - begun_s >= 0.3
    holder.kill()
    holder.communicate()
    monkeypatch.setattr(fastdds, "CREATION_MAX_S", 600.0)
    with fastdds.one_participant_at_a_time():
        pass
    with fastdds.one_participant_at_a_time():
        pass
