"""Output files: written completely or not at all, durable, and never in place of a device or a link.

A regular file is replaced by a rename. Of a symbolic link, the target is replaced. A device, a FIFO and a
descriptor of this process (`/dev/stdout`, `/dev/fd/3`) are opened and written; a FIFO must have a reader.
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

LINKS_MAX = 40  # of a chain, Linux's own limit
# Resolved: `colcon build --symlink-install` links only the package, and nothing beside it.
_PACKAGE = Path(__file__).resolve().parent
# Some file systems cannot sync a folder, and some folders can be written, but not opened.
_FOLDER_SYNC_ERRORS = (errno.EINVAL, errno.ENOTSUP, errno.EACCES)


def shipped_folder(name: str) -> Path:
    """The folder `policies`, `msgs_json` or one in `share`: in the package, or beside it in a checkout.

    Raises FileNotFoundError if the installation lacks it.
    """
    candidates = (_PACKAGE / name, _PACKAGE.parent / name)
    for folder in candidates:
        if folder.is_dir():
            return folder
    raise FileNotFoundError(f"no folder {name}: expected it at {' or '.join(map(str, candidates))}")


def write(path: Path, content: bytes) -> None:
    """Write a whole file; after a UavDcError a regular file keeps its previous content."""
    try:
        if is_replaced(path):
            with replacing(path) as partial:
                partial.write_bytes(content)
        else:
            with _open_special(path) as file:
                file.write(content)
    except OSError as error:
        raise UavDcError(f"{path} cannot be written: {error.strerror or error}") from None


def is_replaced(path: Path) -> bool:
    """Whether `write` makes or replaces a regular file, instead of writing into a device."""
    if _descriptor(path) is not None:
        return False
    try:
        return stat.S_ISREG(path.stat().st_mode)
    except FileNotFoundError:
        return True


def check_writable(path: Path) -> None:
    """Raise UavDcError, before any work is done, for what `write` cannot write."""
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
    """A temporary file that replaces `path` if the block succeeds, and is removed otherwise.

    An existing file keeps its permissions, and its content after an OSError. With `durable`, a power cut
    leaves the old content or the new one.
    """
    if not is_replaced(path):
        with tempfile.TemporaryDirectory() as folder:
            partial = Path(folder, path.name)
            yield partial
            with partial.open("rb") as source, _open_special(path) as file:
                shutil.copyfileobj(source, file)
        return
    target = Path(os.path.realpath(path))
    partial = target.with_name(f".{target.name}.{os.getpid()}.partial")
    try:
        yield partial
        with contextlib.suppress(FileNotFoundError):
            partial.chmod(stat.S_IMODE(target.stat().st_mode))
        move(partial, target, durable=durable)
    finally:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)


@contextlib.contextmanager
def building(folder: Path) -> Iterator[Path]:
    """A temporary folder that becomes `folder` if the block succeeds, and is removed otherwise (OSError)."""
    partial = folder.with_name(f".{folder.name}.{os.getpid()}.partial")
    try:
        partial.mkdir(parents=True)
        yield partial
        move(partial, folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def move(source: Path, path: Path, *, durable: bool = True) -> None:
    """Rename a file, or a folder, to `path` in the same file system; a file of that name is replaced.

    With `durable`, the content is synced to disk before the rename, and the rename before this returns.
    """
    if durable:
        for entry in (*source.rglob("*"), source) if source.is_dir() else (source,):
            _sync(entry)
    source.replace(path)
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
        if not (is_folder and error.errno in _FOLDER_SYNC_ERRORS):
            raise


def _open_special(path: Path) -> BinaryIO:
    """A device, a FIFO or a descriptor, open for writing."""
    descriptor = _descriptor(path)
    if descriptor is None:
        # With O_NONBLOCK a FIFO without a reader is an error (ENXIO) instead of an endless wait.
        opened = os.open(path, os.O_WRONLY | os.O_NONBLOCK | os.O_NOCTTY)
        os.set_blocking(opened, True)
        return os.fdopen(opened, "wb")
    sys.stdout.flush()  # keeps the order of earlier prints
    return os.fdopen(os.dup(descriptor), "wb")


def _descriptor(path: Path) -> int | None:
    """The descriptor of this process that a path such as /dev/stdout names.

    Opening such a path would truncate a regular file, and fails for a socket (systemd's journal).
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
