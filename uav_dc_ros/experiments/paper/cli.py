"""The command line of `python -m uav_dc_ros.paper`."""

import argparse
import contextlib
import os
import platform
import shlex
import shutil
import sys
import time
from collections.abc import Sequence
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from uav_dc_ros import cli, files, scenarios
from uav_dc_ros.errors import TrainingError
from uav_dc_ros.experiments.paper.local_workers import train_here
from uav_dc_ros.experiments.paper.ray_workers import train_on_ray
from uav_dc_ros.experiments.paper.setting import SCALES
from uav_dc_ros.experiments.paper.shards import Shard

if TYPE_CHECKING:
    from uav_dc_ros.experiments.paper.results import Results
    from uav_dc_ros.experiments.paper.sweep import Trajectories

PROG = "python -m uav_dc_ros.paper"
TRAJECTORIES_FILE = "trajectories.safetensors"
# Says of what the shards in a folder are.
_PLAN_FILE = "plan.json"
_FROM_TRAIN = 'is not installed; expected it from: pip install "uav_dc_ros[train]"'
# Seconds between two lines of progress away from a terminal.
_LINE_EVERY_S = 30.0


def main(argv: list[str] | None = None) -> None:
    """Runs the command line, and exits."""
    argv = sys.argv[1:] if argv is None else argv
    parser = cli.Parser(
        prog=PROG,
        description="Run the sweep behind every figure of the paper, draw the figures, and weigh its claims.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    add = parser.add_argument
    add("--scale", default="full", choices=list(SCALES), help="smoke shows in a minute that all of it runs")
    add("--only", nargs="+", metavar="FIGURE", help="these figures, and the claims that they can decide")
    add("--out", type=Path, metavar="DIR", default=Path("paper_results"), help="folder to make")
    add("--resume", action="store_true", help="go on with what is in --out; draw again what is finished")
    add("--workers", default=_cores(), type=cli.count, metavar="N", help="processes, each on one core")
    add("--ray", metavar="ADDRESS", help="train on this Ray cluster instead, such as HOST:6379")
    cli.run(lambda: _paper(parser.parse_args(argv), f"{PROG} {shlex.join(argv)}".strip()), PROG)


def _paper(options: argparse.Namespace, command: str) -> int:
    try:
        from uav_dc_ros.experiments.paper import plan, report, sweep
        from uav_dc_ros.experiments.paper.results import RUNS_FILE, Results
    except ModuleNotFoundError as error:
        raise TrainingError(f"{error.name} {_FROM_TRAIN}") from None
    if find_spec("torch") is None:  # the workers need it
        raise TrainingError(f"torch {_FROM_TRAIN}")
    scale, out = SCALES[options.scale], options.out
    planned = plan.runs(scale, options.only)
    if out.exists() and not options.resume:
        raise TrainingError(f"{out} exists; expected a new folder, or --resume")
    if (out / RUNS_FILE).is_file():
        results = Results.load(out)
        if results.metadata.scale != scale:
            raise TrainingError(
                f"{out} has the scale {results.metadata.scale.name!r} and is finished; "
                f"expected {scale.name!r}, or another --out"
            )
        if missing := set(planned) - set(results.planned):
            raise TrainingError(
                f"{out} is finished, without {len(missing)} runs of this command; expected another --out"
            )
        networks = sweep.load_trajectories(out / TRAJECTORIES_FILE, scale)
    else:
        try:
            results, networks = _train(options, command)
        except KeyboardInterrupt:
            goes_on = "; --resume goes on" if out.exists() else ""
            print(f"{PROG}: stopped{goes_on}", file=sys.stderr)
            return cli.INTERRUPTED
    report.write(results, sweep.fly_tracks(networks, scale), out, options.only)
    shutil.rmtree(out / "shards", ignore_errors=True)
    Console().print(f"{out}: {len(results.planned)} runs; read {out / report.CLAIMS_FILE}", soft_wrap=True)
    return 0


def _train(options: argparse.Namespace, command: str) -> "tuple[Results, Trajectories]":
    """Trains what the options ask for, and saves the results."""
    from uav_dc_ros.experiments.paper import plan, sweep
    from uav_dc_ros.experiments.paper.results import Metadata, World

    scale, out = SCALES[options.scale], options.out
    planned = plan.runs(scale, options.only)
    folder = out / "shards"
    resumed = _make(folder, options)
    started = time.monotonic()
    with _Progress(sum(shard.n_steps for shard, _ in sweep.cut(planned, scale))) as progress:
        where = partial(_train_all, options=options, progress=progress)
        try:
            found = sweep.train(planned, scale, folder, where)
        finally:
            _unmake(folder)
    names = {one.setting.scenario for one in planned}
    here = f"{options.workers} processes on {_cores()} cores of {platform.machine()}"
    metadata = Metadata(
        command=command,
        scale=scale,
        worlds={name: World.of(scenarios.load(name)) for name in sorted(names)},
        greedy_missions=sweep.GREEDY_SEEDS[1],
        # Of an interrupted sweep nobody knows.
        wall_time_s=None if resumed else time.monotonic() - started,
        device=f"Ray cluster {options.ray}" if options.ray is not None else here,
    )
    results, networks = sweep.collect(planned, metadata, found), sweep.trajectories(planned, scale, found)
    sweep.save_trajectories(networks, out / TRAJECTORIES_FILE)
    results.save(out)
    return results, networks


def _train_all(
    shards: Sequence[Shard], folder: Path, options: argparse.Namespace, progress: "_Progress"
) -> None:
    progress.expect(shards)
    if options.ray is not None:
        train_on_ray(shards, folder, options.ray, progress.tell)
    else:
        train_here(shards, folder, options.workers, progress.tell)


def _make(folder: Path, options: argparse.Namespace) -> bool:
    """Makes the folder of the shards; tells whether there are some in it to go on from.

    Raises:
        TrainingError: it cannot be made, or belongs to a sweep with other options.
    """
    only = None if options.only is None else sorted(set(options.only))
    plan = msgspec.json.encode({"scale": options.scale, "only": only})
    try:
        folder.mkdir(parents=True, exist_ok=True)
        kept = (folder / _PLAN_FILE).read_bytes() if (folder / _PLAN_FILE).is_file() else plan
    except OSError as error:
        raise TrainingError(f"{folder.parent} cannot be made: {error.strerror}") from None
    if kept != plan:
        raise TrainingError(
            f"{folder.parent} is half of a sweep with {kept.decode()}; expected the same --scale and --only, "
            "or another --out"
        )
    files.write(folder / _PLAN_FILE, plan)
    return any(folder.glob("*.safetensors"))


def _unmake(folder: Path) -> None:
    """Removes folders in which there is nothing to go on from: they would be in the next command's way."""
    with contextlib.suppress(OSError):
        if not any(folder.glob("*.safetensors")):
            shutil.rmtree(folder)
            folder.parent.rmdir()


def _cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0))


