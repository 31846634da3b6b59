"""What the command lines share: mistakes become one line and exit status 2."""

import argparse
import contextlib
import errno
import io
import os
import re
import signal
import sys
from collections.abc import Callable
from typing import Any, NoReturn, TextIO

from uav_dc_ros.errors import UavDcError

# What a shell says of a command that Ctrl-C ended.
INTERRUPTED = 130
NEGATIVE = re.compile(r"-\.?\d")  # how a value begins that is no option: no option begins so
# Of standard output and error: of a file that a command writes, each is a UavDcError by then.
OUTPUT_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EPIPE, errno.EBADF)
BROKEN_PIPE = 141  # what a shell says of a command whose reader went away
NAME = re.compile(r"[A-Za-z](_?[A-Za-z0-9])*_?")  # between the slashes of a ROS name


class Parser(argparse.ArgumentParser):
    """An argument parser whose complaints are one line, and which guesses at no option."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(allow_abbrev=False, **settings)
        self._negative_number_matcher = NEGATIVE  # argparse's own takes -35.3,149.1 for an option

    def error(self, message: str) -> NoReturn:
        """Exits with status 2."""
        sys.exit(complain(f"{self.prog}: {message}"))


def whole_number(least: int) -> Callable[[str], int]:
    """The type of an option that is a whole number of at least `least`."""

    def whole(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = least - 1
        if not least <= value < 2**62:  # so that sums of it still fit into 64 bits
            raise argparse.ArgumentTypeError(
                f"{text!r}; expected a whole number of at least {least}, and below 2^62"
            )
        return value

    return whole


count = whole_number(1)


def namespace(text: str) -> str:
    """The type of an option that is a ROS namespace: absolute, and only the root ends with a slash."""
    names = text.strip("/").split("/")
    if text != "/" and not all(NAME.fullmatch(name) for name in names):
        raise argparse.ArgumentTypeError(
            f"{text!r}; expected a ROS namespace: letters, digits and single '_', beginning with a letter, "
            "with '/' between parts"
        )
    return "/" + "/".join(names)


def on_stop(handler: Callable[..., object]) -> None:
    """Call a handler for each signal that asks to end: Ctrl-C, SIGTERM, and the end of the terminal.

    The last one only where it is not ignored, as under nohup.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, handler)


def run(command: Callable[[], int], prog: str) -> NoReturn:
    """Exits with what `command` returns; with 2 and one line for something the user can mend."""
    open_streams()
    try:
        _check_working_directory()
        try:
            status = command()
        except SystemExit as left:  # --help, or a mistake in the options
            status = left.code if isinstance(left.code, int) else 0
        sys.stdout.flush()
    except UavDcError as error:
        status = complain(f"{prog}: {error}")
    except KeyboardInterrupt:
        complain(f"{prog}: stopped")
        status = INTERRUPTED
    except OSError as error:
        if error.errno not in OUTPUT_ERRORS:
            raise
        if isinstance(error, BrokenPipeError):  # as of `| head`
            status = BROKEN_PIPE
        else:
            status = complain(f"{prog}: the output cannot be written: {error.strerror}")
    for stream in (sys.stdout, sys.stderr):
        _release(stream)
    sys.exit(status)


def complain(text: str) -> int:
    """Prints a line to standard error, if it can be written; returns 2, a mistake's exit status."""
    with contextlib.suppress(OSError):
        print(text, file=sys.stderr, flush=True)
    return 2


def open_streams() -> None:
    """Makes standard input, output and error fit for a command, whatever it was started with.

    A closed one leads nowhere: the next file that is opened must not get its descriptor, and with it what
    others print. A character that the output's encoding lacks is printed as its escape.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest number that is free: this one
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "w" if number else "r", closefd=False))
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _release(stream: TextIO) -> None:
    """Flushes a stream; one that cannot be written leads nowhere then, so that Python ends in silence."""
    try:
        stream.flush()
    except OSError:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


def _check_working_directory() -> None:
    try:
        os.getcwd()
    except FileNotFoundError:
        raise UavDcError("the working directory was deleted; expected one that exists") from None
