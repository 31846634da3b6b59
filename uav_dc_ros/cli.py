"""What all commands share: options, exit statuses, and standard output and error."""

import argparse
import atexit
import contextlib
import errno
import io
import math
import os
import queue
import re
import signal
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import IO, TYPE_CHECKING, Any, NoReturn, Self, TextIO, cast

from uav_dc_ros import __version__
from uav_dc_ros.errors import ParameterError, UavDcError

if TYPE_CHECKING:  # rich takes as long to import as the rest of a command line
    from rich.console import Console
    from rich.progress import ProgressColumn

FAILED = 2
INTERRUPTED = 130  # as a shell reports a command that Ctrl-C ended
BROKEN_PIPE = 141  # as a shell reports a command whose reader closed the pipe
NEGATIVE = re.compile(r"-\.?\d")  # the start of a negative number: no option starts like this
# Errors of standard output and error. An error of any other file is a UavDcError at this point.
OUTPUT_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EPIPE, errno.EBADF)
NAME = re.compile(r"[A-Za-z](_?[A-Za-z0-9])*_?")  # between the slashes of a ROS name
QUEUE_MAX = 10_000  # pieces of text; further ones are dropped
DRAIN_S = 2.0


class Parser(argparse.ArgumentParser):
    """An argument parser that reports an error in one line and accepts no abbreviated options."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(allow_abbrev=False, **settings)
        self._negative_number_matcher = NEGATIVE  # argparse's own takes -35.3,149.1 for an option

    def error(self, message: str) -> NoReturn:
        """Exit with status 2."""
        sys.exit(print_error(f"{self.prog}: {message}"))


def whole_number(minimum: int, maximum: int | None = None, expected: str = "") -> Callable[[str], int]:
    """The type of an option that is a whole number within a range, its ends included."""

    def whole(text: str) -> int:
        # int() also reads blanks, underscores and the digits of other scripts.
        value = int(text) if re.fullmatch(r"-?[0-9]{1,19}", text) else minimum - 1
        if not minimum <= value < (2**62 if maximum is None else maximum + 1):  # sums of it fit into 64 bits
            default = f"a whole number of at least {minimum}, and below 2^62"
            raise argparse.ArgumentTypeError(f"{text!r}; expected {expected or default}")
        return value

    return whole


count = whole_number(1)


def number(minimum: float, maximum: float, expected: str) -> Callable[[str], float]:
    """The type of an option that is a number within a range, its ends included."""

    def parse(text: str) -> float:
        try:
            value = math.nan if "_" in text else float(text)  # Python's own notation
        except ValueError:
            value = math.nan
        if not minimum <= value <= maximum:
            raise argparse.ArgumentTypeError(f"{text!r}; expected {expected}")
        return value

    return parse


def names(expected: str, start: str = "", among: Sequence[str] = ()) -> Callable[[str], tuple[str, ...]]:
    """The type of an option that lists names, separated by commas, each once and with the same start."""

    def parse(text: str) -> tuple[str, ...]:
        found = tuple(name.strip() for name in text.split(","))
        if among and (unknown := [name for name in found if name not in among]):
            raise argparse.ArgumentTypeError(f"{unknown[0]!r}; expected some of {', '.join(among)}")
        if not all(name and name.startswith(start) for name in found) or len(set(found)) < len(found):
            raise argparse.ArgumentTypeError(f"{text!r}; expected {expected}, each once, with ',' between")
        return found

    return parse


def add_namespace(parser: argparse.ArgumentParser, help: str) -> None:
    """Add `--namespace`, a ROS namespace, to a command."""
    parser.add_argument("--namespace", type=namespace, default="/", metavar="NS", help=help)


def namespace(text: str) -> str:
    """The type of an option that is a ROS namespace: absolute, and only the root ends with a slash."""
    names = text.strip("/").split("/")
    if text != "/" and not all(NAME.fullmatch(name) for name in names):
        raise argparse.ArgumentTypeError(
            f"{text!r}; expected a ROS namespace: letters, digits and single '_', beginning with a letter, "
            "with '/' between parts"
        )
    return "/" + "/".join(names)


def without_verb(word: str, verbs: Mapping[str, tuple[str, str]], prog: str, description: str) -> int:
    """Print help or version of a command with verbs (a module and a description each) as `word` requests."""
    if word == "--version":
        print(__version__)
    elif word in ("-h", "--help"):
        width = max(map(len, verbs))
        lines = "\n".join(f"  {verb:<{width}}  {does}" for verb, (_, does) in verbs.items())
        usage = f"usage: {prog} VERB ..."
        print(f"{usage}\n\n{description}\n\n{lines}\n\n{prog} VERB --help lists its options.")
    else:
        raise ParameterError(f"{word!r}; expected a verb: {', '.join(verbs)}")
    return 0


def on_stop(handler: Callable[..., object]) -> None:
    """Handle SIGINT, SIGTERM and, unless it is ignored (nohup), SIGHUP."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, handler)


