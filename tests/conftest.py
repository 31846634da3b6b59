"""What tests share: a ROS domain of their own, processes that are all gone afterwards, small worlds."""

import fcntl
import functools
import gc
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

import hypothesis
import pytest

from uav_dc_ros.errors import MessageError
from uav_dc_ros.offboard.mission.controller import MissionController
from uav_dc_ros.runner.working_folder import memory

MissionController.is_strict = (
    True  # a phase that cannot follow fails the test; in the air it would end the mission
)
MARK = "UAV_DC_TEST"
ROOT = Path(__file__).parents[1]
# How long a test waits for what must come, wall time. Only what never comes takes this long: a machine with
# much else to do may take twenty times as long as a calm one.
PATIENCE_S = 200.0
# Options of run_all: a process less to start, where markers do not matter.
WITHOUT_VISUALIZER = ("--nodes", "world,channel_monitor,policy,recorder")

# The tests start some hundred processes. Without bytecode each of them compiles this project anew.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# Threads of one pool that wait for one another occupy the cores, which several processes share.
os.environ["OMP_NUM_THREADS"] = "1"

# What takes long on a busy machine is no failure.
hypothesis.settings.register_profile("patient", deadline=None)
hypothesis.settings.load_profile("patient")

# A shell without job control, such as that of a script, ignores Ctrl-C for what it starts in the background.
signal.signal(signal.SIGINT, signal.default_int_handler)


# Collecting makes hundreds of thousands of objects that stay: the garbage collector skips them, see below.
gc.disable()


def pytest_collection_finish() -> None:
    gc.enable()
    gc.freeze()


def pytest_configure() -> None:
    """Put the tests' folders in memory if there is room: beside other programs a disk takes seconds."""
    folder = memory()
    if folder is not None and shutil.disk_usage(folder).free > 4e9:
        os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(folder))


OUTSIDE = "files outside of a folder"
# Where the longest tests are, in this order: at the end, short files are left for the workers to share.
LONGEST_FIRST = ("nodes", "runner", "experiments", OUTSIDE, "offboard", "recordings", "bags")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the longest first; the tests of a file stay together. Give long tests time."""

    def rank(item: pytest.Item) -> int:
        place, *rest = item.path.relative_to(ROOT / "tests").parts
        if place == "test_house_rules.py":  # with the type checker
            return -1
        place = place if rest else OUTSIDE
        return LONGEST_FIRST.index(place) if place in LONGEST_FIRST else len(LONGEST_FIRST)

    items.sort(key=rank)
    for item in items:
        if item.get_closest_marker("long"):
            item.add_marker(pytest.mark.timeout(3600))


class Ros:
    """Runs this project's commands in a ROS domain of their own, in a folder of their own."""

    def __init__(self, domain: int, folder: Path) -> None:
        self.folder = folder
        self.mark = uuid.uuid4().hex
        self.environment = {
            **os.environ,
            MARK: self.mark,
            "PYTHONFAULTHANDLER": "1",
            "ROS_DOMAIN_ID": str(domain),
            "ROS_LOG_DIR": str(folder / "log"),
            "XDG_STATE_HOME": str(folder / "state"),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "PYTHONPATH": str(ROOT),
        }

    def start(self, module: str, *arguments: object, **popen: Any) -> subprocess.Popen[str]:
        """Start `python -m module arguments...`; its output, both streams, is piped."""
        return self.start_command(sys.executable, "-m", module, *arguments, **popen)

    def start_command(self, *command: object, **popen: Any) -> subprocess.Popen[str]:
        """Start a command; its output, both streams, is piped."""
        return subprocess.Popen(
            [str(part) for part in command],
            env=self.environment,
            cwd=self.folder,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            **popen,
        )

    def stranger(self, name: str, *arguments: object, folder: str = "nodes") -> subprocess.Popen[str]:
        """Start a script of a folder of the tests beside the nodes; its input and output are piped."""
        return subprocess.Popen(
            [sys.executable, str(ROOT / "tests" / folder / f"{name}.py"), *map(str, arguments)],
            env=self.environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def run_id(self) -> str:
        """Identity of the run that is flown: `mission` is latched, so whoever comes late receives it, too."""
        probe = self.stranger("probe", "/mission")
        assert probe.stdout is not None
        run: str = json.loads(json.loads(probe.stdout.readline())["data"])["run"]
        probe.kill()
        probe.communicate()
        return run

    def run(self, module: str, *arguments: object, timeout_s: float = PATIENCE_S) -> tuple[int, str]:
        """Run it to its end; the exit status and what it printed."""
        process = self.start(module, *arguments)
        return finish(process, timeout_s)

    def run_fork(self, module: str, *arguments: object) -> tuple[int, str]:
        """As `run`, for what ends at once: in a fork of a process that has imported this project already."""
        output = self.folder.with_name(f"{self.folder.name}.output")
        output.write_text("")
        order = {
            "module": module,
            "arguments": [str(argument) for argument in arguments],
            "environment": self.environment,
            "folder": str(self.folder),
            "output": str(output),
        }
        forks = _forks()
        assert forks.stdin is not None
        assert forks.stdout is not None
        forks.stdin.write(json.dumps(order) + "\n")
        forks.stdin.flush()
        return int(forks.stdout.readline()), output.read_text()

    def run_all(self, *arguments: object, timeout_s: float = PATIENCE_S) -> tuple[int, str]:
        """Run run_all to its end."""
        return self.run("uav_dc_ros.run_all", *arguments, timeout_s=timeout_s)

    def processes(self) -> dict[int, str]:
        """Command lines of this test's processes, by process id."""
        found = {}
        for entry in Path("/proc").iterdir():
            if not entry.name.isdigit():
                continue
            try:
                ours = f"{MARK}={self.mark}".encode() in (entry / "environ").read_bytes().split(b"\0")
                if ours:
                    found[int(entry.name)] = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode()
            except OSError:
                continue  # it has ended, or is not ours to read
        return found

    def node(self, name: str) -> int:
        """Process id of a node that runs, by name."""
        deadline_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline_s:
            for process_id, command in self.processes().items():
                if f"uav_dc_ros.nodes.{name} " in command:
                    return process_id
            time.sleep(0.02)
        raise AssertionError(f"node {name} did not start")

    def gone(self, within_s: float = PATIENCE_S) -> bool:
        """Wait for the end of this test's processes; have they all ended."""
        deadline_s = time.monotonic() + within_s
        while self.processes() and time.monotonic() < deadline_s:
            time.sleep(0.05)
        return not self.processes()


@functools.cache
def _forks() -> subprocess.Popen[str]:
    """The process that forks (tests/forks.py); it ends with this one."""
    command = [sys.executable, "-m", "tests.forks"]
    return subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def finish(process: subprocess.Popen[str], timeout_s: float = PATIENCE_S) -> tuple[int, str]:
    """Wait for a process; its exit status and what it printed."""
    try:
        output, _ = process.communicate(timeout=timeout_s)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGABRT)  # it tells where it was
        time.sleep(1.0)
        process.kill()
        output, _ = process.communicate()
        raise AssertionError(f"still running after {timeout_s} s; it printed:\n{output}") from None
    return process.returncode, output


