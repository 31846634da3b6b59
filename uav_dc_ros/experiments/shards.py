"""Shards: populations that are trained apart, each by one process on one core, here or on a Ray cluster.

How runs are divided into shards is the caller's, and does not depend on how many workers there are or
where: so neither do the results, as long as the cores are alike (another kind of core rounds otherwise).
What a shard brought is one file in a folder; a shard whose file is there is not trained again, and one
that was interrupted goes on from its checkpoint. Needs torch in the workers.
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
from uav_dc_ros import __version__, files
from uav_dc_ros.agents import network
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.errors import TrainingError
from uav_dc_ros.experiments.fly import Missions
from uav_dc_ros.experiments.runs import Population

# Hears of the progress of a shard: its name, and the episodes that each of its runs has flown.
Tell = Callable[[str, int], None]
# Seconds between two checkpoints: more than a kill is worth, less than it is worth to wait for one.
_CHECKPOINT_EVERY_S = 30.0


@cache
def code() -> str:
    """Hash of this package's code: what was trained with other code is not gone on with."""
    root = Path(uav_dc_ros.__file__).parent
    sources = sorted(path.relative_to(root).as_posix() for path in root.rglob("*.py"))
    digest = hashlib.sha256(__version__.encode())
    for name in sources:
        digest.update(name.encode() + (root / name).read_bytes())
    return digest.hexdigest()[:16]


class Shard(msgspec.Struct, frozen=True, kw_only=True):
    """A population, and the greedy missions that its policies fly at the end.

    Attributes:
        population: the runs.
        greedy_seeds: first seed of the greedy missions, and their number.
    """

    population: Population
    greedy_seeds: tuple[int, int]

    @property
    def name(self) -> str:
        """Tells its content: equal names mean equal results."""
        content = msgspec.json.encode((self, code()))
        return f"shard_{hashlib.sha256(content).hexdigest()[:16]}"

    @property
    def n_steps(self) -> int:
        """Agent-steps of all its runs."""
        population = self.population
        return len(population.runs) * population.n_episodes * population.scenario.mission.max_steps


@dataclass(frozen=True, kw_only=True)
class Trained:
    """What a shard brought.

    Attributes:
        curves: by `books.CURVES`, float32 `[T, N]`.
        greedy: greedy missions after training, `[N, S]` each.
        parameters: of each run's network, N of them.
    """

    curves: dict[str, Array]
    greedy: Missions
    parameters: list[network.Parameters]

    def to_bytes(self) -> bytes:
        """All of it as one safetensors file."""
        arrays = {f"curves.{name}": values for name, values in self.curves.items()}
        arrays |= {f"greedy.{f.name}": np.asarray(getattr(self.greedy, f.name)) for f in fields(Missions)}
        for run, parameters in enumerate(self.parameters):
            arrays |= {f"parameters.{run}.{name}": values for name, values in parameters.items()}
        return safetensors.numpy.save({name: np.ascontiguousarray(v) for name, v in arrays.items()})

    @classmethod
    def from_bytes(cls, content: bytes) -> "Trained":
        """The inverse of `to_bytes`; raises SafetensorError or KeyError for anything else."""
        arrays = safetensors.numpy.load(content)
        parts: dict[str, dict[str, Array]] = {"curves": {}, "greedy": {}}
        parameters: dict[int, network.Parameters] = {}
        for key, values in arrays.items():
            part, _, name = key.partition(".")
            if part == "parameters":
                run, _, name = name.partition(".")
                parameters.setdefault(int(run), {})[name] = values
            else:
                parts[part][name] = values
        return cls(
            curves=parts["curves"],
            greedy=Missions(**{f.name: parts["greedy"][f.name] for f in fields(Missions)}),
            parameters=[parameters[run] for run in range(len(parameters))],
        )


def train_shard(shard: Shard, checkpoint: Path | None = None, tell: Tell | None = None) -> Trained:
    """Trains a shard to its end, on one core.

    Args:
        shard: what to train.
        checkpoint: where to keep its state on the way, and to go on from when it is there.
        tell: hears of every episode.
    """
    import torch  # a process that only plans and collects need not load it

    from uav_dc_ros.experiments import checkpoint as checkpoints
    from uav_dc_ros.experiments.training import Training, prepare_torch
    from uav_dc_ros.experiments.validation import fly_greedily

    prepare_torch(n_threads=1)
    training = Training(shard.population, torch.device("cpu"))
    if checkpoint and checkpoint.is_file():
        checkpoints.restore(checkpoint, training)
    saved = time.monotonic()
    while training.n_flown < shard.population.n_episodes:
        training.fly_episode()
        if tell:
            tell(shard.name, training.n_flown)
        if checkpoint and time.monotonic() - saved > _CHECKPOINT_EVERY_S:
            checkpoints.save(checkpoint, training, {})
            saved = time.monotonic()
    first, count = shard.greedy_seeds
    return Trained(
        curves=training.curves,
        greedy=fly_greedily(training, range(first, first + count)),
        parameters=[training.learner.parameters(run) for run in range(len(shard.population.runs))],
    )


def result_file(folder: Path, shard: Shard) -> Path:
    """Where the result of a shard is kept."""
    return folder / f"{shard.name}.safetensors"


def checkpoint_file(folder: Path, shard: Shard) -> Path:
    """Where the state of a shard is kept on the way."""
    return folder / f"{shard.name}.training.safetensors"


def keep(folder: Path, shard: Shard, content: bytes) -> None:
    """Writes the result of a shard, in one move, and drops its checkpoint."""
    files.write(result_file(folder, shard), content)
    checkpoint_file(folder, shard).unlink(missing_ok=True)


def load(folder: Path, shard: Shard) -> Trained:
    """The result of a shard that was trained.

    Raises:
        TrainingError: it is missing or damaged.
    """
    path = result_file(folder, shard)
    population = shard.population
    shape = (population.n_episodes, len(population.runs))
    try:
        trained = Trained.from_bytes(path.read_bytes())
        if len(trained.parameters) != shape[1] or any(v.shape != shape for v in trained.curves.values()):
            raise ValueError(f"expected {shape[0]} episodes of {shape[1]} runs")
        return trained
    except (OSError, SafetensorError, KeyError, TypeError, ValueError) as error:
        raise TrainingError(
            f"{path}: cannot be read: {error}; delete it, and --resume trains it again"
        ) from None
