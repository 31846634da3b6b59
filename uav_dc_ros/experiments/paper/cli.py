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
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from uav_dc_ros import cli, files, scenarios
from uav_dc_ros.errors import FROM_TRAIN, TrainingError
from uav_dc_ros.experiments.paper.setting import MAX_BLOCK, SCALES, PlannedRun, Scale
from uav_dc_ros.experiments.paper.shards import Shard, result_file
from uav_dc_ros.experiments.paper.workers import train_locally, train_on_ray
from uav_dc_ros.experiments.train.progress import ProgressBar

if TYPE_CHECKING:
    from uav_dc_ros.experiments.paper.results import Results
    from uav_dc_ros.experiments.paper.sweep import Networks, RunResults
    from uav_dc_ros.experiments.paper.worlds.draw import World
    from uav_dc_ros.experiments.paper.worlds.verdicts import Multiverse

PROG = "python -m uav_dc_ros.paper"
NETWORKS_FILE = "trajectories.safetensors"
_PLAN_FILE = "plan.json"  # the options that the shards in a folder belong to
_LINE_EVERY_S = 30.0  # between two lines of progress without a terminal


def main(argv: list[str] | None = None) -> None:
    """Runs the command line, and exits."""
    argv = sys.argv[1:] if argv is None else argv
    parser = cli.Parser(
        prog=PROG,
        description="Run the sweep behind every figure of the paper, draw the figures, and test its claims.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    add = parser.add_argument
    add("--scale", default="full", choices=list(SCALES), help="smoke checks in a minute that all of it runs")
    block = cli.whole_number(0, MAX_BLOCK, f"a block, 0 to {MAX_BLOCK}")
    text = "environments and seeds: 0 those of all choices so far, 1 and above fresh ones, to confirm"
    add("--block", default=0, type=block, metavar="B", help=text)
    add("--only", nargs="+", metavar="FIGURE", help="these figures, and the claims that they can decide")
    text = "instead of the sweep, weigh the claims in N worlds drawn over what the paper leaves open"
    add("--worlds", type=cli.count, metavar="N", help=text)
    text = "with --worlds: weigh C1 alone in N more worlds, and all claims in those in which it holds"
    add("--screen", type=cli.count, metavar="N", help=text)
    add("--out", type=Path, metavar="DIR", default=Path("paper_results"), help="folder to make")
    add("--resume", action="store_true", help="resume the sweep in --out, or draw a finished one again")
    add("--workers", default=_cores(), type=cli.count, metavar="N", help="processes, each on one core")
    add("--ray", metavar="ADDRESS", help="train on this Ray cluster instead, such as HOST:6379")
    cli.run(lambda: _paper(parser.parse_args(argv), f"{PROG} {shlex.join(argv)}".strip()), PROG)


def _paper(options: argparse.Namespace, command: str) -> int:
    try:
        from uav_dc_ros.experiments.paper import plan, report, sweep
        from uav_dc_ros.experiments.paper.results import RUNS_FILE, Results
    except ModuleNotFoundError as error:
        raise TrainingError(f"{error.name} {FROM_TRAIN}") from None
    if find_spec("torch") is None:  # the workers need it
        raise TrainingError(f"torch {FROM_TRAIN}")
    if options.worlds is not None:
        return _weigh_worlds(options)
    if options.screen is not None:
        raise TrainingError("--screen without --worlds; expected both")
    scale, out = _scale(options), options.out
    planned = plan.runs(scale, options.only)
    if out.exists() and not options.resume:
        raise TrainingError(f"{out} exists; expected a new folder, or --resume")
    if (out / RUNS_FILE).is_file():
        results = Results.load(out)
        kept = results.metadata.scale
        if (kept.name, kept.block) != (scale.name, scale.block):
            raise TrainingError(
                f"{out} has the scale {kept.name!r}, block {kept.block}, and is finished; "
                f"expected {scale.name!r}, block {scale.block}, or another --out"
            )
        # Results of another version may have another number of environments and runs.
        scale, planned = kept, plan.runs(kept, options.only)
        if missing := set(planned) - set(results.planned):
            raise TrainingError(
                f"{out} is finished, without {len(missing)} runs of this command; expected another --out"
            )
        networks = sweep.load_networks(out / NETWORKS_FILE, scale)
    else:
        try:
            results, networks = _train(planned, options, command)
        except KeyboardInterrupt:
            return _stopped(out)
    report.write(results, sweep.roll_out_trajectories(networks, scale), out, options.only)
    shutil.rmtree(out / "shards", ignore_errors=True)
    Console().print(f"{out}: {len(results.planned)} runs; read {out / report.CLAIMS_FILE}", soft_wrap=True)
    return 0


def _scale(options: argparse.Namespace) -> Scale:
    return SCALES[options.scale].in_block(options.block)


def _stopped(out: Path) -> int:
    hint = "; --resume continues" if out.exists() else ""
    print(f"{PROG}: stopped{hint}", file=sys.stderr)
    return cli.INTERRUPTED


def _weigh_worlds(options: argparse.Namespace) -> int:
    """Weighs the claims in many worlds, and writes the verdicts and their page."""
    from uav_dc_ros.experiments.paper.worlds import page, plan
    from uav_dc_ros.experiments.paper.worlds.verdicts import VERDICTS_FILE, Multiverse

    scale, out, n = plan.SCALES[options.scale], options.out, options.worlds
    n_screened = options.screen or 0
    if options.only is not None or options.block:
        raise TrainingError(
            "--worlds with --only or --block; expected neither: its runs are those of the claims"
        )
    if out.exists() and not options.resume:
        raise TrainingError(f"{out} exists; expected a new folder, or --resume")
    if (out / VERDICTS_FILE).is_file():
        multiverse = Multiverse.load(out)
        kept = multiverse.metadata.scale.name, len(multiverse.drawn.worlds), len(multiverse.screened)
        if kept != (scale.name, n, n_screened):
            raise TrainingError(
                f"{out} has {kept[1]} worlds and {kept[2]} screened ones of the scale {kept[0]!r} and is "
                f"finished; expected {n} and {n_screened} of {scale.name!r}, or another --out"
            )
    else:
        try:
            multiverse = _train_worlds(options)
        except KeyboardInterrupt:
            return _stopped(out)
    page.write(multiverse, out)
    shutil.rmtree(out / "shards", ignore_errors=True)
    Console().print(f"{out}: {n} worlds; read {out / page.PAGE_FILE}", soft_wrap=True)
    return 0


def _train_worlds(options: argparse.Namespace) -> "Multiverse":
    """Trains the runs of all worlds, and saves the verdicts."""
    from uav_dc_ros.experiments.paper import sweep
    from uav_dc_ros.experiments.paper.worlds import draw, plan, verdicts

    scale, folder = plan.SCALES[options.scale], options.out / "shards"
    drawn, rejected = draw.worlds(options.worlds)
    # The first worlds of any number are the same, and so are their shards.
    _reserve(folder, {"worlds": "any number", "scale": options.scale})

    def trained(shards: "Sequence[list[tuple[Shard, list[PlannedRun]]]]") -> "list[RunResults]":
        _train_missing([shard for of_world in shards for shard, _ in of_world], folder, options)
        return [sweep.load_results(of_world, folder) for of_world in shards]

    def weighed(worlds: "Sequence[World]") -> "list[verdicts.Row]":
        results = trained([plan.make_shards(world, scale) for world in worlds])
        pairs = zip(worlds, results, strict=True)
        return [
            row for world, each in pairs for row in verdicts.rows(world, plan.findings(world, scale, each))
        ]

    def screened_by(environments: Sequence[int], worlds: "Sequence[World]") -> "dict[int, verdicts.Row]":
        results = trained([plan.make_screening_shards(world, scale, environments) for world in worlds])
        return {
            row.world: row
            for world, each in zip(worlds, results, strict=True)
            for row in verdicts.rows(world, plan.screening_findings(world, scale, environments, each))
        }

    rows, found = weighed(drawn), []
    screened: dict[int, verdicts.Row] = {}
    if options.screen is not None:
        worlds = plan.screening_worlds(options.worlds, options.screen)
        screened = screened_by(plan.wide(scale), worlds)
        undecided = [world for world in worlds if screened[world.number].verdict == "undecided"]
        screened |= screened_by(plan.wide(scale, plan.WIDEST), undecided)
        found = [world for world in worlds if screened[world.number].verdict == "holds"]
        # C1 as it was screened, in more environments than here.
        rows += [screened[row.world] if row.claim in plan.WIDE else row for row in weighed(found)]
    n_drawn = None if options.screen is None else len(drawn)
    multiverse = verdicts.Multiverse(
        metadata=verdicts.MultiverseMetadata(scale=scale, rejected=rejected, n_drawn=n_drawn),
        worlds=(*drawn, *found),
        rows=tuple(rows),
        screened=tuple(screened.values()),
    )
    multiverse.save(options.out)
    return multiverse


def _train(
    planned: Sequence[PlannedRun], options: argparse.Namespace, command: str
) -> "tuple[Results, Networks]":
    """Trains the planned runs, and saves the results."""
    from uav_dc_ros.experiments.paper import sweep
    from uav_dc_ros.experiments.paper.results import ScenarioFacts, SweepMetadata

    scale, out = _scale(options), options.out
    folder = out / "shards"
    only = None if options.only is None else sorted(set(options.only))
    _reserve(folder, {"scale": options.scale, "block": options.block, "only": only})
    shards = sweep.make_shards(planned, scale)
    _train_missing([shard for shard, _ in shards], folder, options)
    found = sweep.load_results(shards, folder)
    local = f"{options.workers} processes on {_cores()} cores of {platform.machine()}"
    names = sorted({one.setting.scenario for one in planned})
    metadata = SweepMetadata(
        command=command,
        scale=scale,
        worlds={name: ScenarioFacts.of(scenarios.load(name)) for name in names},
        greedy_missions=sweep.GREEDY_SEEDS[1],
        device=f"Ray cluster {options.ray}" if options.ray is not None else local,
    )
    results = sweep.collect(planned, metadata, found)
    networks = sweep.trajectory_networks(planned, scale, found)
    sweep.save_networks(networks, out / NETWORKS_FILE)
    results.save(out)
    return results, networks


def _train_missing(shards: Sequence[Shard], folder: Path, options: argparse.Namespace) -> None:
    """Trains the shards whose results are not in the folder."""
    missing = [shard for shard in shards if not result_file(folder, shard).is_file()]
    started = time.monotonic()
    try:
        if missing:
            with _Progress(sum(shard.n_steps for shard in shards), missing) as progress:
                if options.ray is not None:
                    train_on_ray(missing, folder, options.ray, progress.show)
                else:
                    train_locally(missing, folder, options.workers, progress.show)
            minutes = (time.monotonic() - started) / 60
            Console().print(f"trained {len(missing)} of {len(shards)} shards in {minutes:.1f} minutes")
    finally:
        _discard_empty(folder)


def _reserve(folder: Path, values: dict[str, object]) -> None:
    """Makes the folder of the shards, if it is not of another plan."""
    plan = msgspec.json.encode(values)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        saved = (folder / _PLAN_FILE).read_bytes() if (folder / _PLAN_FILE).is_file() else plan
    except OSError as error:
        raise TrainingError(f"{folder.parent} cannot be made: {error.strerror}") from None
    if saved != plan:
        raise TrainingError(
            f"{folder.parent} is half of a sweep with {saved.decode()}; "
            "expected the same options, or another --out"
        )
    files.write(folder / _PLAN_FILE, plan)


def _discard_empty(folder: Path) -> None:
    """Removes folders without shards or checkpoints, which the next command would refuse."""
    with contextlib.suppress(OSError):
        if not any(folder.glob("*.safetensors")):
            shutil.rmtree(folder)
            folder.parent.rmdir()


def _cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0))


