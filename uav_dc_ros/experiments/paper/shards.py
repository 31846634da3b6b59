"""Shards: populations that are trained apart, each by one process on one core, here or on a Ray cluster.

How runs are divided into shards is the caller's, and does not depend on how many workers there are or
where: so neither do the results, as long as the cores are alike (another kind of core rounds otherwise).
What a shard brought is one file in a folder; a shard whose file is there is not trained again, and one
that was interrupted goes on from its checkpoint. Needs torch in the workers.
"""

import ast
import hashlib
import time
from collections.abc import Callable, Iterator, Sequence
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
from uav_dc_ros.experiments.evaluate.rollout import Missions
from uav_dc_ros.experiments.train.population import Population

# Hears of the progress of a shard: its name, and the episodes that each of its runs has flown.
Tell = Callable[[str, int], None]
# Seconds between two checkpoints: more than a kill is worth, less than it is worth to wait for one.
_CHECKPOINT_EVERY_S = 30.0


# What trains a shard; all that these import decides its result.
_ROOTS = ("uav_dc_ros.experiments.paper.shards", "uav_dc_ros.experiments.train.checkpoint")


@cache
def code() -> str:
    """Hash of the code that a shard depends on: what was trained with other code is not gone on with."""
    return code_of(Path(uav_dc_ros.__file__).parent.parent)


def code_of(root: Path) -> str:
    """The same of the package below another folder."""
    digest = hashlib.sha256(__version__.encode())
    for name in sorted(import_closure(root, _ROOTS)):
        digest.update(name.encode() + _file(root, name).read_bytes())
    return digest.hexdigest()[:16]


def import_closure(root: Path, modules: Sequence[str]) -> set[str]:
    """These modules of this package, and all modules of it that they import, directly or not.

    Found in the text, so that an import inside a function counts, too. What is imported for type checkers
    alone does not count, nor does the package's own file, which defines the version and imports nothing.

    Args:
        root: folder that the package lies in.
        modules: full names.
    """
    found: set[str] = set()
    waiting = list(modules)
    while waiting:
        name = waiting.pop()
        if name in found or name == uav_dc_ros.__name__ or not _file(root, name).is_file():
            continue
        found.add(name)
        waiting += _imports(ast.parse(_file(root, name).read_bytes()))
    return found


def _file(root: Path, module: str) -> Path:
    path = root.joinpath(*module.split("."))
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def _imports(tree: ast.AST) -> Iterator[str]:
    """Full names of what may be modules of this package, in what runs of a syntax tree."""
    for node in ast.iter_child_nodes(tree):
        match node:
            case ast.If(test=ast.Name(id="TYPE_CHECKING")):
                for other in node.orelse:
                    yield from _imports(other)
            case ast.Import():
                yield from (alias.name for alias in node.names if _is_ours(alias.name))
            case ast.ImportFrom(module=str(module)) if _is_ours(module):
                yield module
                yield from (f"{module}.{alias.name}" for alias in node.names)
            case _:
                yield from _imports(node)


def _is_ours(module: str) -> bool:
    return module.partition(".")[0] == uav_dc_ros.__name__


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

    from uav_dc_ros.experiments.train import checkpoint as checkpoints
    from uav_dc_ros.experiments.train.training import Training, prepare_torch
    from uav_dc_ros.experiments.train.validation import roll_out_greedily

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
        greedy=roll_out_greedily(training, range(first, first + count)),
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
