"""The results of a sweep, in memory and on disk.

Two Parquet files: `runs.parquet`, a row for each run; `curves.parquet`, a row for each point of each run's
curves. Each carries the metadata as JSON under the key `uav_dc_ros`.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
import pyarrow as pa  # type: ignore[import-untyped]
from pyarrow import parquet

from uav_dc_ros import __version__, files
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.reward import RewardData
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import TrainingError
from uav_dc_ros.experiments.paper.setting import PlannedRun, Scale, Setting
from uav_dc_ros.experiments.train.episode_stats import CURVES

# Of training missions, exploration included, as in the paper's curves: `CURVES` without the loss.
METRICS = CURVES[:-1]
# The same of greedy missions after training, in the run's environment.
GREEDY = (
    "greedy_reward",
    "greedy_return",
    "greedy_throughput_bps",
    "greedy_users_collected",
    "greedy_landing_rate",
    "greedy_arrival_step",
)
RUNS_FILE, CURVES_FILE = "runs.parquet", "curves.parquet"
_KEY = b"uav_dc_ros"
_Meta = TypeVar("_Meta", bound=msgspec.Struct)

_TYPES = {str: pa.string(), int: pa.int32(), float: pa.float64()}
_SETTING_TYPES = {f.name: _TYPES.get(f.type, pa.string()) for f in msgspec.structs.fields(Setting)}
_RUN_TYPES = {"environment": pa.int32(), "repeat": pa.int32(), "seed": pa.int64()}
_RUNS_SCHEMA = pa.schema(
    {"run": pa.int32(), **_SETTING_TYPES, **_RUN_TYPES, **dict.fromkeys(GREEDY, pa.float32())}
)
_CURVES_SCHEMA = pa.schema({"run": pa.int32(), "episode": pa.int32(), **dict.fromkeys(METRICS, pa.float32())})


class ScenarioFacts(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The values of a scenario that the results depend on."""

    fingerprint: str  # hash of the scenario's values
    n_users: int
    max_steps: int
    # The data term of a mission's reward for a throughput of 1 bit/s and beta = 1: seconds whose data counts
    # in r^t (of the mission, of a step) / (users x data_scale_bits). A mission flies all its steps, so the
    # throughput determines the data term.
    data_per_bps: float
    reward_data: RewardData = "so_far"  # data in r^t; results of version 0.1.0 lack it

    @classmethod
    def of(cls, scenario: Scenario, any_end: bool = False) -> "ScenarioFacts":
        """Raises TrainingError if missions end on arrival: the throughput would not determine the data.

        With `any_end` it does not; measures that need the data, `common_share` alone, are then wrong.
        """
        mission, n_users = scenario.mission, scenario.n_users
        if mission.episode_end != "at_time_limit" and not any_end:
            raise TrainingError(
                f"{scenario.name}: mission.episode_end = {mission.episode_end!r}; expected 'at_time_limit', "
                "or missions of different lengths would be compared"
            )
        reward_data = scenario.reward.data
        counted_s = (1 if reward_data == "step" else mission.max_steps) * mission.step_s
        return cls(
            fingerprint=scenario.fingerprint,
            n_users=n_users,
            max_steps=mission.max_steps,
            data_per_bps=counted_s / (n_users * scenario.reward.data_scale_bits),
            reward_data=reward_data,
        )


