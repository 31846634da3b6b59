"""The command line of `python -m uav_dc_ros.train`: options, checkpoints, the resulting policy."""

import argparse
import contextlib
import math
import shlex
import shutil
import sys
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import msgspec

from uav_dc_ros import __version__, cli, scenarios
from uav_dc_ros.agents import network, policy
from uav_dc_ros.agents.agent import greedy_act
from uav_dc_ros.agents.policy import LEARNING_CURVE, TRAJECTORY, Algorithm, Hyperparameters, PolicyConfig
from uav_dc_ros.core.observations import Observation
from uav_dc_ros.core.reward import RewardData, RewardForm, RPlus
from uav_dc_ros.core.scenario import Scenario, from_values
from uav_dc_ros.errors import TrainingError
from uav_dc_ros.experiments.evaluate.evaluation import TEST_SEEDS, save_mission_picture
from uav_dc_ros.experiments.train.generalist import cli as generalist
from uav_dc_ros.experiments.train.policy_card import card, checkpoint_card
from uav_dc_ros.experiments.train.population import Population, Run
from uav_dc_ros.experiments.train.progress import TrainingProgress
from uav_dc_ros.experiments.train.replay_from_bags import PrefilledReplay, prefill_replay
from uav_dc_ros.experiments.train.start import make_folder, option_error, torch_device

if TYPE_CHECKING:
    from uav_dc_ros.experiments.train.training import Training

PROG = "python -m uav_dc_ros.train"
# Every hyperparameter is an option.
_LEARNING_OPTIONS = {
    "episodes": "missions to fly",
    "gamma": "discount",
    "epsilon": "probability of the greedy action",
    "batch_size": "transitions in a mini-batch",
    "learning_rate": "of Adam",
    "target_every": "iterations between two copies to the target network",
    "buffer_size": "transitions that the replay buffer holds",
}
# Options that replace a value of the scenario's reward; its key lacks the prefix `reward_`.
_REWARD_OPTIONS = ("beta", "zeta", "r_plus", "reward_form", "reward_data", "data_scale_bits")


class _SavedProgress(msgspec.Struct):
    """What a checkpoint holds beside the training; the file keeps the older names."""

    every: int  # episodes between checkpoints
    selection_score: float | None = msgspec.field(default=None, name="objective")  # highest until now
    score: float | None = None  # users that the policy with that score brought home in validation
    run: int = 0  # index of its run
    best: str = ""  # its folder's name
    seconds: float = 0.0  # wall time
    # Recorded flights that the replay buffers began with.
    prefilled: PrefilledReplay | None = msgspec.field(default=None, name="remembered")


def _saved_progress(values: dict[str, Any]) -> _SavedProgress:
    """The progress in a checkpoint; those of version 0.2.0 hold `merit`, which is 1.1 J - 0.1."""
    merit = values.get("merit")
    return msgspec.convert(
        values if merit is None else {**values, "objective": (merit + 0.1) / 1.1}, _SavedProgress
    )


def main(argv: list[str] | None = None) -> None:
    """Runs the command line, and exits."""
    argv = sys.argv[1:] if argv is None else argv
    command = f"{PROG} {shlex.join(argv)}"
    # Its options are others.
    algorithm = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    algorithm.add_argument("--algo")
    try:
        algo = algorithm.parse_known_args(argv)[0].algo
    except argparse.ArgumentError:
        algo = None
    if algo in generalist.SETTINGS:
        parser = generalist.options_parser(PROG, algo)
        cli.run(lambda: generalist.train(parser.parse_args(argv), command, PROG), PROG)
    cli.run(lambda: _train(options_parser().parse_args(argv), command), PROG)


