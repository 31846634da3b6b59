"""Trains shards in parallel: in processes of this machine, or on a Ray cluster.

Ray is in the extra `cluster`; every node of the cluster needs this package with torch.
"""

import contextlib
import logging
import multiprocessing
import os
import signal
import socket
import sys
import traceback
from collections.abc import Sequence
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from pathlib import Path

from uav_dc_ros import __version__
from uav_dc_ros.errors import TrainingError
from uav_dc_ros.experiments.paper.shards import (
    OnProgress,
    Shard,
    checkpoint_file,
    code_hash,
    save_result,
    train_shard,
)

_TRIES = 3  # of a shard whose worker dies, on this machine
_RAY_RETRIES = 5  # of a shard whose worker or node dies, on a cluster


def train_locally(shards: Sequence[Shard], folder: Path, n_workers: int, on_progress: OnProgress) -> None:
    """Trains shards, `n_workers` at a time, and saves their results in `folder`.

    A worker that dies is replaced; the new one resumes from the checkpoint. Raises TrainingError if a shard
    failed, or its worker died three times.
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
                except (EOFError, OSError):  # the worker has ended
                    worker.join()
                    ready.close()
                    del working[ready]
                    if worker.exitcode != 0:
                        if attempt == _TRIES:
                            raise TrainingError(
                                f"the worker of {shard.name} died {_TRIES} times, at last with exit code "
                                f"{worker.exitcode}; finished shards are saved, and --resume continues"
                            ) from None
                        waiting.insert(0, (shard, attempt + 1))
                    continue
                if isinstance(message, str):
                    raise TrainingError(f"{shard.name} failed: {message}")
                on_progress(shard.name, message)
    finally:
        for reader, (worker, _, _) in working.items():
            worker.kill()  # a checkpoint is complete at any moment
            worker.join()
            reader.close()


def _work(shard: Shard, folder: Path, parent: Connection) -> None:
    """In a worker: trains a shard; sends episodes flown, or an error message, to the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C

    def on_progress(_: str, n_flown: int) -> None:
        try:
            parent.send(n_flown)
        except BrokenPipeError:
            sys.exit("the parent process has ended")

    try:
        trained = train_shard(shard, checkpoint_file(folder, shard), on_progress)
        save_result(folder, shard, trained.to_bytes())
    except Exception as error:
        if not isinstance(error, TrainingError):
            traceback.print_exc()
        with contextlib.suppress(OSError):
            parent.send(str(error) or repr(error))
        sys.exit(1)


def train_on_ray(shards: Sequence[Shard], folder: Path, address: str, on_progress: OnProgress) -> None:
    """Trains shards, one to a core of the cluster, and saves their results in `folder` of this machine.

    Ray restarts a shard whose worker or node dies. `address` is that of `ray.init`, such as `HOST:6379`,
    `ray://HOST:10001`, or `auto`. `on_progress` is called for finished shards only. Raises TrainingError if
    ray is not installed, the cluster cannot be reached, or a shard failed.
    """
    try:
        import ray
    except ModuleNotFoundError:
        raise TrainingError(
            '--ray: ray is not installed; expected it from: pip install "uav_dc_ros[cluster]"'
        ) from None
    _check_reachable(address)
    # Silences a warning of Ray; errors are raised.
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    try:
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
    except (ConnectionError, ValueError, RuntimeError, TimeoutError) as error:
        raise TrainingError(f"--ray {address}: no cluster answers: {str(error).splitlines()[0]}") from None
    try:
        task = ray.remote(_work_on_node).options(num_cpus=1, max_retries=_RAY_RETRIES)
        pending = {task.remote(shard, code_hash()): shard for shard in shards}
        while pending:
            done, _ = ray.wait(list(pending))
            shard = pending.pop(done[0])
            try:
                save_result(folder, shard, ray.get(done[0]))
            except ray.exceptions.RayTaskError as error:
                raise TrainingError(f"{shard.name} failed: {error.cause}") from None
            except ray.exceptions.RayError as error:
                raise TrainingError(
                    f"{shard.name} failed {_RAY_RETRIES + 1} times on the cluster: "
                    f"{str(error).splitlines()[0]}"
                ) from None
            on_progress(shard.name, shard.population.n_episodes)
    finally:
        ray.shutdown()


def _check_reachable(address: str) -> None:
    """Raises TrainingError if no cluster listens there: Ray would retry for minutes, then end the process."""
    if address == "auto":  # Ray finds it
        return
    host, _, port = address.removeprefix("ray://").rpartition(":")
    try:
        socket.create_connection((host, int(port)), timeout=5.0).close()
    except ValueError:
        raise TrainingError(f"--ray {address!r}; expected HOST:PORT, ray://HOST:PORT or auto") from None
    except OSError as error:
        raise TrainingError(f"--ray {address}: no cluster answers: {error.strerror or error}") from None


def _work_on_node(shard: Shard, expected: str) -> bytes:
    """On a node of the cluster: trains a shard, if the node's code has the expected hash."""
    if expected != code_hash():
        raise TrainingError(
            f"a node has uav_dc_ros {__version__} with code {code_hash()}; expected code {expected}, "
            "as on this machine"
        )
    return train_shard(shard).to_bytes()