class _Progress:
    """Agent-steps done, their rate and the time left: a bar on a terminal, lines elsewhere."""

    def __init__(self, total: int) -> None:
        self._console = Console(stderr=True)
        self._bar = Progress(
            BarColumn(bar_width=20),
            TextColumn("{task.percentage:3.0f}%  {task.fields[rate]}"),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=self._console,
            disable=not self._console.is_terminal,
        )
        self._task = self._bar.add_task("", total=total, rate="")
        self._total = total
        self._shards: dict[str, Shard] = {}
        # Agent-steps of each shard when it was first heard of, and now.
        self._first: dict[str, int] = {}
        self._done: dict[str, int] = {}
        self._before = 0
        self._started = self._last = time.monotonic()

    def __enter__(self) -> "_Progress":
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def expect(self, shards: Sequence[Shard]) -> None:
        """Which shards are still to be trained; the others are done."""
        self._shards = {shard.name: shard for shard in shards}
        self._before = self._total - sum(shard.n_steps for shard in shards)

    def tell(self, name: str, n_flown: int) -> None:
        """Notes that each run of a shard has flown `n_flown` episodes."""
        shard = self._shards[name]
        n_episodes = shard.population.n_episodes
        # A shard that went on from its checkpoint begins there; one that tells of its end only, at 0.
        self._first.setdefault(
            name, shard.n_steps * (n_flown - 1) // n_episodes if n_flown < n_episodes else 0
        )
        self._done[name] = shard.n_steps * n_flown // n_episodes
        done, now = sum(self._done.values()), time.monotonic()
        rate = (done - sum(self._first.values())) / max(now - self._started, 1e-9)
        self._bar.update(self._task, completed=self._before + done, rate=f"{rate:,.0f} agent-steps/s")
        if not self._console.is_terminal and now - self._last > _LINE_EVERY_S:
            self._last = now
            left_s = (self._total - self._before - done) / max(rate, 1e-9)
            share = (self._before + done) / self._total
            self._console.print(
                f"{share:.0%} done, {rate:,.0f} agent-steps/s, {left_s / 60:.1f} minutes left"
            )
