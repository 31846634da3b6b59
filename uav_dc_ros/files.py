"""Output files: whole or not at all, durable, and never in place of a device or a link.

A regular file is replaced in one move. Of a symbolic link, its target is replaced. A device, a FIFO and a
descriptor of this process (`/dev/stdout`, `/dev/fd/3`) are written into; a FIFO must have its reader by then.
"""

import contextlib
import errno
import os
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from uav_dc_ros.errors import UavDcError

LINKS_MAX = 40  # of a chain, as in Linux itself
# Resolved: `colcon build --symlink-install` reaches the package, and nothing beside it, through a link.
_PACKAGE = Path(__file__).resolve().parent
# Some file systems cannot sync a folder, and some folders may be written, but not opened.
_NOT_SYNCED = (errno.EINVAL, errno.ENOTSUP, errno.EACCES)


def shipped_folder(name: str) -> Path:
    """The folder `policies`, `msgs_json` or one in `share`: inside the package, or beside it in a checkout.

    Raises:
        FileNotFoundError: an installation without it.
    """
    candidates = (_PACKAGE / name, _PACKAGE.parent / name)
    for folder in candidates:
        if folder.is_dir():
            return folder
    raise FileNotFoundError(f"no folder {name}: expected it at {' or '.join(map(str, candidates))}")


def write(path: Path, content: bytes) -> None:
    """Writes a whole file.

    Raises:
        UavDcError: it cannot be written; a regular file that was there is as it was.
    """
    try:
        if is_replaced(path):
            with replacing(path) as partial:
                partial.write_bytes(content)
        else:
            with _opened(path) as file:
                file.write(content)
    except OSError as error:
        raise UavDcError(f"{path} cannot be written: {error.strerror or error}") from None


def is_replaced(path: Path) -> bool:
    """Whether writing `path` replaces a regular file or makes a new one, and does not write into a device."""
    if _descriptor(path) is not None:
        return False
    try:
        return stat.S_ISREG(path.stat().st_mode)
    except FileNotFoundError:
        return True


def refuse_unwritable(path: Path) -> None:
    """Refuse what `write` cannot write: better before the work than after it.

    Raises:
        UavDcError: why it cannot be written.
    """
    try:
        descriptor = _descriptor(path)
        if descriptor is not None:
            os.fstat(descriptor)
        elif path.is_dir():
            raise OSError(errno.EISDIR, os.strerror(errno.EISDIR))
        elif is_replaced(path):
            with tempfile.TemporaryFile(dir=os.path.dirname(os.path.realpath(path))):
                pass
        elif not os.access(path, os.W_OK):
            raise OSError(errno.EACCES, os.strerror(errno.EACCES))
    except OSError as error:
        raise UavDcError(f"{path} cannot be written: {error.strerror}") from None


@contextlib.contextmanager
def replacing(path: Path, *, durable: bool = True) -> Iterator[Path]:
    """A file to write, which becomes `path` when the block ends without an error, and is gone otherwise.

    Args:
        path: the file to write. One that is there keeps its permissions.
        durable: wait for the disk, so that a power cut leaves the old content or the new one.

    Yields:
        The file's path until then.

    Raises:
        OSError: it cannot be written; a regular file that was there is as it was.
    """
    if not is_replaced(path):
        with tempfile.TemporaryDirectory() as folder:
            partial = Path(folder, path.name)
            yield partial
            with partial.open("rb") as made, _opened(path) as file:
                shutil.copyfileobj(made, file)
        return
    target = Path(os.path.realpath(path))
    partial = target.with_name(f".{target.name}.{os.getpid()}.partial")
    try:
        yield partial
        with contextlib.suppress(FileNotFoundError):
            partial.chmod(stat.S_IMODE(target.stat().st_mode))
        place(partial, target, durable=durable)
    finally:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)


@contextlib.contextmanager
def building(folder: Path) -> Iterator[Path]:
    """A folder to fill, which becomes `folder` when the block ends without an error, and is gone otherwise.

    Raises:
        OSError: it cannot be made or renamed, or the disk failed.
    """
    partial = folder.with_name(f".{folder.name}.{os.getpid()}.partial")
    try:
        partial.mkdir(parents=True)
        yield partial
        place(partial, folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def place(made: Path, path: Path, *, durable: bool = True) -> None:
    """Gives a file, or a folder with all that is in it, the name `path` in the same file system.

    Args:
        made: what was made, under its first name.
        path: its new name; a file of that name is replaced.
        durable: have the content on the disk before the name, and the name before this returns.

    Raises:
        OSError: it cannot be renamed, or the disk failed.
    """
    if durable:
        for one in (*made.rglob("*"), made) if made.is_dir() else (made,):
            _sync(one)
    made.replace(path)
    if durable:
        _sync(path.absolute().parent)


def _sync(path: Path) -> None:
    is_folder = path.is_dir()
    try:
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    except OSError as error:
        if not (is_folder and error.errno in _NOT_SYNCED):
            raise


def _opened(path: Path) -> BinaryIO:
    """What is no regular file, to write into."""
    descriptor = _descriptor(path)
    if descriptor is None:
        # With O_NONBLOCK a FIFO that nobody reads is an error (ENXIO), and not waited for without end.
        opened = os.open(path, os.O_WRONLY | os.O_NONBLOCK | os.O_NOCTTY)
        os.set_blocking(opened, True)
        return os.fdopen(opened, "wb")
    sys.stdout.flush()  # what was printed before comes before
    return os.fdopen(os.dup(descriptor), "wb")


def _descriptor(path: Path) -> int | None:
    """The descriptor of this process that a path such as /dev/stdout names.

    Opening such a path would start a regular file anew, and fails for a socket (systemd's journal).
    """
    own = f"/proc/{os.getpid()}/fd"
    for _ in range(LINKS_MAX):
        folder = os.path.realpath(path.parent)
        if folder == own and path.name.isdecimal():
            return int(path.name)
        if not path.is_symlink():
            return None
        path = Path(folder, os.readlink(path))
    return None
