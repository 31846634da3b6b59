"""Recorded missions as tidy tables: one observation a row, units in the names of columns.

Tables are written in pieces, with one piece in memory: CSV with the standard library, Parquet with pyarrow.
"""

import csv
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
from msgspec import UNSET, UnsetType

from uav_dc_ros import files, payloads
from uav_dc_ros.core import reward as core_reward
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import BagError, MessageError, ParameterError, UavDcError
from uav_dc_ros.messages import Phase
from uav_dc_ros.phases import BEFORE_START
from uav_dc_ros.recordings.recorded_step import MissionTotals, RecordedStep
from uav_dc_ros.topics import SIMULATED

Kind: TypeAlias = Literal["int", "float", "bool", "text"]
Format: TypeAlias = Literal["parquet", "csv"]
Columns: TypeAlias = Mapping[str, Kind]
Rows: TypeAlias = Mapping[str, Sequence[Any]]  # values by column, all of one length; None is an empty field

ROWS = 50_000  # of a piece: a row group of Parquet
# Columns of each table. Values of a step are those at its end; `action` is decided there.
# fmt: off
_SOURCE: Columns = {"flight": "int", "mission": "int", "step": "int"}
TABLES: dict[str, Columns] = {
    "steps": {
        **_SOURCE,
        "time_s": "float",  # of the users, ROS time; in simulation mission time
        "received_ns": "int",  # the first of its messages, since the epoch
        "x_m": "float", "y_m": "float", "altitude_m": "float",
        "cell_x": "int", "cell_y": "int", "cell_z": "int",
        "phase": "text", "remaining_steps": "int", "action": "text",
        "sum_rate_bps": "float", "users_served": "int", "users_collected": "int",
        "data_bits": "float",  # of all users
        "total_reward": "float", "reward": "float",  # r^t (eq. 7), and the agent's reward for the step
    },
    "users": {
        **_SOURCE,
        "user": "int", "cluster": "int", "x_m": "float", "y_m": "float",
        "sinr": "float", "rate_bps": "float", "data_bits": "float",  # SINR is linear
        "served": "bool", "collected": "bool",
    },
    "missions": {
        "flight": "int", "mission": "int", "seed": "int",
        "scenario": "text", "scenario_fingerprint": "text", "policy": "text", "policy_sha256": "text",
        "outcome": "text",  # landed, timeout, aborted; unfinished: the bag does not hold the end
        "steps_flown": "int", "steps_recorded": "int", "first_received_ns": "int", "last_received_ns": "int",
        "users_total": "int", "users_collected": "int", "data_bits": "float",
        "mean_sum_rate_bps": "float",  # over the flown steps that have one
        "total_reward": "float",  # r^t at the last step
        "reward": "float",  # of the mission, over the steps with a known r^t: `core.reward.mission_reward`
        "reward_data": "text",  # data in r^t: step, so_far
        "mean_age_s": "float", "fairness": "float", "last_collected_step": "int",  # `core.users.service`
    },
}
# Further columns of a scenario with a battery, by its model; those of a step are at its end.
BATTERY: dict[str, Columns] = {
    "steps": {"energy_used_j": "float", "state_of_charge": "float"},
    "missions": {"energy_used_j": "float", "energy_per_mbit_j": "float"},
}
# Further column of a scenario whose users have names.
NAMES: dict[str, Columns] = {"users": {"name": "text"}}
# Further columns of flights with a real vehicle.
REAL: dict[str, Columns] = {
    "steps": {
        "reason": "text",  # of the phase
        "flown_s": "float",  # from the start of the move to this step until the vehicle reported the step
    },
    "missions": {"vehicle": "text", "reason": "text", "steps_not_reached": "int"},
    "phases": {
        **_SOURCE,
        "time_s": "float",  # of publication, since the epoch
        "phase": "text", "reason": "text", "held": "bool", "fault": "text",
    },
}
# fmt: on


