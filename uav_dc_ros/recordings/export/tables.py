"""Tables written in pieces, of which one is in memory: CSV with the standard library, Parquet with pyarrow.

A column is a name and a kind; a table is written column by column, and None is an empty field.
"""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Protocol, Self, TypeAlias

from uav_dc_ros.errors import UavDcError

Kind: TypeAlias = Literal["int", "float", "bool", "text"]
Format: TypeAlias = Literal["parquet", "csv"]
Columns: TypeAlias = Mapping[str, Kind]

ROWS = 50_000  # of a piece: a row group of Parquet


class _File(Protocol):
    def write(self, columns: Mapping[str, Sequence[Any]]) -> None: ...

    def close(self) -> None: ...


class Table:
    """A table that is written; a context manager.

    Args:
        folder: where it lies; its file is `NAME.FORMAT`.
        name: of the table.
        columns: kind of each column, by name.
        format: of the file.
        about: text by key, which Parquet keeps beside the schema.

    Attributes:
        count: rows so far.

    Raises:
        UavDcError: it cannot be written, or pyarrow is not installed.
    """

    def __init__(
        self, folder: Path, name: str, columns: Columns, format: Format, about: Mapping[str, str]
    ) -> None:
        self.count = 0
        path = folder / f"{name}.{format}"
        self._file: _File = _Csv(path, columns) if format == "csv" else _Parquet(path, columns, about)
        self._waiting: dict[str, list[Any]] = {name: [] for name in columns}
        self._n_waiting = 0

    def add(self, rows: Mapping[str, Sequence[Any]]) -> None:
        """Append rows: values by column, all of one length."""
        n = len(next(iter(rows.values())))
        for name, values in self._waiting.items():
            values.extend(rows[name])
        self._n_waiting += n
        self.count += n
        if self._n_waiting >= ROWS:
            self._flush()

    def _flush(self) -> None:
        if self._n_waiting:
            self._file.write(self._waiting)
            self._waiting = {name: [] for name in self._waiting}
            self._n_waiting = 0

    def __enter__(self) -> Self:
        """Write the table in a `with` statement."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Write the rest, and close."""
        try:
            if error is None:
                self._flush()
        finally:
            self._file.close()


class _Csv:
    """Floats with all their digits; true and false as words."""

    def __init__(self, path: Path, columns: Columns) -> None:
        self._file = path.open("w", encoding="utf-8", newline="")
        self._writer = csv.writer(self._file, lineterminator="\n")
        self._writer.writerow(columns)
        self._bools = [name for name, kind in columns.items() if kind == "bool"]

    def write(self, columns: Mapping[str, Sequence[Any]]) -> None:
        words = {None: None, True: "true", False: "false"}
        told = {name: [words[one] for one in columns[name]] for name in self._bools}
        self._writer.writerows(
            zip(*(told.get(name, values) for name, values in columns.items()), strict=True)
        )

    def close(self) -> None:
        self._file.close()


class _Parquet:
    """A row group for each piece."""

    def __init__(self, path: Path, columns: Columns, about: Mapping[str, str]) -> None:
        try:
            import pyarrow as pa  # type: ignore[import-untyped]  # not needed to fly
            from pyarrow import parquet
        except ModuleNotFoundError:
            raise UavDcError(
                "pyarrow is not installed, which writes Parquet; expected it from: pip install "
                '"uav_dc_ros[train]", or --format csv'
            ) from None
        types = {"int": pa.int64(), "float": pa.float64(), "bool": pa.bool_(), "text": pa.string()}
        fields = [pa.field(name, types[kind]) for name, kind in columns.items()]
        self._schema = pa.schema(fields, metadata=dict(about))
        self._make = pa.table
        self._writer = parquet.ParquetWriter(path, self._schema, compression="zstd")

    def write(self, columns: Mapping[str, Sequence[Any]]) -> None:
        self._writer.write_table(self._make(dict(columns), schema=self._schema))

    def close(self) -> None:
        self._writer.close()