class _Progress(ProgressBar):
    """Agent-steps done, their rate and the time left."""

    def __init__(self, total: int, shards: Sequence[Shard]) -> None:
        """For the shards to train; the rest of `total` agent-steps is done."""
        super().__init__(
            BarColumn(bar_width=20),
            TextColumn("{task.percentage:3.0f}%  {task.fields[text]}"),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            total=total,
        )
        self._total = total
        self._shards = {shard.name: shard for shard in shards}
        self._before = total - sum(shard.n_steps for shard in shards)
        # Agent-steps of each shard at its first update, and now.
        self._first: dict[str, int] = {}
        self._done: dict[str, int] = {}
        self._started = self._last = time.monotonic()

    def show(self, name: str, n_flown: int) -> None:
        """Shows the episodes flown by each run of a shard."""
        shard = self._shards[name]
        n_episodes = shard.population.n_episodes
        # A resumed shard begins at its checkpoint; one that reports only its end, at 0.
        begin = n_flown - 1 if n_flown < n_episodes else 0
        self._first.setdefault(name, shard.n_steps * begin // n_episodes)
        self._done[name] = shard.n_steps * n_flown // n_episodes
        done, now = sum(self._done.values()), time.monotonic()
        rate = (done - sum(self._first.values())) / max(now - self._started, 1e-9)
        completed, text, line = self._before + done, f"{rate:,.0f} agent-steps/s", None
        if now - self._last > _LINE_EVERY_S:
            self._last = now
            left_min = (self._total - completed) / max(rate, 1e-9) / 60
            line = f"{completed / self._total:.0%} done, {text}, {left_min:.1f} minutes left"
        self.update(completed, text, line)
