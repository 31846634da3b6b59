"""The folder of a run ends with the run, and that of a killed one at the next start."""

import subprocess
import sys
from pathlib import Path

import pytest

from uav_dc_ros.runner.working_folder import LOCKED, memory, working_folder

RUN = """
import sys
from uav_dc_ros.runner.working_folder import working_folder
with working_folder() as folder:
    (folder / "journal").write_text("moves")
    print(folder, flush=True)
    sys.stdin.read()
"""


def a_run() -> tuple[subprocess.Popen[str], Path]:
    """A process in its working folder."""
    process = subprocess.Popen(
        [sys.executable, "-c", RUN], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    return process, Path(process.stdout.readline().strip())


def test_only_the_folder_of_a_killed_run_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    (tmp_path / "uav_dc_ros_of_another_program").mkdir()
    killed, left = a_run()
    killed.kill()
    killed.communicate()
    alive, used = a_run()
    assert used.parent == tmp_path
    assert not left.exists()
    with working_folder() as folder:
        assert [path.name for path in folder.iterdir()] == [LOCKED]
        assert (used / "journal").read_text() == "moves"
    alive.communicate()
    assert [path.name for path in tmp_path.iterdir()] == ["uav_dc_ros_of_another_program"]


def test_without_a_folder_for_the_user_memory_is_that_of_the_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/nonexistent")
    assert memory() == Path("/dev/shm")
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    assert memory() == Path("/dev/shm")
