"""Trains shards in parallel: in processes of this machine, or on a Ray cluster.

Ray is in the extra `cluster`; every node of the cluster needs this package with torch.
"""

import logging
import os
import socket
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from uav_dc_ros import __version__
from uav_dc_ros.errors import TrainingError
from uav_dc_ros.experiments.paper.shards import Shard, checkpoint_file, code_hash, save_result, train_shard
from uav_dc_ros.experiments.processes import OnProgress, run_tasks

_RAY_RETRIES = 5  # of a shard whose worker or node dies, on a cluster


def train_locally(shards: Sequence[Shard], folder: Path, n_workers: int, on_progress: OnProgress) -> None:
    """Trains shards, `n_workers` at a time, and saves their results in `folder`.

    A worker that dies is replaced; the new one resumes from the checkpoint. Raises TrainingError if a shard
    failed, or its worker died three times.
    """
    run_tasks(shards, partial(_train, folder), n_workers, on_progress, "--resume continues")


def _train(folder: Path, shard: Shard, on_progress: Callable[[int], None]) -> None:
    trained = train_shard(shard, checkpoint_file(folder, shard), on_progress)
    save_result(folder, shard, trained.to_bytes())


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