def options_parser() -> cli.Parser:
    """The parser of the options."""
    parser = cli.Parser(
        prog=PROG,
        description="Train a policy. The result is a folder with its config, its parameters and its card.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    add = parser.add_argument
    algorithms = "the paper's algorithms 1 and 2, each with a double target, too; "
    algorithms += "--algo rollouts --help lists the options for a policy for any field"
    text = f"shipped: {', '.join(scenarios.names())}"
    add("--scenario", required=True, metavar="NAME|FILE|random:SEED", help=text)
    add("--algo", required=True, choices=[*get_args(Algorithm), *generalist.SETTINGS], help=algorithms)
    add("--out", required=True, type=Path, metavar="DIR", help="folder to make, such as policies/NAME")
    add("--observation", default="mission", choices=get_args(Observation), help="what the agent sees")
    add("--aggregation", default="mean", choices=get_args(network.Aggregation), help="of the dueling streams")
    count: dict[str, Any] = {"type": cli.count, "metavar": "N"}
    add("--hidden", default=[64, 64], nargs="+", help="units of each hidden layer", **count)
    add("--seed", default=0, type=int, metavar="N", help="of the first run; the next has N + 1")
    add("--runs", default=1, help="runs side by side, of which the best is kept", **count)
    add("--checkpoint-every", default=100, help="episodes between validations and checkpoints", **count)
    add("--resume", action="store_true", help="resume from the last checkpoint of the same command, if any")
    add("--from-bags", type=Path, nargs="+", metavar="BAG", help="recorded flights to start the replay with")
    add("--tensorboard", type=Path, metavar="DIR", help="write scalars of every run for TensorBoard")
    add("--threads", default=1, help="of torch: equal numbers give equal results", **count)
    add("--device", default="cpu", help="where torch computes, such as cpu or cuda")
    learning = parser.add_argument_group("learning")
    for name, text in _LEARNING_OPTIONS.items():
        default = getattr(Hyperparameters(), name)
        learning.add_argument(
            f"--{name.replace('_', '-')}", metavar="X", default=default, type=type(default), help=text
        )
    learning.add_argument("--n-step", default=1, help="steps of a return", **count)
    title = "reward, instead of the scenario's own; kept in the policy's config"
    add = parser.add_argument_group(title, argument_default=argparse.SUPPRESS).add_argument
    add("--beta", metavar="X", type=float, help="weight of the data")
    add("--zeta", metavar="X", type=float, help="weight of R_plus")
    add("--r-plus", choices=get_args(RPlus), help="shape of R_plus")
    add("--reward-form", choices=get_args(RewardForm), help="reward of a step")
    add("--reward-data", choices=get_args(RewardData), help="data in r^t (eq. 7): of the step, or so far")
    add("--data-scale-bits", metavar="X", type=float, help="data of a user that counts as 1 in r^t, bit")
    return parser


def _train(options: argparse.Namespace, command: str) -> int:
    shipped = scenarios.load(options.scenario)
    config = _config(options, shipped)
    population = _population(config, shipped.name, options.runs)
    device = torch_device(options.device, options.threads)
    # These need torch, which torch_device() has found.
    from uav_dc_ros.experiments.train import checkpoint
    from uav_dc_ros.experiments.train.tensorboard import TensorBoardLog
    from uav_dc_ros.experiments.train.training import Training, validate

    folder = options.out.with_name(f"{options.out.name}.checkpoints")
    saved = folder / "training.safetensors"
    policy.check_new(options.out)
    try:
        training = Training(population, device)
    except (MemoryError, RuntimeError) as error:  # torch raises the latter when memory is short
        raise TrainingError(f"the training cannot be set up: {str(error).splitlines()[0]}") from None
    every = options.checkpoint_every
    progress = _SavedProgress(every)
    if options.resume and saved.is_file():
        progress = _saved_progress(checkpoint.restore(saved, training))
        checkpoint.refuse_other(saved, "checkpoint_every", progress.every, every)
        bags = list(progress.prefilled.bags) if progress.prefilled else None
        expected = list(map(str, options.from_bags)) if options.from_bags else None
        checkpoint.refuse_other(saved, "from_bags", bags, expected)
        policy.load(folder / progress.best)  # a damaged one is an error now, not after the training
    elif options.from_bags:
        progress.prefilled = prefill_replay(training, options.from_bags)
        print(f"replay starts with {progress.prefilled}")
    make_folder(folder, options.resume, "episode_", training.n_flown)
    started = time.monotonic() - progress.seconds
    try:
        with (
            TrainingProgress(training, every) as display,
            TensorBoardLog(options.tensorboard, options.out.name, training) as scalars,
        ):
            while training.n_flown < population.n_episodes:
                training.fly_episode()
                scalars.add_episode()
                if training.n_flown % every == 0 or training.n_flown == population.n_episodes:
                    found = validate(training)
                    run = int(found.selection_score.argmax())
                    highest = float(found.selection_score[run])
                    if progress.selection_score is None or highest > progress.selection_score:
                        progress.run, progress.selection_score = run, highest
                        progress.score = float(found.brought_home[run])
                        progress.best = _save_best(folder, config, training, progress, command)
                    progress.seconds = time.monotonic() - started
                    scalars.add_scores(found.brought_home)
                    checkpoint.save(saved, training, progress)
                display.show(math.nan if progress.score is None else progress.score)
    except KeyboardInterrupt:
        if saved.is_file():
            kept = f"the best policy until now is {folder / progress.best}; --resume continues"
        else:
            shutil.rmtree(folder, ignore_errors=True)
            kept = "there is no checkpoint yet"
        print(f"{PROG}: stopped; {kept}", file=sys.stderr)
        return cli.INTERRUPTED
    finally:
        with contextlib.suppress(OSError):
            folder.rmdir()  # an empty one, which the next command would refuse
    best = policy.load(folder / progress.best)
    assert progress.score is not None, "the last episode is validated"
    text = (shipped, command, options.runs, progress.seconds, progress.score, progress.prefilled)
    draw = partial(_draw, shipped, training)
    policy.save(options.out, best.config, best.parameters, lambda made: card(made, *text), draw)
    shutil.rmtree(folder)
    print(f"{options.out}: {progress.score:.1f} of {shipped.n_users} users brought home in validation")
    return 0


def _population(config: PolicyConfig, name: str, n_runs: int) -> Population:
    """Runs that differ in their seeds only: `config.seed`, `config.seed + 1`, ..."""
    scenario = from_values(config.scenario, name)
    first = Run(
        seed=config.seed,
        algorithm=config.algorithm,
        aggregation=config.aggregation,
        reward=scenario.reward,
        hyperparameters=config.hyperparameters,
    )
    runs = tuple(msgspec.structs.replace(first, seed=config.seed + i) for i in range(n_runs))
    return Population(scenario=scenario, observation=config.observation, hidden=config.hidden, runs=runs)


def _save_best(
    folder: Path, config: PolicyConfig, training: "Training", progress: _SavedProgress, command: str
) -> str:
    """Saves the best run's policy, and returns the name of its folder."""
    assert progress.score is not None
    config = msgspec.structs.replace(config, seed=config.seed + progress.run, episode=training.n_flown)
    text = checkpoint_card(config, progress.score, command)
    name = f"episode_{training.n_flown:06d}"
    policy.save(folder / name, config, training.learner.parameters(progress.run), lambda _: text)
    return name


def _draw(scenario: Scenario, training: "Training", made: policy.Policy, folder: Path) -> None:
    """Draws the plots in a policy's folder: its learning curve, and a mission."""
    try:
        from uav_dc_ros.experiments.train.learning_curve import save_learning_curve  # needs matplotlib
    except ModuleNotFoundError:  # a policy without plots is better than none
        print(
            'no pictures without matplotlib; it comes with: pip install "uav_dc_ros[train]"', file=sys.stderr
        )
        return
    chosen = made.config.seed - training.population.runs[0].seed
    save_learning_curve(training, chosen, folder / LEARNING_CURVE)
    save_mission_picture(greedy_act(made, scenario), scenario, TEST_SEEDS[0], folder / TRAJECTORY)


def _config(options: argparse.Namespace, shipped: Scenario) -> PolicyConfig:
    """The policy's config before training, from the options."""
    values: dict[str, Any] = msgspec.to_builtins(shipped)
    for option in _REWARD_OPTIONS:
        if option in options:
            values["reward"][option.removeprefix("reward_")] = getattr(options, option)
    from_values(values, shipped.name)  # rejects an invalid value of an option
    try:
        return msgspec.convert(
            {
                "name": options.out.name,
                "algorithm": options.algo,
                "aggregation": options.aggregation,
                "observation": options.observation,
                "hidden": options.hidden,
                "hyperparameters": {name: getattr(options, name) for name in _LEARNING_OPTIONS}
                | ({"n_step": options.n_step} if options.n_step > 1 else {}),
                "seed": options.seed,
                "episode": 0,
                "version": __version__,
                "scenario": values,
            },
            PolicyConfig,
        )
    except msgspec.ValidationError as error:
        raise option_error(error, options) from None
