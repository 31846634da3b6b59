"""Shards in processes of this machine. A worker that dies is replaced, and goes on from its checkpoint."""

import contextlib
import multiprocessing
import signal
import sys
import traceback
from collections.abc import Sequence
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from pathlib import Path

from uav_dc_ros.errors import TrainingError
from uav_dc_ros.experiments.paper.shards import Shard, Tell, checkpoint_file, keep, train_shard

# Times that a shard is tried before the fault is taken to be its own.
_TRIES = 3


def train_here(shards: Sequence[Shard], folder: Path, n_workers: int, tell: Tell) -> None:
    """Trains shards, `n_workers` at a time, and keeps their results in `folder`.

    Raises:
        TrainingError: a shard failed, or its worker died three times.
    """
    context = multiprocessing.get_context("spawn")  # a fork would inherit threads of torch and numpy
    waiting = [(shard, 1) for shard in shards]
    working: dict[Connection, tuple[SpawnProcess, Shard, int]] = {}
    try:
        while waiting or working:
            while waiting and len(working) < n_workers:
                shard, attempt = waiting.pop(0)
                reader, writer = context.Pipe(duplex=False)
                worker = context.Process(target=_work, args=(shard, folder, writer), daemon=True)
                worker.start()
                writer.close()
                working[reader] = worker, shard, attempt
            for ready in wait(list(working)):
                assert isinstance(ready, Connection)
                worker, shard, attempt = working[ready]
                try:
                    message = ready.recv()
                except (EOFError, OSError):  # the worker is gone
                    worker.join()
                    ready.close()
                    del working[ready]
                    if worker.exitcode != 0:
                        if attempt == _TRIES:
                            raise TrainingError(
                                f"the worker of {shard.name} died {_TRIES} times, at last with exit code "
                                f"{worker.exitcode}; what is done is kept, and --resume goes on"
                            ) from None
                        waiting.insert(0, (shard, attempt + 1))
                    continue
                if isinstance(message, str):
                    raise TrainingError(f"{shard.name} failed: {message}")
                tell(shard.name, message)
    finally:
        for reader, (worker, _, _) in working.items():
            worker.kill()  # its last checkpoint is whole whenever it ends
            worker.join()
            reader.close()


def _work(shard: Shard, folder: Path, parent: Connection) -> None:
    """The worker: one shard, from its checkpoint if there is one, to its result."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to answer

    def tell(_: str, n_flown: int) -> None:
        try:
            parent.send(n_flown)
        except BrokenPipeError:
            sys.exit("the process that asked for this shard is gone")

    try:
        trained = train_shard(shard, checkpoint_file(folder, shard), tell)
        keep(folder, shard, trained.to_bytes())
    except Exception as error:
        if not isinstance(error, TrainingError):
            traceback.print_exc()
        with contextlib.suppress(OSError):
            parent.send(str(error) or repr(error))
        sys.exit(1)