def table_columns(vehicle: str, has_battery: bool = False, has_names: bool = False) -> dict[str, Columns]:
    """Columns of each table for flights with this vehicle, as `step_reader.vehicle` names it."""
    parts = [TABLES, *([BATTERY] if has_battery else [])]
    parts += [*([NAMES] if has_names else []), *([REAL] if vehicle != SIMULATED else [])]
    names = dict.fromkeys(name for part in parts for name in part)
    return {name: {k: v for part in parts for k, v in part.get(name, {}).items()} for name in names}


class MissionRows:
    """Rows of one mission, step by step; `about`: metadata of the bag."""

    def __init__(self, scenario: Scenario, about: Mapping[str, str], vehicle: str) -> None:
        self._scenario, self._about, self._vehicle = scenario, about, vehicle
        self._total: tuple[int, float] | None = None  # step, and r^t there
        self._last: RecordedStep | None = None
        self._totals = MissionTotals()
        self._recorded = 0
        self._sum_rates: list[float] = []
        self._first_ns = 2**63 - 1
        self._last_ns = 0

    def add(self, step: RecordedStep) -> dict[str, Rows]:
        """The rows of a step, by table. Raises BagError for a step of another world."""
        try:
            for payload in filter(None, (step.status, step.users, step.rates)):
                payloads.check(payload, self._scenario)
        except MessageError as error:
            raise BagError(f"{step.name}: {error}") from None
        before, self._last = self._last, step
        self._recorded += 1
        self._totals.add(step.step, step.status, step.rates)
        self._first_ns = min(self._first_ns, *step.log_ns.values())
        self._last_ns = max(self._last_ns, *step.log_ns.values())
        if step.rates is not None and step.step > 0:
            self._sum_rates.append(step.rates.sum_rate_bps)
        row = self._step(step) | {"flown_s": _flown_s(before, step)}
        return {"steps": _as_rows(row), "users": self._users(step), "phases": _phases(step)}

    def _step(self, step: RecordedStep) -> dict[str, Any]:
        users, rates, status = step.users, step.rates, step.status
        position_m = [None] * 3 if step.position_m is None else step.position_m.tolist()
        total, reward = self._rewards(step)
        return {
            **_source(step),
            "time_s": None if users is None else users.stamp_ns / 1e9,
            "received_ns": min(step.log_ns.values()),
            **dict(zip(("x_m", "y_m", "altitude_m"), position_m, strict=True)),
            **dict(zip(("cell_x", "cell_y", "cell_z"), status.cell if status else [None] * 3, strict=True)),
            "phase": status and status.phase.value,
            "reason": status and status.reason,
            "remaining_steps": status and status.remaining_steps,
            "energy_used_j": status and _known(status.energy_used_j),
            "state_of_charge": status and _known(status.state_of_charge),
            "action": step.move and step.move.action,
            "sum_rate_bps": rates and rates.sum_rate_bps,
            "users_served": rates and sum(rates.served),
            "users_collected": rates and sum(rates.collected),
            "data_bits": rates and float(np.sum(rates.data_bits)),
            "total_reward": total,
            "reward": reward,
        }

    def _rewards(self, step: RecordedStep) -> tuple[float | None, float | None]:
        """r^t and the reward of the step; None where unknown. A mission starts from r = 0."""
        before, self._total = self._total, None
        total = 0.0
        if step.step > 0:
            if step.rates is None or step.status is None:
                return None, None
            total = payloads.total_reward(step.status, step.rates, self._scenario)
            self._totals.add_reward(total, self._scenario.reward.data)
        self._total = step.step, total
        if before is None or before[0] != step.step - 1:
            return total, None
        return total, float(core_reward.step_reward(total, before[1], self._scenario.reward.form))

    def _users(self, step: RecordedStep) -> Rows:
        if step.users is None and step.rates is None:
            return {name: [] for name in TABLES["users"]}
        n = self._scenario.n_users
        rows: dict[str, Sequence[Any]] = {name: [value] * n for name, value in _source(step).items()}
        rows |= {"user": range(n), "cluster": self._scenario.user_cluster.tolist()}
        rows["name"] = self._scenario.users.names or [None] * n
        for name in ("x_m", "y_m"):
            rows[name] = getattr(step.users, name, [None] * n)
        for name in ("sinr", "rate_bps", "data_bits", "served", "collected"):
            rows[name] = getattr(step.rates, name, [None] * n)
        return rows

    def summary(self) -> Rows:
        """The row of the mission, after its last step."""
        last, totals = self._last, self._totals
        assert last is not None, "a mission has a step"
        known = totals.seed is not None  # a status is recorded
        row = {
            "flight": last.flight,
            "mission": last.mission,
            "seed": totals.seed,
            "scenario": self._scenario.name,
            "scenario_fingerprint": self._scenario.fingerprint,
            "policy": self._about.get("policy"),
            "policy_sha256": self._about.get("policy_sha256"),
            "outcome": totals.outcome,
            "steps_flown": last.step,
            "steps_recorded": self._recorded,
            "first_received_ns": self._first_ns,
            "last_received_ns": self._last_ns,
            "users_total": self._scenario.n_users,
            "users_collected": totals.collected,
            "data_bits": totals.data_bits,
            "mean_sum_rate_bps": float(np.mean(self._sum_rates)) if self._sum_rates else None,
            "total_reward": self._total and self._total[1],
            "reward": totals.reward,
            "reward_data": self._scenario.reward.data,
            **totals.service_figures(self._scenario),
            "energy_used_j": totals.energy_used_j,
            "energy_per_mbit_j": totals.energy_per_mbit_j,
            "vehicle": self._vehicle,
            "reason": totals.reason if known else None,
            "steps_not_reached": totals.steps_not_reached if known else None,
        }
        return _as_rows(row)