def outcome(act: Callable[[], Any]) -> Any:
    """What an act returns, or the MessageError that it raises: nothing else may be raised."""
    try:
        return act()
    except MessageError as refused:
        return refused


def until(condition: Callable[[], Any], patience_s: float = PATIENCE_S) -> None:
    """Wait until something is so."""
    deadline_s = time.monotonic() + patience_s
    while not condition():
        assert time.monotonic() < deadline_s, f"not so within {patience_s} s"
        time.sleep(0.02)


def wait_for(stream: IO[str], text: str) -> str:
    """Read lines until one holds `text`; all that was read."""
    read = ""
    for line in stream:
        read += line
        if text in line:
            return read
    raise AssertionError(f"{text!r} was never printed; this was:\n{read}")


def _free_domain() -> tuple[int, IO[str]]:
    """A domain that no other test on this machine uses, held by a lock."""
    folder = Path(tempfile.gettempdir()) / "uav_dc_ros_domains"
    folder.mkdir(exist_ok=True)
    for domain in range(20, 100):
        lock = (folder / str(domain)).open("w")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            lock.close()
            continue
        return domain, lock
    raise AssertionError("no ROS domain is free")


def ros_in(folder: Path) -> Iterator[Ros]:
    """A Ros in a folder; afterwards nothing of it may still run."""
    domain, lock = _free_domain()
    ros = Ros(domain, folder)
    yield ros
    left = {} if ros.gone() else ros.processes()
    for process_id in left:
        os.kill(process_id, signal.SIGKILL)
    lock.close()
    assert not left, f"processes left behind: {left}"


@pytest.fixture
def ros(tmp_path: Path) -> Iterator[Ros]:
    """A ROS domain and a folder for one test."""
    yield from ros_in(tmp_path)


@pytest.fixture(scope="module")
def module_ros(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Ros]:
    """A ROS domain and a folder for the tests of a module."""
    yield from ros_in(tmp_path_factory.mktemp("ros"))


@pytest.fixture(scope="session")
def repository_files() -> list[str]:
    """Paths of the repository's files, relative to its root: tracked, or new and not ignored."""
    if not (ROOT / ".git").exists() or shutil.which("git") is None:
        pytest.skip("not a git checkout, so what belongs to the repository is unknown")
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return [name for name in listed.split("\0") if name and (ROOT / name).is_file()]


def copy_repository(files: list[str], folder: Path) -> None:
    """Copy the repository's files, without what git ignores."""
    for name in files:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, folder / name)


def each_once(told: list[Any]) -> list[Any]:
    """What was told, without repetitions: a lockstep that stood still for a moment says its step again."""
    return [message for i, message in enumerate(told) if i == 0 or message != told[i - 1]]


def but_run(payload: dict[str, Any]) -> dict[str, Any]:
    """A payload without the identity of its run: equal seeds give equal payloads but for that."""
    return {name: value for name, value in payload.items() if name != "run"}


def read_bag(folder: Path, *topics: str) -> list[tuple[str, Any]]:
    """Topic and content of each message of a bag, or of some of its topics, in its order; JSON decoded."""
    from rosbags.highlevel import AnyReader

    read = []
    with AnyReader([folder]) as reader:
        wanted = [each for each in reader.connections if not topics or each.topic in topics]
        for connection, _, data in reader.messages(wanted):
            message = reader.deserialize(data, connection.msgtype)
            is_json = connection.msgtype == "std_msgs/msg/String"
            read.append((connection.topic, json.loads(message.data) if is_json else message))
    return read