class SweepMetadata(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The origin of results."""

    command: str
    scale: Scale
    worlds: dict[str, ScenarioFacts]  # by the names of the scenarios
    greedy_missions: int  # of each run
    wall_time_s: float | None = (
        None  # of results of version 0.2.0 and before; later ones are equal byte for byte
    )
    device: str = ""  # in words
    version: str = __version__


@dataclass(frozen=True, kw_only=True)
class Results:
    """Runs and their measures."""

    metadata: SweepMetadata
    planned: tuple[PlannedRun, ...]
    episode: Array  # number of the last episode of each point, `[n_points]`
    # By `METRICS`: a mean over the episodes of each point, float32 `[n_runs, n_points]`.
    curves: dict[str, Array]
    greedy: dict[str, Array]  # by `GREEDY`: a mean over missions, float32 `[n_runs]`

    def __post_init__(self) -> None:
        """Raises TrainingError for a wrong shape or name, a number that is not finite, or a repeated run."""
        _check_arrays("curves", self.curves, METRICS, (len(self.planned), len(self.episode)))
        _check_arrays("greedy", self.greedy, GREEDY, (len(self.planned),))
        if len(set(self.planned)) < len(self.planned):
            raise TrainingError(
                f"{len(self.planned)} runs; expected each setting, environment and repeat once"
            )
        scale = self.metadata.scale
        if list(self.episode) != [scale.episodes_per_point * (i + 1) for i in range(scale.n_points)]:
            raise TrainingError(
                f"points after episodes {list(self.episode)[:3]} ...; expected {scale.n_points} points of "
                f"{scale.episodes_per_point} episodes"
            )
        if unknown := {run.setting.scenario for run in self.planned} - self.metadata.worlds.keys():
            raise TrainingError(f"no world of scenario {min(unknown)!r} in the metadata")

    def of(self, setting: Setting) -> Array:
        """Indices of a setting's runs by environment, then repeat, integers `[n]`; empty without any."""
        runs = self._by_setting.get(setting, [])
        return np.array(sorted(runs, key=lambda i: self.planned[i][1:]), np.intp)

    def in_first(self, n: int) -> "Results":
        """The runs in the first n environments alone."""
        metadata = self.metadata
        scale = msgspec.structs.replace(metadata.scale, environments=metadata.scale.environments[:n])
        kept = [i for i, run in enumerate(self.planned) if run.environment in scale.environments]
        return replace(
            self,
            metadata=msgspec.structs.replace(metadata, scale=scale),
            planned=tuple(self.planned[i] for i in kept),
            curves={name: values[kept] for name, values in self.curves.items()},
            greedy={name: values[kept] for name, values in self.greedy.items()},
        )

    @cached_property
    def _by_setting(self) -> dict[Setting, list[int]]:
        indices: dict[Setting, list[int]] = {}
        for i, run in enumerate(self.planned):
            indices.setdefault(run.setting, []).append(i)
        return indices

    def save(self, folder: Path) -> None:
        """Writes both files into an existing folder, each in one move; raises TrainingError if it cannot."""
        n_runs, n_points = len(self.planned), len(self.episode)
        runs = {
            "run": range(n_runs),
            **{name: [getattr(run.setting, name) for run in self.planned] for name in _SETTING_TYPES},
            **{name: [getattr(run, name) for run in self.planned] for name in _RUN_TYPES},
            **{name: np.asarray(self.greedy[name], np.float32) for name in GREEDY},
        }
        curves = {
            "run": np.repeat(np.arange(n_runs, dtype=np.int32), n_points),
            "episode": np.tile(np.asarray(self.episode, np.int32), n_runs),
            **{name: np.asarray(self.curves[name], np.float32).ravel() for name in METRICS},
        }
        write_table(folder / CURVES_FILE, curves, _CURVES_SCHEMA, self.metadata)
        write_table(folder / RUNS_FILE, runs, _RUNS_SCHEMA, self.metadata)

    @classmethod
    def load(cls, folder: Path) -> "Results":
        """Reads what `save` wrote; raises TrainingError for missing, damaged or other files."""
        runs, metadata = read_table(folder / RUNS_FILE, _RUNS_SCHEMA, SweepMetadata)
        curves, other = read_table(folder / CURVES_FILE, _CURVES_SCHEMA, SweepMetadata)
        if metadata != other:
            raise TrainingError(f"{folder}: {RUNS_FILE} and {CURVES_FILE} are of different sweeps")
        planned = []
        for row in runs.to_pylist():
            try:
                setting = msgspec.convert({name: row[name] for name in _SETTING_TYPES}, Setting)
            except msgspec.ValidationError as error:
                raise TrainingError(f"{folder / RUNS_FILE}: run {row['run']}: {error}") from None
            planned.append(PlannedRun(setting, row["environment"], row["repeat"]))
        n_runs, n_points = len(planned), metadata.scale.n_points
        values = {name: curves[name].to_numpy() for name in _CURVES_SCHEMA.names}
        episode = values["episode"][:n_points]
        if not (
            np.array_equal(runs["run"].to_numpy(), np.arange(n_runs))
            and np.array_equal(values["run"], np.repeat(np.arange(n_runs), n_points))
            and np.array_equal(values["episode"], np.tile(episode, n_runs))
        ):
            raise TrainingError(
                f"{folder / CURVES_FILE}: {len(curves)} rows; "
                f"expected {n_points} points of each of {n_runs} runs"
            )
        return cls(
            metadata=metadata,
            planned=tuple(planned),
            episode=episode,
            curves={name: values[name].reshape(n_runs, n_points) for name in METRICS},
            greedy={name: runs[name].to_numpy() for name in GREEDY},
        )


def _check_arrays(
    what: str, arrays: dict[str, Array], names: tuple[str, ...], shape: tuple[int, ...]
) -> None:
    if arrays.keys() != set(names):
        raise TrainingError(f"{what} has {', '.join(sorted(arrays))}; expected {', '.join(sorted(names))}")
    for name, values in arrays.items():
        if np.shape(values) != shape:
            raise TrainingError(f"{what}: {name} has shape {np.shape(values)}; expected {shape}")
        if not np.isfinite(values).all():
            raise TrainingError(f"{what}: {name} holds a number that is not finite")


def write_table(path: Path, columns: dict[str, Any], schema: pa.Schema, metadata: msgspec.Struct) -> None:
    """Writes a Parquet file with its metadata in one move; raises TrainingError if it cannot."""
    table = pa.table(columns, schema=schema.with_metadata({_KEY: msgspec.json.encode(metadata)}))
    try:
        with files.replacing(path) as partial:
            parquet.write_table(table, partial, compression="zstd", write_page_checksum=True)
    except OSError as error:
        raise TrainingError(f"{path} cannot be written: {error.strerror or error}") from None


def read_table(path: Path, schema: pa.Schema, kind: type[_Meta]) -> tuple[pa.Table, _Meta]:
    """Reads what `write_table` wrote; raises TrainingError for a missing, damaged or other file."""
    if not path.is_file():
        raise TrainingError(f"{path}: no such file")
    try:
        with parquet.ParquetFile(path, page_checksum_verification=True) as file:
            table = file.read()
        metadata = msgspec.json.decode((table.schema.metadata or {})[_KEY], type=kind)
    except KeyError:
        raise TrainingError(f"{path}: no metadata of a sweep; expected the key 'uav_dc_ros'") from None
    except (OSError, pa.ArrowException, msgspec.DecodeError, UnicodeDecodeError) as error:
        raise TrainingError(f"{path} cannot be read: {error}") from None
    if not table.schema.equals(schema):
        raise TrainingError(
            f"{path} has columns {', '.join(table.schema.names)}; expected {', '.join(schema.names)}"
        )
    if any(column.null_count for column in table.columns):
        raise TrainingError(f"{path}: a value is missing")
    return table, metadata
