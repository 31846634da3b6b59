"""Play on a terminal: a real pseudo-terminal, with the command in its foreground, as under a shell."""

import os
import pty
import select
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import Ros, until
from tests.nodes.play.test_play import (
    LATCHED,
    MS,
    VOLATILE,
    Messages,
    count_received,
    listener,
    made,
    numbers,
    received_by,
)

# A shell that starts a command in its foreground or background, and waits for its end.
SHELL = """
import fcntl, os, signal, subprocess, sys, termios
os.setsid()
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
signal.signal(signal.SIGTTOU, signal.SIG_IGN)
where, *command = sys.argv[1:]
own = lambda: (os.setpgid(0, 0), signal.signal(signal.SIGTTOU, signal.SIG_DFL))
child = subprocess.Popen(command, preexec_fn=own)
if where == "foreground":
    os.tcsetpgrp(0, child.pid)
sys.exit(child.wait() % 256)
"""


class Terminal:
    """A terminal, with a command in the foreground or background of a shell."""

    def __init__(self, ros: Ros, *arguments: object, where: str = "foreground") -> None:
        self._ours, self._theirs = pty.openpty()
        self.before = self.settings()
        self.shown = ""

        command = [sys.executable, "-m", "uav_dc_ros.bag", "play", *map(str, arguments)]
        self.shell = subprocess.Popen(
            [sys.executable, "-c", SHELL, where, *command],
            env={**ros.environment, "TERM": "xterm", "COLUMNS": "100"},
            cwd=ros.folder,
            stdin=self._theirs,
            stdout=self._theirs,
            stderr=self._theirs,
        )

    @property
    def play(self) -> int:
        """Process id of the command."""
        children = Path(f"/proc/{self.shell.pid}/task/{self.shell.pid}/children")
        until(children.read_text)
        return int(children.read_text())

    def settings(self) -> list[Any]:
        """How the terminal is set."""
        return termios.tcgetattr(self._theirs)

    def press(self, keys: str) -> None:
        """Press some keys."""
        os.write(self._ours, keys.encode())

    def look(self) -> str:
        """All that was shown so far."""
        while select.select([self._ours], [], [], 0.02)[0]:
            self.shown += os.read(self._ours, 65536).decode(errors="replace")
        return self.shown

    def wait_for(self, text: str) -> None:
        """Wait until a text is shown, from now on."""
        self.look()
        at = len(self.shown)
        until(lambda: text in self.look()[at:])

    def ended(self) -> int:
        """Wait for the end; the exit status."""
        until(lambda: (self.look(), self.shell.poll())[1] is not None)
        return self.shell.returncode

    def close(self) -> None:
        """End whatever is left."""
        if self.shell.poll() is None:
            os.kill(self.play, signal.SIGKILL)
            self.shell.wait()
        os.close(self._ours)
        os.close(self._theirs)


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """Two thousand numbers in ten seconds."""
    return made(tmp_path / "bag", {"/a": LATCHED}, numbers("/a", 2000, 5.0))


@pytest.fixture
def paused(ros: Ros, bag: Path) -> Iterator[tuple[Terminal, "subprocess.Popen[str]"]]:
    """A play that begins with a pause, and a listener."""
    listens = listener(ros, "/a", latched=True)
    terminal = Terminal(ros, bag, "--paused", "--wait-for-subscribers", 20)
    try:
        terminal.wait_for("paused")
        yield terminal, listens
    finally:
        terminal.close()
        listens.communicate()


def test_keys_pause_step_change_the_rate_and_quit(paused: tuple[Terminal, "subprocess.Popen[str]"]) -> None:
    terminal, listens = paused
    assert terminal.settings() != terminal.before
    assert count_received(listens) == 0
    terminal.press("s")
    until(lambda: count_received(listens) == 1)
    terminal.press("n\x1b[C")  # the arrow to the right
    until(lambda: count_received(listens) == 3)
    time.sleep(0.3)
    assert count_received(listens) == 3
    terminal.press("+")
    terminal.wait_for("rate 1.25,")
    terminal.press("\x1b[B-")
    terminal.wait_for("rate 0.8,")
    terminal.press(" ")
    until(lambda: count_received(listens) > 20)
    terminal.press(" ")
    terminal.wait_for("paused")
    still = count_received(listens)
    time.sleep(0.3)
    assert count_received(listens) == still < 1500
    terminal.press("q")
    assert terminal.ended() == 0
    assert terminal.settings() == terminal.before
    assert [int(content) for _, content, *_ in received_by(listens)] == list(range(still))
    assert "space: pause" in terminal.shown
    assert "Traceback" not in terminal.shown


