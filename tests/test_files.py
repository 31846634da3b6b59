"""Output files: replaced in one move, durable, and never in place of a link or a device."""

import ast
import contextlib
import os
import socket
import stat
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from tests.test_house_rules import MODULES, PACKAGE
from uav_dc_ros import files
from uav_dc_ros.errors import UavDcError

WRITES = "import sys; from pathlib import Path; from uav_dc_ros import files; print('printed before'); "


@pytest.fixture
def device(tmp_path: Path) -> Path:
    """A node of our own with the numbers of /dev/null."""
    path = tmp_path / "null"
    try:
        os.mknod(path, 0o666 | stat.S_IFCHR, os.makedev(1, 3))
        path.write_bytes(b"")
    except OSError:
        pytest.skip("devices cannot be made here")
    return path


def test_a_regular_file_is_replaced_and_keeps_its_permissions(tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    files.write(path, b"one")
    path.chmod(0o600)
    files.write(path, b"two")
    assert path.read_bytes() == b"two"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert list(tmp_path.iterdir()) == [path]


def test_a_link_stays_and_its_target_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "far").mkdir()
    target, link, chain = tmp_path / "far" / "target", tmp_path / "link", tmp_path / "chain"
    link.symlink_to("far/target")
    chain.symlink_to(link)
    for content in (b"made through a dangling link", b"replaced"):
        files.check_writable(chain)
        files.write(chain, content)
        assert link.is_symlink()
        assert chain.is_symlink()
        assert target.read_bytes() == content
    assert list((tmp_path / "far").iterdir()) == [target]


def test_links_in_a_circle_are_an_error(tmp_path: Path) -> None:
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    for check in (files.check_writable, lambda path: files.write(path, b"")):
        with pytest.raises(UavDcError, match="a cannot be written: Too many levels of symbolic links"):
            check(tmp_path / "a")


def test_a_device_stays_a_device(device: Path) -> None:
    link = device.with_name("link")
    link.symlink_to(device.name)
    for path in (device, link):
        files.check_writable(path)
        files.write(path, b"gone")
        with files.replacing(path) as partial:
            partial.write_bytes(b"gone, too")
    assert stat.S_ISCHR(device.stat().st_mode)
    assert link.is_symlink()
    assert sorted(device.parent.iterdir()) == [link, device]


def test_a_fifo_passes_the_content_on(tmp_path: Path) -> None:
    path = tmp_path / "fifo"
    os.mkfifo(path)
    files.check_writable(path)
    with pytest.raises(UavDcError, match="fifo cannot be written: No such device or address"):
        files.write(path, b"without a reader")
    for large in (False, True):
        read: list[bytes] = []
        opened = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        os.set_blocking(opened, True)

        def all_of(descriptor: int = opened, into: list[bytes] = read) -> None:
            with os.fdopen(descriptor, "rb") as file:
                while not into:  # until the writer has come
                    into.extend(filter(None, [file.read()]))

        reader = threading.Thread(target=all_of)
        reader.start()
        if large:
            with files.replacing(path) as partial:
                partial.write_bytes(b"a" * 1_000_000)
        else:
            files.write(path, b"a" * 1_000_000)
        reader.join()
        assert read == [b"a" * 1_000_000]
    assert path.is_fifo()


@pytest.mark.parametrize("name", ["/dev/stdout", "/dev/fd/1", "/proc/self/fd/1", "link"])
def test_standard_output_is_written_after_what_was_printed(tmp_path: Path, name: str) -> None:
    (tmp_path / "link").symlink_to("/dev/stdout")
    program = f"{WRITES}path = Path({name!r}); files.check_writable(path); files.write(path, b'content')"
    with (tmp_path / "out").open("wb") as out:
        subprocess.run([sys.executable, "-c", program], stdout=out, cwd=tmp_path, check=True)
    assert (tmp_path / "out").read_bytes() == b"printed before\ncontent"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["link", "out"]


def test_standard_output_may_be_a_socket(tmp_path: Path) -> None:
    ours, theirs = socket.socketpair()  # as systemd's journal; it cannot be opened by its path
    with ours, theirs:
        program = f"{WRITES}files.write(Path('/dev/stdout'), b'content')"
        subprocess.run([sys.executable, "-c", program], stdout=theirs, check=True)
        theirs.close()
        with ours.makefile("rb") as stream:
            assert stream.read() == b"printed before\ncontent"


def test_a_descriptor_that_is_closed_is_an_error() -> None:
    for check in (files.check_writable, lambda path: files.write(path, b"")):
        with pytest.raises(UavDcError, match="/dev/fd/987 cannot be written: Bad file descriptor"):
            check(Path("/dev/fd/987"))


def test_an_unwritable_path_is_an_error_and_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    before = sorted(tmp_path.iterdir())
    for name, reason in (("", "Is a directory"), ("no/x", "No such file"), ("file/x", "Not a directory")):
        for check in (files.check_writable, lambda path: files.write(path, b"")):
            with pytest.raises(UavDcError, match=rf"cannot be written: {reason}"):
                check(tmp_path / name)
    with pytest.raises(UavDcError, match="/dev/full cannot be written: No space left on device"):
        files.write(Path("/dev/full"), b"x")
    assert sorted(tmp_path.iterdir()) == before


def test_a_failed_block_leaves_the_older_file(tmp_path: Path) -> None:
    path = tmp_path / "x"
    path.write_bytes(b"older")
    with contextlib.suppress(ZeroDivisionError), files.replacing(path) as partial:
        partial.write_bytes(b"half")
        raise ZeroDivisionError
    assert path.read_bytes() == b"older"
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_appears_when_it_is_whole_and_a_failed_one_leaves_nothing(tmp_path: Path) -> None:
    with files.building(tmp_path / "new" / "made") as partial:
        (partial / "a").write_text("content")
        assert not (tmp_path / "new" / "made").exists()
    assert (tmp_path / "new" / "made" / "a").read_text() == "content"
    with pytest.raises(FileNotFoundError), files.building(tmp_path / "new" / "failed") as partial:
        (partial / "none").unlink()
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["made"]


def test_content_is_on_the_disk_before_its_name_and_the_name_before_it_returns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    happened: list[str] = []
    fsync, replace = os.fsync, Path.replace

    def synced(descriptor: int) -> None:
        happened.append(f"sync {Path(os.readlink(f'/proc/self/fd/{descriptor}')).name.split('.')[0]}")
        fsync(descriptor)

    def replaced(self: Path, target: Path) -> Path:
        happened.append(f"name {target.name}")
        return replace(self, target)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(Path, "replace", replaced)
    (tmp_path / "made").mkdir()
    (tmp_path / "made" / "a").touch()
    files.move(tmp_path / "made", tmp_path / "folder")
    assert happened == ["sync a", "sync made", "name folder", f"sync {tmp_path.name}"]
    happened.clear()
    files.write(tmp_path / "x", b"content")
    assert happened == ["sync ", "name x", f"sync {tmp_path.name}"]
    happened.clear()
    with files.replacing(tmp_path / "x", durable=False) as partial:
        partial.touch()
    assert happened == ["name x"]


def test_no_other_module_renames_files() -> None:
    """A rename elsewhere would replace a device, or lose its content in a power cut."""
    renames = [
        f"{path.relative_to(PACKAGE)}:{node.lineno}"
        for path in MODULES
        if path != PACKAGE / "files.py"
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)
        if ast.unparse(node.func) in ("os.rename", "os.replace", "shutil.move")
        or (node.func.attr in ("rename", "replace") and len(node.args) == 1 and not node.keywords)
    ]
    assert renames == []
