"""The command line of `python -m uav_dc_ros.paper`."""

import argparse
import os
import platform
import shlex
import shutil
import sys
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from uav_dc_ros import cli, scenarios
from uav_dc_ros.errors import TrainingError
from uav_dc_ros.experiments.local_workers import train_here
from uav_dc_ros.experiments.paper.setting import SCALES
from uav_dc_ros.experiments.ray_workers import train_on_ray
from uav_dc_ros.experiments.shards import Shard

if TYPE_CHECKING:
    from uav_dc_ros.experiments.paper.results import Results
    from uav_dc_ros.experiments.paper.sweep import Trajectories

PROG = "python -m uav_dc_ros.paper"
TRAJECTORIES_FILE = "trajectories.safetensors"
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
    cores = os.cpu_count() or 1
    add("--workers", default=cores, type=cli.count, metavar="N", help="processes, each on one core")
    add("--ray", metavar="ADDRESS", help="train on this Ray cluster instead, such as HOST:6379")
    options = parser.parse_args(argv)
    cli.run(lambda: _paper(options, f"{PROG} {shlex.join(argv)}".strip()), PROG)


def _paper(options: argparse.Namespace, command: str) -> int:
    try:
        from uav_dc_ros.experiments.paper import plan, report, sweep
        from uav_dc_ros.experiments.paper.results import RUNS_FILE, Results
    except ModuleNotFoundError as error:
        raise TrainingError(
            f'{error.name} is not installed; expected it from: pip install "uav_dc_ros[train]"'
        ) from None
    scale, out = SCALES[options.scale], options.out
    planned = plan.runs(scale, options.only)
    _make(out, options.resume)
    if (out / RUNS_FILE).is_file():
        results = Results.load(out)
        if missing := set(planned) - set(results.planned) or results.metadata.scale != scale:
            n_missing = len(missing) if isinstance(missing, set) else len(planned)
            raise TrainingError(
                f"{out} is finished, without {n_missing} runs of this command; expected another --out"
            )
        networks = sweep.load_trajectories(out / TRAJECTORIES_FILE)
    else:
        results, networks = _train(options, command)
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
    resumed = any(folder.iterdir())
    started = time.monotonic()
    with _Progress(sum(shard.n_steps for shard, _ in sweep.cut(planned, scale))) as progress:
        where = partial(_train_all, options=options, progress=progress)
        found = sweep.train(planned, scale, folder, where)
    names = {one.setting.scenario for one in planned}
    here = f"{options.workers} cores of {platform.machine()}"
    metadata = Metadata(
        command=command,
        scale=scale,
        worlds={name: World.of(scenarios.load(name)) for name in sorted(names)},
        greedy_missions=sweep.GREEDY_SEEDS[1],
        # Of an interrupted sweep nobody knows.
        wall_time_s=None if resumed else time.monotonic() - started,
        device=f"Ray cluster {options.ray}" if options.ray else here,
    )
    results, networks = sweep.collect(planned, metadata, found), sweep.trajectories(planned, scale, found)
    sweep.save_trajectories(networks, out / TRAJECTORIES_FILE)
    results.save(out)
    return results, networks


def _train_all(
    shards: Sequence[Shard], folder: Path, options: argparse.Namespace, progress: "_Progress"
) -> None:
    progress.expect(shards)
    if options.ray:
        train_on_ray(shards, folder, options.ray, progress.tell)
    else:
        train_here(shards, folder, options.workers, progress.tell)


def _make(out: Path, resume: bool) -> None:
    """Makes the folder of the results; refuses one that exists, unless it is to be gone on with."""
    if out.exists() and not resume:
        raise TrainingError(f"{out} exists; expected a new folder, or --resume")
    try:
        (out / "shards").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise TrainingError(f"{out} cannot be made: {error.strerror}") from None


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
        self._done[name] = shard.n_steps * n_flown // shard.population.n_episodes
        done, now = sum(self._done.values()), time.monotonic()
        rate = done / max(now - self._started, 1e-9)
        self._bar.update(self._task, completed=self._before + done, rate=f"{rate:,.0f} agent-steps/s")
        if not self._console.is_terminal and now - self._last > _LINE_EVERY_S:
            self._last = now
            left_s = (self._total - self._before - done) / max(rate, 1e-9)
            share = (self._before + done) / self._total
            self._console.print(
                f"{share:.0%} done, {rate:,.0f} agent-steps/s, {left_s / 60:.1f} minutes left"
            )
