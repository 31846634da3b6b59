"""What the command lines share: mistakes become one line and exit status 2."""

import argparse
import re
import signal
import sys
from collections.abc import Callable
from typing import Any, NoReturn

from uav_dc_ros.errors import UavDcError

# What a shell says of a command that Ctrl-C ended.
INTERRUPTED = 130
NEGATIVE = re.compile(r"-\.?\d")  # how a value begins that is no option: no option begins so
NAME = re.compile(r"[A-Za-z](_?[A-Za-z0-9])*_?")  # between the slashes of a ROS name


class Parser(argparse.ArgumentParser):
    """An argument parser whose complaints are one line, and which guesses at no option."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(allow_abbrev=False, **settings)
        self._negative_number_matcher = NEGATIVE  # argparse's own takes -35.3,149.1 for an option

    def error(self, message: str) -> NoReturn:
        """Exits with status 2."""
        self.exit(2, f"{self.prog}: {message}\n")


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
    try:
        sys.exit(command())
    except UavDcError as error:
        print(f"{prog}: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print(f"{prog}: stopped", file=sys.stderr)
        sys.exit(INTERRUPTED)
