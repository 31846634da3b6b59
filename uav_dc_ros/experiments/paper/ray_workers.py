"""Shards on a Ray cluster. Needs ray (extra `cluster`), and this package with torch on every node."""

import logging
import os
import socket
from collections.abc import Sequence
from pathlib import Path

from uav_dc_ros import __version__
from uav_dc_ros.errors import TrainingError
from uav_dc_ros.experiments.paper.shards import Shard, Tell, code, keep, train_shard

# Times that Ray starts a shard anew when its worker or its node dies.
_RETRIES = 5


def train_on_ray(shards: Sequence[Shard], folder: Path, address: str, tell: Tell) -> None:
    """Trains shards, one to a core of the cluster, and keeps their results in `folder`.

    A shard whose worker or node dies is started anew elsewhere.

    Args:
        shards: what to train.
        folder: of this machine; nothing of it need be seen by the cluster.
        address: as `ray.init` takes it, such as `HOST:6379`, `ray://HOST:10001`, or `auto`.
        tell: hears of the shards that are done.

    Raises:
        TrainingError: ray is not installed, there is no such cluster, or a shard failed.
    """
    try:
        import ray
    except ModuleNotFoundError:
        raise TrainingError(
            '--ray: ray is not installed; expected it from: pip install "uav_dc_ros[cluster]"'
        ) from None
    _knock(address)
    # Ray says a lot to whoever starts it; what a user must know comes as an error.
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    try:
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
    except (ConnectionError, ValueError, RuntimeError, TimeoutError) as error:
        raise TrainingError(f"--ray {address}: no cluster answers: {str(error).splitlines()[0]}") from None
    try:
        task = ray.remote(_work).options(num_cpus=1, max_retries=_RETRIES)
        pending = {task.remote(shard, code()): shard for shard in shards}
        while pending:
            done, _ = ray.wait(list(pending))
            shard = pending.pop(done[0])
            try:
                keep(folder, shard, ray.get(done[0]))
            except ray.exceptions.RayTaskError as error:
                raise TrainingError(f"{shard.name} failed: {error.cause}") from None
            except ray.exceptions.RayError as error:
                raise TrainingError(
                    f"{shard.name} failed {_RETRIES + 1} times on the cluster: {str(error).splitlines()[0]}"
                ) from None
            tell(shard.name, shard.population.n_episodes)
    finally:
        ray.shutdown()


def _knock(address: str) -> None:
    """Raises TrainingError when nobody listens there: Ray would try for minutes, then end the process."""
    if address == "auto":
        return  # Ray looks for it
    host, _, port = address.removeprefix("ray://").rpartition(":")
    try:
        socket.create_connection((host, int(port)), timeout=5.0).close()
    except ValueError:
        raise TrainingError(f"--ray {address!r}; expected HOST:PORT, ray://HOST:PORT or auto") from None
    except OSError as error:
        raise TrainingError(f"--ray {address}: no cluster answers: {error.strerror or error}") from None


def _work(shard: Shard, asked: str) -> bytes:
    """On a node of the cluster: trains a shard; gives back its result."""
    if asked != code():
        raise TrainingError(
            f"a node has uav_dc_ros {__version__} with code {code()}; expected code {asked}, as the asker has"
        )
    return train_shard(shard).to_bytes()
