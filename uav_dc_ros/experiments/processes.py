"""Tasks in processes of this machine, one core each. A task saves its result; a killed one is begun again."""

import contextlib
import multiprocessing
import signal
import sys
import traceback
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Protocol, TypeAlias, TypeVar

from uav_dc_ros.errors import TrainingError, UavDcError

_TRIES = 3  # of a task whose process dies

OnProgress: TypeAlias = Callable[[str, int], None]  # gets the name of a task, and a number that grows


class Task(Protocol):
    """What a process does; it travels by pickle."""

    @property
    def name(self) -> str:
        """Its name in errors and progress."""


T = TypeVar("T", bound=Task)
Work: TypeAlias = Callable[[T, Callable[[int], None]], None]


def run_tasks(tasks: Sequence[T], work: Work[T], n_workers: int, on_progress: OnProgress, again: str) -> None:
    """Do all tasks, `n_workers` at a time.

    `work` (pickled, too) gets a task and what reports its progress, and saves the result. A process that dies
    is replaced: `work` begins again, with what it has saved. `again` is the end of the error's sentence,
    "finished ones are saved, and ...".

    Raises:
        TrainingError: a task failed, or its process died three times.
    """
    context = multiprocessing.get_context("spawn")  # a fork would inherit threads of torch and numpy
    waiting = [(task, 1) for task in tasks]
    working: dict[Connection, tuple[SpawnProcess, T, int]] = {}
    try:
        while waiting or working:
            while waiting and len(working) < n_workers:
                task, attempt = waiting.pop(0)
                reader, writer = context.Pipe(duplex=False)
                worker = context.Process(target=_work, args=(work, task, writer), daemon=True)
                worker.start()
                writer.close()
                working[reader] = worker, task, attempt
            for ready in wait(list(working)):
                assert isinstance(ready, Connection)
                worker, task, attempt = working[ready]
                try:
                    message = ready.recv()
                except (EOFError, OSError):  # the worker has ended
                    worker.join()
                    ready.close()
                    del working[ready]
                    if worker.exitcode != 0:
                        if attempt == _TRIES:
                            raise TrainingError(
                                f"the worker of {task.name} died {_TRIES} times, at last with exit code "
                                f"{worker.exitcode}; finished ones are saved, and {again}"
                            ) from None
                        waiting.insert(0, (task, attempt + 1))
                    continue
                if isinstance(message, str):
                    raise TrainingError(f"{task.name} failed: {message}")
                on_progress(task.name, message)
    finally:
        for reader, (worker, _, _) in working.items():
            worker.kill()  # what is saved is complete at any moment
            worker.join()
            reader.close()


def _work(work: Work[T], task: T, parent: Connection) -> None:
    """In a worker: do a task; send progress, or an error message, to the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C

    def on_progress(done: int) -> None:
        try:
            parent.send(done)
        except BrokenPipeError:
            sys.exit("the parent process has ended")

    try:
        work(task, on_progress)
    except Exception as error:
        if not isinstance(error, UavDcError):
            traceback.print_exc()
        with contextlib.suppress(OSError):
            parent.send(str(error) or repr(error))
        sys.exit(1)
