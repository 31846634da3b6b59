"""Trains in children of one process, which imports torch once: that takes longer than a small training.

    python -m tests.experiments.forks

It reads lines of JSON: a moment at which the child kills itself (a function, the number of its call, before
or after it) or null, arguments of `uav_dc_ros.train`, and a file for all that the child prints. It answers
each with the child's process id, and with its exit status when it has ended.
"""

import json
import os
import pkgutil
import signal
import subprocess
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]


class Child:
    """A training that runs; `process_id` is its own, `output` what it has printed until now."""

    def __init__(self, forks: "Forks", output: Path) -> None:
        self._forks, self._output = forks, output
        self.process_id = forks.answer()

    @property
    def output(self) -> str:
        """What it has printed until now."""
        return self._output.read_text()

    def wait(self) -> int:
        """Its exit status, once it has ended."""
        return self._forks.answer()


class Forks:
    """The process that forks."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._started = folder, 0
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.experiments.forks"],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | {"COLUMNS": "200"},
        )

    def start(self, arguments: list[str], moment: tuple[str, int, str] | None = None) -> Child:
        """A training; one at a time."""
        assert self._process.stdin is not None
        self._started += 1
        output = self._folder / f"{self._started}.output"
        self._process.stdin.write(json.dumps([moment, arguments, str(output)]) + "\n")
        self._process.stdin.flush()
        return Child(self, output)

    def answer(self) -> int:
        """The next number that it reports."""
        assert self._process.stdout is not None
        return int(self._process.stdout.readline())

    def close(self) -> None:
        """End it."""
        self._process.communicate()


def kill_at(path: str, call: int, when: str) -> None:
    """Have this process kill itself before or after a call of something, counted from one."""
    owner_name, name = path.rsplit(".", 1)
    owner, calls = pkgutil.resolve_name(owner_name), []
    function: Callable[..., Any] = getattr(owner, name)

    def killing(*arguments: Any, **values: Any) -> Any:
        calls.append(None)
        if len(calls) == call and when == "before":
            os.kill(os.getpid(), signal.SIGKILL)
        result = function(*arguments, **values)
        if len(calls) == call:
            os.kill(os.getpid(), signal.SIGKILL)
        return result

    setattr(owner, name, killing)


def train(moment: tuple[str, int, str] | None, arguments: list[str], output: str) -> int:
    """Become the process that was ordered; its exit status."""
    from uav_dc_ros.experiments.train import cli

    signal.signal(signal.SIGINT, signal.default_int_handler)
    for file, flags, ends in ((os.devnull, os.O_RDONLY, (0,)), (output, os.O_WRONLY, (1, 2))):
        for end in ends:
            os.dup2(os.open(file, flags | os.O_CREAT | os.O_APPEND), end)
    if moment:
        kill_at(*moment)
    try:
        cli.main(arguments)
    except SystemExit as exit:
        return exit.code if isinstance(exit.code, int) else int(exit.code is not None)
    except BaseException:
        traceback.print_exc()
        return 1
    return 0


def main() -> None:
    """Serve until the input ends."""
    import matplotlib.figure  # noqa: F401
    import torch._dynamo
    import torch.utils.tensorboard  # noqa: F401

    from uav_dc_ros.experiments.train import cli, learning_curve, training  # noqa: F401

    for line in sys.stdin:
        Path(json.loads(line)[2]).touch()
        child = os.fork()
        if not child:
            status = train(*json.loads(line))
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status)
        print(child, flush=True)
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)


if __name__ == "__main__":
    main()