def _flown_s(before: RecordedStep | None, step: RecordedStep) -> float | None:
    """Duration of the move to a step by publish times, seconds; None where unknown."""
    if before is None or before.step != step.step - 1:
        return None
    start = next((one for one in before.phase_reports if one.phase is Phase.MOVING), None)
    end = next((one for one in step.phase_reports if one.phase not in BEFORE_START), None)
    if start is None or end is None or start.clock_resets != end.clock_resets:
        return None
    return (end.publish_ns - start.publish_ns) / 1e9


def _known(value: float | UnsetType) -> float | None:
    return None if value is UNSET else value


def _phases(step: RecordedStep) -> Rows:
    reports = step.phase_reports
    return {
        **{name: [value] * len(reports) for name, value in _source(step).items()},
        "time_s": [one.publish_ns / 1e9 for one in reports],
        "phase": [one.phase.value for one in reports],
        "reason": [one.reason for one in reports],
        "held": [one.held for one in reports],
        "fault": [one.fault for one in reports],
    }


def _source(step: RecordedStep) -> dict[str, Any]:
    return {name: getattr(step, name) for name in _SOURCE}


def _as_rows(row: Mapping[str, Any]) -> Rows:
    return {name: [value] for name, value in row.items()}


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
def new_table(path: Path, columns: Columns, format: Format, about: Mapping[str, str]) -> Iterator[Table]:
    """Write a table. Parquet keeps `about` beside its schema."""
    with closing(_Csv(path, columns) if format == "csv" else _Parquet(path, columns, about)) as file:
        table = Table(file, columns)
        yield table
        table.flush()


def check_new(path: Path, *suffixes: str) -> None:
    """Raise ParameterError for another suffix, and BagError or UavDcError for a file that cannot be made."""
    if path.suffix not in suffixes:
        expected = " or ".join(f"NAME{suffix}" for suffix in suffixes)
        raise ParameterError(f"--out {path}: expected a file {expected}")
    if path.exists() or path.is_symlink():
        raise BagError(f"{path} exists; expected a new name, nothing is overwritten")
    files.check_writable(path)


def write_table(path: Path, columns: Columns, rows: Rows) -> None:
    """Write a whole table that `check_new` accepts as .parquet or .csv."""
    format: Any = path.suffix.removeprefix(".")
    with files.replacing(path) as partial, new_table(partial, columns, format, {}) as table:
        table.add(rows)


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
