"""Export a bag: missions as tidy tables, as transitions for training, or as a map."""

import argparse
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Any, get_args

import msgspec
import numpy as np

from uav_dc_ros import __version__, cli, files
from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.core import observations
from uav_dc_ros.core.observations import Observation
from uav_dc_ros.core.reward import DATA, MISSION_REWARD, RewardData, RewardForm
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import BagError, ParameterError
from uav_dc_ros.messages import printable
from uav_dc_ros.recordings import step_reader
from uav_dc_ros.recordings.export import maps
from uav_dc_ros.recordings.export.tables import Format, MissionRows, new_table, table_columns
from uav_dc_ros.recordings.step_reader import EXTERNAL, Steps
from uav_dc_ros.recordings.transitions import RecordedTransitions, Transition
from uav_dc_ros.topics import SIMULATED

# Kinds of export that options apply to; None: tables
APPLY: dict[str, tuple[str | None, ...]] = {
    "format": (None,),
    "tables": (None,),
    "observation": ("transitions",),
    "reward_form": (None, "transitions"),
    "reward_data": (None, "transitions"),
    "datum": tuple(maps.WRITERS),
}
ALL = tuple(table_columns(EXTERNAL))
_REWARDS = "; ".join(f"{data}: {words}" for data, words in MISSION_REWARD.items())
EPILOG = f"""\
Tables go into a new folder, one file each, one observation a row:
  steps     a row per step: pose, cell, phase, action, sum-rate, data, rewards
  users     a row per user and step: position, SINR (linear), rate, data, served, collected
  missions  a row per mission: seed, scenario, policy, outcome, totals
  phases    real vehicles only: a row per phase report, with reason and time
For a real vehicle, steps also hold the reason of the phase and the duration of the move that led there;
missions hold the vehicle, the reason of the end, and the number of flown steps that did not reach their cell.
With a battery in the scenario, steps also hold the energy used and the state of charge; missions hold the
energy used, and the energy for each Mbit.
Units are in the names of columns. Rewards are computed from recorded cells, rates and data. The reward of a
mission depends on the data in r^t (reward_data): {_REWARDS}. Steps without a known r^t are
left out.

Transitions go into a new .npz file for numpy.load: observation, next_observation (float32 [T, D]),
action (int64 [T]), reward (float64 [T]), terminated, truncated (bool [T]); flight, mission, step (int64 [T]),
the source of each; and metadata, a JSON text. The trainer reads bags directly:
python -m uav_dc_ros.train --from-bags BAG.

Maps (GPX, KML, GeoJSON) have the path and the users of each mission on WGS 84. The grid lies where the bridge
of a real vehicle reports it, or else at the scenario's datum_deg; --datum replaces both. Without an altitude
of the datum, heights are above the ground.

Tables: {", ".join(ALL)}.
"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    parser.epilog, parser.formatter_class = EPILOG, argparse.RawDescriptionHelpFormatter
    add = parser.add_argument
    add("bag", type=Path, metavar="BAG", help="folder of a bag, or one of its files")
    out = "new folder; for transitions and maps a new file"
    add("--out", type=Path, required=True, metavar="DIR|FILE", help=out)
    add("--format", choices=get_args(Format), help="of tables (default: parquet, which needs pyarrow)")
    add("--tables", type=cli.names("tables", among=ALL), metavar="NAME,...", help="default: all")
    kinds = parser.add_mutually_exclusive_group()
    what = "write transitions (s, a, r, s', terminated), no tables"
    kinds.add_argument("--transitions", action="store_true", help=what)
    for name in maps.WRITERS:
        what = f"write path and users as a map in a file NAME.{name}"
        kinds.add_argument(f"--{name}", dest="map", action="store_const", const=name, help=what)
    add("--datum", metavar="LAT,LON[,ALT]", help="of a map: position of x = 0, y = 0, degrees and metres")
    add("--observation", choices=get_args(Observation), help="of transitions (default: mission)")
    add("--reward-form", choices=get_args(RewardForm), help="reward form instead of the scenario's")
    add("--reward-data", choices=get_args(RewardData), help="data in r^t instead of the scenario's")
    add("--scenario", metavar="NAME|FILE", help="the world, for a bag without one")
    add("--namespace", metavar="NAME", help="of the mission, for a bag with several")


def run(options: argparse.Namespace) -> int:
    """Export; the exit status."""
    kind = "transitions" if options.transitions else options.map
    for name, kinds in APPLY.items():
        if getattr(options, name) is not None and kind not in kinds:
            listed = ", ".join("tables" if one is None else f"--{one}" for one in kinds)
            raise ParameterError(f"--{name.replace('_', '-')} applies to {listed} only")
    suffix = {None: options.out.suffix, "transitions": ".npz"}.get(kind, f".{kind}")
    if options.out.suffix != suffix:
        raise ParameterError(f"--out {options.out}: expected a file NAME{suffix} for {kind}")
    _refuse_existing(options.out)
    with BagReader(options.bag) as reader:
        namespace = step_reader.namespace(reader, options.namespace)
        scenario = step_reader.scenario(reader, namespace, options.scenario)
        given = {"form": options.reward_form, "data": options.reward_data}
        own = {key: value for key, value in given.items() if value is not None}
        scenario = msgspec.structs.replace(scenario, reward=msgspec.structs.replace(scenario.reward, **own))
        recorded = Steps(reader, namespace, scenario.step_ns)
        vehicle = step_reader.vehicle(reader, namespace)
        if options.transitions:
            _write_transitions(options, recorded, scenario)
        elif options.map is not None:
            datum = maps.find_datum(reader, namespace, scenario, options.datum)
            missions = maps.read_missions(reader, namespace, recorded, datum, vehicle != SIMULATED)
            _write_map(options, recorded, missions, datum)
        else:
            _write_tables(options, recorded, scenario, reader.about, vehicle)
        for line in recorded.losses():
            print(f"  {line}")
    return 0


def _refuse_existing(path: Path) -> None:
    if path.exists() or path.is_symlink():
        raise BagError(f"{path} exists; expected a new name, nothing is overwritten")


@contextmanager
def _new(path: Path) -> Iterator[Path]:
    """A scratch folder beside `path`, removed afterwards. Its entry `result` becomes `path`."""
    scratch = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        scratch.mkdir(parents=True)
        yield scratch
        _refuse_existing(path)
        files.move(scratch / "result", path)
    except OSError as error:
        raise BagError(f"{path} cannot be written: {error.strerror or error}") from None
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def _write_tables(
    options: argparse.Namespace, recorded: Steps, scenario: Scenario, about: dict[str, str], vehicle: str
) -> None:
    """Write tables into a new folder, with one piece of each in memory."""
    columns = table_columns(vehicle, scenario.energy is not None, scenario.users.names is not None)
    names: list[str] = options.tables or list(columns)
    format: Format = options.format or "parquet"
    for name in names:
        if name not in columns:
            raise ParameterError(f"--tables {name}: for real vehicles only; expected {', '.join(columns)}")
    with _new(options.out) as scratch:
        (result := scratch / "result").mkdir()
        n_missions = 0
        with ExitStack() as stack:
            tables = {
                name: stack.enter_context(
                    new_table(result / f"{name}.{format}", columns[name], format, about)
                )
                for name in names
            }
            for _, mission_steps in groupby(recorded, attrgetter("flight", "mission")):
                mission = MissionRows(scenario, about, vehicle)
                for step in mission_steps:
                    for name, added in mission.add(step).items():
                        if name in tables:
                            tables[name].add(added)
                if "missions" in tables:
                    tables["missions"].add(mission.summary())
                n_missions += 1
            if not n_missions:
                raise BagError(f"the bag holds no step of any mission; {_reason(recorded)}")
    counts = ", ".join(f"{table.count} rows of {name}" for name, table in tables.items())
    print(f"{options.out}: {n_missions} mission{'s' * (n_missions != 1)}: {counts}")


def _write_map(
    options: argparse.Namespace, recorded: Steps, missions: list[maps.MapMission], datum: maps.Datum
) -> None:
    """Write missions as a new map."""
    if not missions:
        raise BagError(f"the bag holds no step of any mission; {_reason(recorded)}")
    content = maps.WRITERS[options.map](missions, datum, printable(options.bag.absolute().stem))
    with _new(options.out) as scratch:
        (scratch / "result").write_bytes(content)
    n, n_poses = len(missions), sum(len(mission.path) for mission in missions)
    where = ", ".join(f"{value:g}" for value in datum if value is not None)
    print(f"{options.out}: {n} mission{'s' * (n != 1)}, {n_poses} poses, datum {where}")


def _write_transitions(options: argparse.Namespace, recorded: Steps, scenario: Scenario) -> None:
    """Write transitions into a new .npz file, with one in memory."""
    observation: Observation = options.observation or "mission"
    if (problem := observations.problem(observation, scenario)) is not None:
        raise ParameterError(f"--observation: {problem}")
    transitions = RecordedTransitions(recorded, scenario, observation)
    n = 0
    with _new(options.out) as scratch:
        kinds: dict[str, np.dtype[Any]] = {}
        with ExitStack() as stack:
            columns = {name: stack.enter_context((scratch / name).open("wb")) for name in Transition._fields}
            for transition in transitions:
                for name, column in columns.items():
                    value = np.asarray(getattr(transition, name))
                    kinds[name] = np.dtype((value.dtype, value.shape))
                    column.write(value.tobytes())
                n += 1
        if not n:
            why = dict(transitions.skipped) or f"no step; {_reason(recorded)}"
            raise BagError(f"the bag holds no transition: {why}")
        metadata = {
            "version": __version__,
            "bag": printable(options.bag.name),
            "scenario": scenario.name,
            "scenario_fingerprint": scenario.fingerprint,
            "observation": observation,
            "reward": msgspec.to_builtins(scenario.reward),
        }
        arrays: dict[str, Any] = {name: np.memmap(scratch / name, kind, "r") for name, kind in kinds.items()}
        with (scratch / "result").open("wb") as result:
            np.savez_compressed(result, **arrays, metadata=np.asarray(json.dumps(metadata)))
    size, reward = observations.size(observation, scenario), scenario.reward
    rewards = f"reward form {reward.form!r}, {DATA[reward.data]}"
    print(f"{options.out}: {n} transitions of {size} numbers ({observation!r}), {rewards}")
    if transitions.deduced:
        why = "no move was recorded, or not flown"
        print(f"  {transitions.deduced} actions are deduced from the cells: {why}")
    for reason, count in transitions.skipped.most_common():
        print(f"  {count} skipped: {reason}")


def _reason(recorded: Steps) -> str:
    """Why the bag has no step, or what was expected."""
    return "; ".join(recorded.rejected.lines()) or "expected at least one"