def run(command: Callable[[], int], prog: str) -> NoReturn:
    """Exit with the status that `command` returns; a UavDcError is one line and status 2."""
    open_streams()
    try:
        try:
            os.getcwd()
        except FileNotFoundError:
            raise UavDcError("the working directory was deleted; expected one that exists") from None
        try:
            status = command()
        except SystemExit as exited:  # --help, or an invalid option
            status = exited.code if isinstance(exited.code, int) else 0
        sys.stdout.flush()
    except UavDcError as error:
        status = print_error(f"{prog}: {error}")
    except KeyboardInterrupt:
        print_error(f"{prog}: stopped")
        status = INTERRUPTED
    except OSError as error:
        if error.errno not in OUTPUT_ERRORS:
            raise
        if isinstance(error, BrokenPipeError):  # as of `| head`
            status = BROKEN_PIPE
        else:
            status = print_error(f"{prog}: the output cannot be written: {error.strerror}")
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:  # redirect it, so that Python exits without a traceback
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, stream.fileno())
            os.close(null)
    sys.exit(status)


def print_error(text: str) -> int:
    """Print a line to standard error, if possible; returns the exit status of a failed command."""
    with contextlib.suppress(OSError):
        print(text, file=sys.stderr, flush=True)
    return FAILED


def open_streams() -> None:
    """Open closed standard streams on /dev/null, and escape characters that the output's encoding lacks.

    Otherwise the next file that is opened gets the descriptor of a closed stream, and receives its output.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest free number: this one
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "w" if number else "r", closefd=False))
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


class Output:
    """Writes text of consoles in a thread, or drops it: a full disk or stalled terminal blocks no caller."""

    def __init__(self) -> None:
        self._queue: queue.Queue[tuple[int, bytes] | threading.Event] = queue.Queue(QUEUE_MAX)
        threading.Thread(target=self._write, name="output", daemon=True).start()
        atexit.register(self.drain)

    def console(self, stream: TextIO) -> "Console":
        """A rich console that prints to `stream`, which is sys.stdout or sys.stderr."""
        from rich.console import Console

        return Console(file=cast(IO[str], _OutputStream(self, stream)), highlight=False, soft_wrap=True)

    def put(self, descriptor: int, data: bytes) -> None:
        """Queue data for writing; never blocks."""
        with contextlib.suppress(queue.Full):
            self._queue.put_nowait((descriptor, data))

    def drain(self) -> None:
        """Wait until the queue is written, at most `DRAIN_S`."""
        written = threading.Event()
        with contextlib.suppress(queue.Full):
            self._queue.put(written, timeout=DRAIN_S)
            written.wait(DRAIN_S)

    def _write(self) -> None:
        while True:
            piece = self._queue.get()
            if isinstance(piece, threading.Event):
                piece.set()
                continue
            descriptor, data = piece
            with contextlib.suppress(OSError):
                while data:
                    data = data[os.write(descriptor, data) :]


class _OutputStream(io.TextIOBase):
    """The part of a text stream that rich's consoles need; `Output` writes its text to `target`."""

    def __init__(self, output: Output, target: TextIO) -> None:
        self._output, self._target = output, target

    @property
    def encoding(self) -> str:  # type: ignore[override]  # io's own is an attribute
        return self._target.encoding

    def isatty(self) -> bool:
        return self._target.isatty()

    def write(self, text: str) -> int:
        self._output.put(self._target.fileno(), text.encode(self.encoding, "backslashreplace"))
        return len(text)


class LiveDisplay:
    """A progress bar on a terminal, plain lines elsewhere; a context manager.

    `columns` follow the description and the bar itself; `settings` are those of rich's Progress.
    """

    def __init__(self, *columns: "ProgressColumn", **settings: Any) -> None:
        from rich.progress import BarColumn, Progress, TextColumn

        self._output = Output()
        self.console = self._output.console(sys.stdout)
        self.errors = self._output.console(sys.stderr)
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            *columns,
            console=self.console,
            disable=not self.console.is_terminal,
            **settings,
        )

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()
        self._output.drain()
