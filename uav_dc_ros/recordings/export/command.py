"""Export a bag: missions as tidy tables, or as transitions to learn from."""

import argparse
import io
import json
import os
import shutil
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from itertools import groupby
from pathlib import Path
from typing import IO, Any, get_args

import msgspec
import numpy as np

from uav_dc_ros import __version__, files
from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.core import observations
from uav_dc_ros.core.observations import Observation
from uav_dc_ros.core.reward import RewardForm
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import BagError, ParameterError
from uav_dc_ros.recordings import step_reader
from uav_dc_ros.recordings.export import rows
from uav_dc_ros.recordings.export.rows import Mission
from uav_dc_ros.recordings.export.tables import Format, Table
from uav_dc_ros.recordings.recorded_step import printable
from uav_dc_ros.recordings.recorded_vehicle import vehicle
from uav_dc_ros.recordings.step_reader import Steps
from uav_dc_ros.recordings.transitions import Transition, Transitions
from uav_dc_ros.topics import SIMULATED

ALL = tuple(rows.tables(real=True))
EPILOG = f"""\
Tables go into a new folder, a file each, one observation a row:
  steps     a row per step: pose, cell, phase, action, sum-rate, data, rewards
  users     a row per user and step: position, SINR (linear), rate, data, served, collected
  missions  a row per mission: seed, scenario, policy, outcome, totals
  phases    of a real vehicle only: a row per phase, with its reason and time
Of a real vehicle, steps also have the reason of their phase, and how long the move to them took; missions
have what flew, the reason of their end, and how many steps were flown without reaching their cell.
Units are in the names of columns. Rewards are computed anew from recorded cells and data.

Transitions go into a new .npz file, which numpy.load reads: observation, next_observation (float32 [T, D]),
action (int64 [T]), reward (float64 [T]), terminated, truncated (bool [T]); flight, mission, step (int64 [T]),
which name the source of each; and metadata, a JSON text. The trainer reads bags themselves:
python -m uav_dc_ros.train --from-bags BAG.

Tables: {", ".join(ALL)}.
"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    parser.epilog, parser.formatter_class = EPILOG, argparse.RawDescriptionHelpFormatter
    add = parser.add_argument
    add("bag", type=Path, metavar="BAG", help="folder of a bag, or one of its files")
    add(
        "--out",
        type=Path,
        required=True,
        metavar="DIR|FILE",
        help="new folder; for transitions a new .npz file",
    )
    add("--format", choices=get_args(Format), help="of tables (default: parquet, which needs pyarrow)")
    add("--tables", type=_tables, metavar="NAME,...", help="which tables (default: all)")
    add("--transitions", action="store_true", help="write transitions (s, a, r, s', terminated), no tables")
    add("--observation", choices=get_args(Observation), help="of transitions (default: mission)")
    add(
        "--reward-form", choices=get_args(RewardForm), help="what a step pays, instead of the scenario's form"
    )
    add("--scenario", metavar="NAME|FILE", help="the world, for a bag without one")
    add("--namespace", metavar="NAME", help="of the mission, for a bag with several")


def _tables(text: str) -> list[str]:
    names = text.split(",")
    for name in names:
        if name not in ALL:
            raise argparse.ArgumentTypeError(f"{name!r}; expected some of {', '.join(ALL)}")
    return names


def run(options: argparse.Namespace) -> int:
    """Export; the exit status.

    Raises:
        BagError: the result exists, or the bag holds nothing to export.
        ParameterError: options that do not go together.
    """
    _check(options)
    with BagReader(options.bag) as reader:
        namespace = step_reader.namespace(reader, options.namespace)
        scenario = step_reader.scenario(reader, namespace, options.scenario)
        if options.reward_form:
            paid = msgspec.structs.replace(scenario.reward, form=options.reward_form)
            scenario = msgspec.structs.replace(scenario, reward=paid)
        recorded = Steps(reader, namespace, scenario.step_ns)
        if options.transitions:
            write_transitions(
                options.out, recorded, scenario, options.observation or "mission", printable(options.bag.name)
            )
        else:
            format: Format = options.format or "parquet"
            flew = vehicle(reader, namespace)
            write_tables(options.out, recorded, scenario, reader.about, options.tables, format, flew)
        for topic, n in sorted(recorded.orphans.items()):
            print(f"  {n} messages on {topic} came too late to be brought together with their step")
        for line in recorded.rejected.lines():
            print(f"  {line}")
    return 0


def _check(options: argparse.Namespace) -> None:
    """Refuse options that mean nothing together, before anything is read."""
    foreign = ("format", "tables") if options.transitions else ("observation",)
    for name in foreign:
        if getattr(options, name) is not None:
            other = "without" if options.transitions else "with"
            raise ParameterError(f"--{name} has a meaning {other} --transitions only")
    if options.transitions and options.out.suffix != ".npz":
        raise ParameterError(f"--out {options.out}: expected a file NAME.npz for transitions")
    _refuse_existing(options.out)


def _refuse_existing(path: Path) -> None:
    if path.exists() or path.is_symlink():
        raise BagError(f"{path} exists; expected a new name, nothing is overwritten")


@contextmanager
def _new(path: Path) -> Iterator[Path]:
    """A folder to work in beside `path`; gone afterwards. What it holds as `result` becomes `path`."""
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        (partial / "result").parent.mkdir(parents=True)
        yield partial
        _refuse_existing(path)
        files.move(partial / "result", path)
    except OSError as error:
        raise BagError(f"{path} cannot be written: {error.strerror or error}") from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def write_tables(
    folder: Path,
    recorded: Steps,
    scenario: Scenario,
    about: dict[str, str],
    names: list[str] | None,
    format: Format,
    vehicle: str = SIMULATED,
) -> None:
    """Write tables into a new folder, all or those named; a piece of each is in memory at a time.

    Raises:
        BagError: the folder exists or cannot be written; no step is recorded, or one of another world.
        ParameterError: a table that this vehicle has not.
    """
    columns = rows.tables(vehicle != SIMULATED)
    names = names or list(columns)
    for name in names:
        if name not in columns:
            raise ParameterError(f"--tables {name}: of a real vehicle only; expected {', '.join(columns)}")
    with _new(folder) as partial, ExitStack() as stack:
        (partial / "result").mkdir()
        written = {
            name: stack.enter_context(Table(partial / "result", name, columns[name], format, about))
            for name in names
        }
        n_missions = 0
        for _, steps_of_mission in groupby(recorded, lambda step: (step.flight, step.mission)):
            mission = Mission(scenario, about, vehicle)
            for step in steps_of_mission:
                for name, made in mission.add(step).items():
                    if name in written and len(made["step"]):
                        written[name].add(made)
            if "missions" in written:
                written["missions"].add(mission.summary())
            n_missions += 1
        if not n_missions:
            raise BagError(f"the bag holds no step of any mission; {_nothing(recorded)}")
        stack.close()  # everything is written before the folder takes its name
    told = ", ".join(f"{table.count} rows of {name}" for name, table in written.items())
    print(f"{folder}: {n_missions} mission{'s' * (n_missions != 1)}: {told}")


def write_transitions(
    file: Path, recorded: Steps, scenario: Scenario, observation: Observation, source: str
) -> None:
    """Write transitions into a new .npz file. They pass through files beside it, not through memory.

    Raises:
        BagError: the file exists or cannot be written, or there is no transition.
    """
    stream = Transitions(recorded, scenario, observation)
    d = (observations.size(observation, scenario),)
    kinds: dict[str, tuple[type, tuple[int, ...]]] = {
        "observation": (np.float32, d),
        "action": (np.int64, ()),
        "reward": (np.float64, ()),
        "next_observation": (np.float32, d),
        "terminated": (np.bool_, ()),
        "truncated": (np.bool_, ()),
        "flight": (np.int64, ()),
        "mission": (np.int64, ()),
        "step": (np.int64, ()),
    }
    with _new(file) as partial:
        n = 0
        with ExitStack() as stack:
            columns = {name: stack.enter_context((partial / name).open("wb")) for name in kinds}
            for transition in stream:
                _append(columns, transition, kinds)
                n += 1
        if not n:
            why = dict(stream.skipped) or f"no step; {_nothing(recorded)}"
            raise BagError(f"the bag holds no transition: {why}")
        metadata = {
            "version": __version__,
            "bag": source,
            "scenario": scenario.name,
            "scenario_fingerprint": scenario.fingerprint,
            "observation": observation,
            "reward": msgspec.to_builtins(scenario.reward),
        }
        with zipfile.ZipFile(partial / "result", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for name, (kind, shape) in kinds.items():
                with (partial / name).open("rb") as raw:
                    _array(archive, name, np.dtype(kind), (n, *shape), raw)
            text = np.asarray(json.dumps(metadata))
            _array(archive, "metadata", text.dtype, (), io.BytesIO(text.tobytes()))
    print(
        f"{file}: {n} transitions of {d[0]} numbers ({observation!r}), reward form {scenario.reward.form!r}"
    )
    if stream.deduced:
        print(f"  {stream.deduced} actions are deduced from the cells: no move was recorded, or not flown")
    for reason, count in stream.skipped.most_common():
        print(f"  {count} left out: {reason}")


def _nothing(recorded: Steps) -> str:
    """Why there is nothing, or what was expected."""
    return "; ".join(recorded.rejected.lines()) or "expected at least one"


def _append(columns: Mapping[str, IO[bytes]], transition: Transition, kinds: Mapping[str, Any]) -> None:
    for name, file in columns.items():
        file.write(np.asarray(getattr(transition, name), kinds[name][0]).tobytes())


def _array(
    archive: zipfile.ZipFile, name: str, dtype: np.dtype[Any], shape: tuple[int, ...], content: IO[bytes]
) -> None:
    """An array as numpy.load finds it in an .npz file."""
    with archive.open(f"{name}.npy", "w", force_zip64=True) as out:
        header = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(out, header)
        shutil.copyfileobj(content, out, 2**20)
