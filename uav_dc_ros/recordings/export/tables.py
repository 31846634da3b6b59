"""Tables written in pieces, with one piece in memory: CSV with the standard library, Parquet with pyarrow."""

import csv
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, Literal, TypeAlias

from uav_dc_ros.errors import UavDcError

Kind: TypeAlias = Literal["int", "float", "bool", "text"]
Format: TypeAlias = Literal["parquet", "csv"]
Columns: TypeAlias = Mapping[str, Kind]
Rows: TypeAlias = Mapping[str, Sequence[Any]]  # values by column, all of one length; None is an empty field

ROWS = 50_000  # of a piece: a row group of Parquet


class Table:
    """A table that is being written; `count`: its rows so far."""

    def __init__(self, file: "_Csv | _Parquet", columns: Columns) -> None:
        self.count = 0
        self._file = file
        self._pending: dict[str, list[Any]] = {name: [] for name in columns}

    def add(self, rows: Rows) -> None:
        """Append rows."""
        for name, values in self._pending.items():
            values.extend(rows[name])
        self.count += len(next(iter(rows.values())))
        if len(next(iter(self._pending.values()))) >= ROWS:
            self.flush()

    def flush(self) -> None:
        """Write the pending rows."""
        if any(self._pending.values()):
            self._file.write(self._pending)
            self._pending = {name: [] for name in self._pending}


@contextmanager
def new_table(
    folder: Path, name: str, columns: Columns, format: Format, about: Mapping[str, str]
) -> Iterator[Table]:
    """Write a table into `folder/NAME.FORMAT`. Parquet keeps `about` beside its schema.

    Raises:
        UavDcError: pyarrow is not installed.
        OSError: the file cannot be written.
    """
    path = folder / f"{name}.{format}"
    with closing(_Csv(path, columns) if format == "csv" else _Parquet(path, columns, about)) as file:
        table = Table(file, columns)
        yield table
        table.flush()


class _Csv:
    """Floats with all digits; `true` and `false`."""

    def __init__(self, path: Path, columns: Columns) -> None:
        self._file = path.open("w", encoding="utf-8", newline="")
        self._writer = csv.writer(self._file, lineterminator="\n")
        self._writer.writerow(columns)
        self._bools = [name for name, kind in columns.items() if kind == "bool"]

    def write(self, columns: Rows) -> None:
        words = {None: None, True: "true", False: "false"}
        bools = {name: [words[value] for value in columns[name]] for name in self._bools}
        self._writer.writerows(zip(*{**columns, **bools}.values(), strict=True))

    def close(self) -> None:
        self._file.close()


class _Parquet:
    """A row group for each piece."""

    def __init__(self, path: Path, columns: Columns, about: Mapping[str, str]) -> None:
        try:
            import pyarrow as pa  # type: ignore[import-untyped]  # an extra
            from pyarrow import parquet
        except ModuleNotFoundError:
            raise UavDcError(
                "pyarrow, which writes Parquet, is not installed; expected it from: pip install "
                '"uav_dc_ros[train]", or --format csv'
            ) from None
        types = {"int": pa.int64(), "float": pa.float64(), "bool": pa.bool_(), "text": pa.string()}
        fields = [pa.field(name, types[kind]) for name, kind in columns.items()]
        self._schema = pa.schema(fields, metadata=dict(about))
        self._make = pa.table
        self._writer = parquet.ParquetWriter(path, self._schema, compression="zstd")

    def write(self, columns: Rows) -> None:
        self._writer.write_table(self._make(dict(columns), schema=self._schema))

    def close(self) -> None:
        self._writer.close()
