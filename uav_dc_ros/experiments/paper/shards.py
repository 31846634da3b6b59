"""Shards: populations that train independently, each in one process on one core, here or on a Ray cluster.

The division of runs into shards does not depend on the number or place of the workers, so neither do the
results, as long as the cores are alike (another kind of core rounds differently). A folder holds one file for
the result of each shard. A shard whose file exists is not trained again; an interrupted one resumes from its
checkpoint. The workers need torch.
"""

import hashlib
import time
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path

import msgspec
import numpy as np
import safetensors.numpy
from safetensors import SafetensorError

import uav_dc_ros
from uav_dc_ros import files
from uav_dc_ros.agents import network
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.errors import TrainingError
from uav_dc_ros.experiments.code_hash import code_hash_of
from uav_dc_ros.experiments.evaluate.rollout import Missions
from uav_dc_ros.experiments.train.population import Population

_CHECKPOINT_EVERY_S = 30.0
# The modules that train a shard; everything that they import decides its result.
ROOTS = ("uav_dc_ros.experiments.paper.shards", "uav_dc_ros.experiments.train.checkpoint")


class Shard(msgspec.Struct, frozen=True, kw_only=True):
    """A population, and the greedy missions of its policies after training."""

    population: Population
    greedy_seeds: tuple[int, int]  # first seed of the greedy missions, and their number

    @property
    def name(self) -> str:
        """Hash of its content and of the code: equal names mean equal results."""
        content = msgspec.json.encode((self, code_hash()))
        return f"shard_{hashlib.sha256(content).hexdigest()[:16]}"

    @property
    def n_steps(self) -> int:
        """Agent-steps of all its runs."""
        population = self.population
        return len(population.runs) * population.n_episodes * population.scenario.mission.max_steps


@dataclass(frozen=True, kw_only=True)
class ShardResult:
    """The result of a shard of N runs."""

    curves: dict[str, Array]  # by `episode_stats.CURVES`, float32 `[T, N]`
    greedy: Missions  # after training, `[N, S]` each
    parameters: list[network.Parameters]  # of each run's network

    def to_bytes(self) -> bytes:
        """One safetensors file."""
        arrays = {f"curves.{name}": values for name, values in self.curves.items()}
        greedy = {f.name: getattr(self.greedy, f.name) for f in fields(Missions)}
        arrays |= {f"greedy.{name}": np.asarray(v) for name, v in greedy.items() if v is not None}
        for run, parameters in enumerate(self.parameters):
            arrays |= {f"parameters.{run}.{name}": values for name, values in parameters.items()}
        return safetensors.numpy.save({name: np.ascontiguousarray(v) for name, v in arrays.items()})

    @classmethod
    def from_bytes(cls, content: bytes) -> "ShardResult":
        """The inverse of `to_bytes`; raises SafetensorError, KeyError or ValueError for other content."""
        parts: dict[str, dict[str, Array]] = {"curves": {}, "greedy": {}}
        parameters: dict[int, network.Parameters] = {}
        for key, values in safetensors.numpy.load(content).items():
            part, _, name = key.partition(".")
            if part == "parameters":
                run, _, name = name.partition(".")
                parameters.setdefault(int(run), {})[name] = values
            else:
                parts[part][name] = values
        return cls(
            curves=parts["curves"],
            greedy=Missions(**{f.name: parts["greedy"].get(f.name) for f in fields(Missions)}),
            parameters=[parameters[run] for run in range(len(parameters))],
        )


def train_shard(
    shard: Shard, checkpoint: Path | None = None, on_progress: Callable[[int], None] | None = None
) -> ShardResult:
    """Trains a shard on one core; saves its state in `checkpoint`, and resumes from it if it exists.

    `on_progress` gets the episodes flown by each run.
    """
    import torch  # a process that only plans and collects does not need it

    from uav_dc_ros.experiments.train import checkpoint as checkpoints
    from uav_dc_ros.experiments.train.training import Training, prepare_torch, roll_out_greedily

    prepare_torch(n_threads=1)
    training = Training(shard.population, torch.device("cpu"))
    if checkpoint and checkpoint.is_file():
        checkpoints.restore(checkpoint, training)
    saved = time.monotonic()
    while training.n_flown < shard.population.n_episodes:
        training.fly_episode()
        if on_progress:
            on_progress(training.n_flown)
        if checkpoint and time.monotonic() - saved > _CHECKPOINT_EVERY_S:
            checkpoints.save(checkpoint, training, {})
            saved = time.monotonic()
    first, count = shard.greedy_seeds
    return ShardResult(
        curves=training.curves,
        greedy=roll_out_greedily(training, range(first, first + count)),
        parameters=[training.learner.parameters(run) for run in range(len(shard.population.runs))],
    )


def result_file(folder: Path, shard: Shard) -> Path:
    """File of a shard's result."""
    return folder / f"{shard.name}.safetensors"


def checkpoint_file(folder: Path, shard: Shard) -> Path:
    """File of a shard's state during training."""
    return folder / f"{shard.name}.training.safetensors"


def save_result(folder: Path, shard: Shard, content: bytes) -> None:
    """Writes the result of a shard in one move, and removes its checkpoint."""
    files.write(result_file(folder, shard), content)
    checkpoint_file(folder, shard).unlink(missing_ok=True)


def load_result(folder: Path, shard: Shard) -> ShardResult:
    """Reads the result of a shard; raises TrainingError if it is missing or damaged."""
    path = result_file(folder, shard)
    shape = (shard.population.n_episodes, len(shard.population.runs))
    try:
        result = ShardResult.from_bytes(path.read_bytes())
        if len(result.parameters) != shape[1] or any(v.shape != shape for v in result.curves.values()):
            raise ValueError(f"expected {shape[0]} episodes of {shape[1]} runs")
        return result
    except (OSError, SafetensorError, KeyError, TypeError, ValueError) as error:
        raise TrainingError(
            f"{path}: cannot be read: {error}; delete it, and --resume trains it again"
        ) from None


@cache
def code_hash() -> str:
    """Hash of the code that a shard's result depends on: a shard trained by other code is not resumed."""
    return code_hash_of(Path(uav_dc_ros.__file__).parent.parent, ROOTS)
