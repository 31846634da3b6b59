"""The verdicts on every claim in every world, in memory and on disk.

Parquet files: `worlds.parquet`, a row for each world with its values; `verdicts.parquet`, a row for each
world and claim; `screened.parquet`, where worlds were screened, the row of C1 for each. Nothing in them
depends on when, where or in how many pieces the runs were trained.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, get_type_hints

import msgspec
import numpy as np
import pyarrow as pa  # type: ignore[import-untyped]

from uav_dc_ros import __version__
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.errors import TrainingError
from uav_dc_ros.experiments.paper.claims.criteria import Verdict
from uav_dc_ros.experiments.paper.claims.findings import CLAIMS, Finding
from uav_dc_ros.experiments.paper.results import read_table, write_table
from uav_dc_ros.experiments.paper.setting import Scale
from uav_dc_ros.experiments.paper.worlds.draw import World

WORLDS_FILE, VERDICTS_FILE, SCREENED_FILE = "worlds.parquet", "verdicts.parquet", "screened.parquet"
FILES = (WORLDS_FILE, VERDICTS_FILE, SCREENED_FILE)
IDS = tuple(claim.id for claim in CLAIMS)
VERDICTS: tuple[Verdict, ...] = ("holds", "undecided", "does not hold")


class Row(NamedTuple):
    """The verdict on a claim in a world."""

    world: int  # number of the world
    claim: str
    verdict: str  # one of `VERDICTS`
    tested: bool  # False: cut from the plan, and therefore undecided
    part: str  # the part of the claim that decides; the estimate and its 95% interval are those of its effect
    estimate: float  # NaN if not tested, and so are both ends
    low: float
    high: float
    unit: str


class MultiverseMetadata(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The origin of the verdicts."""

    scale: Scale
    rejected: dict[str, int]  # candidates that cannot exist, by reason, up to the last of the drawn worlds
    n_drawn: int | None = None  # worlds that stand for all; those after them were found by C1. None: all
    version: str = __version__


_TYPES = {str: pa.string(), int: pa.int64(), float: pa.float64(), bool: pa.bool_()}
_POINT = pa.list_(pa.float64())
_PLACES = {"dock_m": _POINT, "five_clusters_m": pa.list_(_POINT), "three_clusters_m": pa.list_(_POINT)}
_WORLDS_SCHEMA = pa.schema(
    {f.name: _PLACES.get(f.name) or _TYPES[f.type] for f in msgspec.structs.fields(World)}
)
_ROWS_SCHEMA = pa.schema({name: _TYPES[kind] for name, kind in get_type_hints(Row).items()})


@dataclass(frozen=True, kw_only=True)
class Multiverse:
    """Worlds, and the verdicts on every claim in each."""

    metadata: MultiverseMetadata
    worlds: tuple[World, ...]
    rows: tuple[Row, ...]  # by world, then claim
    screened: tuple[Row, ...] = ()  # C1 in worlds beyond those drawn, in which nothing else decided

    def __post_init__(self) -> None:
        """Raises TrainingError unless every world has a verdict on every claim, in order."""
        expected = [(world.number, claim) for world in self.worlds for claim in IDS]
        if [row[:2] for row in self.rows] != expected:
            raise TrainingError(
                f"{len(self.rows)} verdicts; expected one on each of {len(IDS)} claims in each of "
                f"{len(self.worlds)} worlds, in order"
            )
        if unknown := {row.verdict for row in self.rows} - set(VERDICTS):
            raise TrainingError(f"verdict {min(unknown)!r}; expected one of {', '.join(VERDICTS)}")

    @cached_property
    def drawn(self) -> "Multiverse":
        """The worlds that were drawn whatever holds in them: shares are of these."""
        n = self.metadata.n_drawn
        return self if n is None else replace(self, worlds=self.worlds[:n], rows=self.rows[: n * len(IDS)])

    @cached_property
    def verdicts(self) -> Array:
        """The verdict on every claim in every world, strings `[W, C]`."""
        return np.array([row.verdict for row in self.rows]).reshape(len(self.worlds), len(IDS))

    @property
    def tested(self) -> Array:
        """Whether a claim was weighed, bool `[C]`."""
        return np.array([row.tested for row in self.rows[: len(IDS)]])

    def save(self, folder: Path) -> None:
        """Writes both files into an existing folder; raises TrainingError if it cannot."""
        values = [msgspec.to_builtins(world) for world in self.worlds]
        _write(folder / WORLDS_FILE, values, _WORLDS_SCHEMA, self.metadata)
        _write(folder / VERDICTS_FILE, [row._asdict() for row in self.rows], _ROWS_SCHEMA, self.metadata)
        if self.screened:
            rows = [row._asdict() for row in self.screened]
            _write(folder / SCREENED_FILE, rows, _ROWS_SCHEMA, self.metadata)

    @classmethod
    def load(cls, folder: Path) -> "Multiverse":
        """Reads what `save` wrote; raises TrainingError for missing, damaged or other files."""
        worlds, metadata = read_table(folder / WORLDS_FILE, _WORLDS_SCHEMA, MultiverseMetadata)
        rows, other = read_table(folder / VERDICTS_FILE, _ROWS_SCHEMA, MultiverseMetadata)
        if metadata != other:
            raise TrainingError(f"{folder}: {WORLDS_FILE} and {VERDICTS_FILE} are of different worlds")
        screened = []
        if metadata.n_drawn is not None:
            table, other = read_table(folder / SCREENED_FILE, _ROWS_SCHEMA, MultiverseMetadata)
            if metadata != other:
                raise TrainingError(f"{folder}: {WORLDS_FILE} and {SCREENED_FILE} are of different worlds")
            screened = table.to_pylist()
        try:
            made = tuple(msgspec.convert(world, World) for world in worlds.to_pylist())
        except msgspec.ValidationError as error:
            raise TrainingError(f"{folder / WORLDS_FILE}: {error}") from None
        return cls(
            metadata=metadata,
            worlds=made,
            rows=tuple(Row(**row) for row in rows.to_pylist()),
            screened=tuple(Row(**row) for row in screened),
        )


def rows(world: World, findings: Sequence[Finding]) -> list[Row]:
    """The verdicts of the findings in a world; a claim that was not tested is undecided."""
    return [_row(world.number, one) for one in findings]


def _row(world: int, finding: Finding) -> Row:
    decisive = finding.decisive
    if finding.verdict == "not tested" or decisive is None:
        nan = float("nan")
        return Row(world, finding.claim.id, "undecided", False, "", nan, nan, nan, "")
    effect = decisive.effect
    return Row(
        world=world,
        claim=finding.claim.id,
        verdict=finding.verdict,
        tested=True,
        part=decisive.text,
        estimate=effect.mean,
        low=effect.low,
        high=effect.high,
        unit=decisive.unit,
    )


def _write(path: Path, values: list[dict[str, Any]], schema: pa.Schema, metadata: MultiverseMetadata) -> None:
    columns = {name: [one[name] for one in values] for name in schema.names}
    write_table(path, columns, schema, metadata)