@pytest.mark.parametrize("how", ["ctrl-c", "terminate"])
def test_the_terminal_is_left_as_it_was(paused: tuple[Terminal, "subprocess.Popen[str]"], how: str) -> None:
    terminal, _ = paused
    if how == "ctrl-c":
        terminal.press("\x03")
    else:
        os.kill(terminal.play, signal.SIGTERM)
    assert terminal.ended() == 130
    assert terminal.settings() == terminal.before
    assert "stopped" in terminal.shown
    assert "Traceback" not in terminal.shown


def test_a_stop_and_its_end_lose_no_time_of_the_bag(ros: Ros, bag: Path) -> None:
    """Ctrl-Z gives the terminal back; time stands still until it goes on."""
    listens = listener(ros, "/a", latched=True)
    terminal = Terminal(ros, bag, "--wait-for-subscribers", 20)
    try:
        until(lambda: count_received(listens) > 10)
        terminal.press("\x1a")
        state = Path(f"/proc/{terminal.play}/stat")
        until(lambda: state.read_text().rsplit(")", 1)[1].split()[0] == "T")
        assert terminal.settings() == terminal.before
        stopped_ns = time.time_ns()
        time.sleep(1.5)
        os.kill(terminal.play, signal.SIGCONT)
        until(lambda: terminal.settings() != terminal.before)
        terminal.wait_for("playing")
        terminal.press("q")
        assert terminal.ended() == 0
        assert terminal.settings() == terminal.before
    finally:
        terminal.close()
    sent = [(int(number), at_ns) for _, number, at_ns, _ in received_by(listens)]
    # A busy machine sends a message late, never early: the schedule is that of the messages sent soonest.
    before, after = (
        min(at_ns - number * 5 * MS for number, at_ns in sent if (at_ns > stopped_ns) == late)
        for late in (False, True)
    )
    assert after - before > 1.5e9


def test_a_play_in_the_background_takes_no_keys_and_is_not_stopped(ros: Ros, bag: Path) -> None:
    """`play bag &`: the terminal stops a background process that changes its settings."""
    terminal = Terminal(ros, bag, "--duration", 0.1, where="background")
    try:
        assert terminal.ended() == 0, terminal.shown
    finally:
        terminal.close()
    assert "published 20 messages" in terminal.shown
    assert "space: pause" not in terminal.shown


def test_what_was_latched_reaches_who_comes_late(ros: Ros, tmp_path: Path) -> None:
    """As much as the recorded publisher kept, and from before --start as well; no more of what is not."""
    messages: Messages = [*numbers("/state", 5, 10.0), *numbers("/event", 5, 10.0)]
    messages.sort(key=lambda each: each[1])
    messages += [("/state", 3500.0, "new"), ("/event", 8000.0, "end")]
    bag = made(tmp_path / "bag", {"/state": LATCHED, "/event": VOLATILE}, messages)
    terminal = Terminal(ros, bag, "--start", 2, "--paused")
    try:
        terminal.wait_for("paused")
        early = listener(ros, "/state", "/event")
        late = listener(ros, "/state", latched=True)
        until(lambda: count_received(late) == 2)
        terminal.press("s")
        until(lambda: count_received(late) == 3)
        later = listener(ros, "/state", latched=True)
        until(lambda: count_received(later) == 2)
        terminal.press("s")
        assert terminal.ended() == 0
    finally:
        terminal.close()
    assert [content for _, content, *_ in received_by(late)] == ["3", "4", "new"]
    assert [content for _, content, *_ in received_by(later)] == ["4", "new"]
    assert [content for _, content, *_ in received_by(early)] == ["new", "end"]
