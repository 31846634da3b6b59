"""The command line of `python -m uav_dc_ros.train`: options, checkpoints, the result."""

import argparse
import shlex
import shutil
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import msgspec
from rich.console import Console

from uav_dc_ros import __version__, cli, scenarios
from uav_dc_ros.agents import network, policy
from uav_dc_ros.agents.policy import Algorithm, Hyperparameters, PolicyConfig
from uav_dc_ros.core.reward import RewardForm, RPlus
from uav_dc_ros.core.scenario import Scenario, from_values
from uav_dc_ros.env.observations import Observation
from uav_dc_ros.errors import TrainingError
from uav_dc_ros.experiments.card import card, checkpoint_card
from uav_dc_ros.experiments.progress import Display

if TYPE_CHECKING:
    import torch

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
# Keys of a scenario's reward that an option may replace.
_REWARD_OPTIONS = {"beta": "beta", "zeta": "zeta", "r_plus": "r_plus", "reward_form": "form"}


def main(argv: list[str] | None = None) -> None:
    """Runs the command line, and exits."""
    argv = sys.argv[1:] if argv is None else argv
    options = options_parser().parse_args(argv)
    cli.run(lambda: _train(options, f"{PROG} {shlex.join(argv)}"), PROG)


def options_parser() -> cli.Parser:
    """The parser of the options."""
    parser = cli.Parser(
        prog=PROG,
        description="Train a policy. The result is a folder with its config, its parameters and its card.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    add = parser.add_argument
    add("--scenario", required=True, metavar="NAME|FILE", help=f"shipped: {', '.join(scenarios.names())}")
    add("--algo", required=True, choices=get_args(Algorithm), help="the paper's algorithm 1 or 2")
    add("--out", required=True, type=Path, metavar="DIR", help="folder to make, such as policies/NAME")
    add("--observation", default="mission", choices=get_args(Observation), help="what the agent sees")
    add("--aggregation", default="mean", choices=get_args(network.Aggregation), help="of the dueling streams")
    count: dict[str, Any] = {"type": cli.count, "metavar": "N"}
    add("--hidden", default=[64, 64], nargs="+", help="units of each hidden layer", **count)
    add("--seed", default=0, type=int, metavar="N", help="of the first run; the next has N + 1")
    add("--runs", default=1, help="runs side by side, of which the best is kept", **count)
    add("--checkpoint-every", default=100, help="episodes between validations", **count)
    add("--threads", default=1, help="of torch: equal numbers give equal results", **count)
    add("--device", default="cpu", help="where torch computes, such as cpu or cuda")
    learning = parser.add_argument_group("learning")
    for name, text in _LEARNING_OPTIONS.items():
        default = getattr(Hyperparameters(), name)
        learning.add_argument(_option(name), metavar="X", default=default, type=type(default), help=text)
    reward = parser.add_argument_group("reward, instead of the scenario's own; kept in the policy's config")
    instead: dict[str, Any] = {"default": argparse.SUPPRESS}
    reward.add_argument("--beta", metavar="X", type=float, help="weight of the data", **instead)
    reward.add_argument("--zeta", metavar="X", type=float, help="weight of R_plus", **instead)
    reward.add_argument("--r-plus", choices=get_args(RPlus), help="shape of R_plus", **instead)
    reward.add_argument("--reward-form", choices=get_args(RewardForm), help="what a step pays", **instead)
    return parser


def _train(options: argparse.Namespace, command: str) -> int:
    shipped = scenarios.load(options.scenario)
    config = _config(options, shipped)
    device = _device(options.device, options.threads)
    from uav_dc_ros.experiments.train import train  # needs torch, which _device() has asked for

    checkpoints = _reserve(options.out)
    started = time.monotonic()
    scenario = from_values(config.scenario, shipped.name)
    latest = None
    try:
        with Display(config.hyperparameters.episodes, options.checkpoint_every) as display:
            for report in train(config, scenario, options.runs, options.checkpoint_every, device):
                display.show(report)
                if report.best is not None:
                    best, score = report.best, report.score
                    config = msgspec.structs.replace(
                        config, seed=options.seed + report.run, episode=report.episode
                    )
                    text = checkpoint_card(config, score, command)
                    latest = _save_checkpoint(checkpoints, config, best, text)
    except KeyboardInterrupt:
        kept = f"the best policy until now is {latest}" if latest else "there is no checkpoint yet"
        if latest is None:
            checkpoints.rmdir()
        print(f"{PROG}: stopped; {kept}", file=sys.stderr)
        return cli.INTERRUPTED
    seconds = time.monotonic() - started
    policy.save(
        options.out,
        config,
        best,
        lambda loaded: card(loaded, shipped, command, options.runs, seconds, score),
    )
    shutil.rmtree(checkpoints)
    Console().print(f"{options.out}: {score:.1f} of {shipped.n_users} users brought home in validation")
    return 0


def _reserve(out: Path) -> Path:
    """Makes the folder for checkpoints beside `out`: an hour later is too late to find out that one cannot.

    Raises:
        PolicyError: it or `out` exists.
        TrainingError: it cannot be made.
    """
    checkpoints = out.with_name(f"{out.name}.checkpoints")
    policy.refuse_existing(out)
    policy.refuse_existing(checkpoints)
    try:
        checkpoints.mkdir(parents=True)
    except OSError as error:
        raise TrainingError(f"{checkpoints} cannot be made: {error.strerror}") from None
    return checkpoints


def _save_checkpoint(root: Path, config: PolicyConfig, best: network.Parameters, text: str) -> Path:
    folder = root / f"episode_{config.episode:06d}"
    policy.save(folder, config, best, lambda _: text)
    return folder


def _config(options: argparse.Namespace, shipped: Scenario) -> PolicyConfig:
    """The policy's config before training, from the options."""
    values: dict[str, Any] = msgspec.to_builtins(shipped)
    for option, key in _REWARD_OPTIONS.items():
        if option in options:
            values["reward"][key] = getattr(options, option)
    from_values(values, shipped.name)  # refuses what an option may have broken
    learning = {name: getattr(options, name) for name in _LEARNING_OPTIONS}
    try:
        return msgspec.convert(
            {
                "name": options.out.name,
                "algorithm": options.algo,
                "aggregation": options.aggregation,
                "observation": options.observation,
                "hidden": options.hidden,
                "hyperparameters": learning,
                "seed": options.seed,
                "episode": 0,
                "version": __version__,
                "scenario": values,
            },
            PolicyConfig,
        )
    except msgspec.ValidationError as error:
        # Such as: Expected `float` <= 1.0 - at `$.hyperparameters.gamma`
        expected, _, path = str(error).replace("`", "").replace("Expected", "expected").partition(" - at $.")
        key = path.split(".")[-1].split("[")[0]
        option, value = ("out", options.out.name) if key == "name" else (key, getattr(options, key))
        raise TrainingError(f"{_option(option)} is {value!r}; {expected}") from None


def _option(key: str) -> str:
    return f"--{key.replace('_', '-')}"


def _device(name: str, n_threads: int) -> "torch.device":
    """The device to compute on.

    Raises:
        TrainingError: torch is not installed, or has no such device.
    """
    try:
        import torch
    except ModuleNotFoundError:
        raise TrainingError(
            'torch is not installed; expected it from: pip install "uav_dc_ros[train]"'
        ) from None
    torch.set_num_threads(n_threads)
    try:
        torch.zeros(1, device=name)
    except (RuntimeError, AssertionError) as error:
        raise TrainingError(f"--device is {name!r}; {str(error).splitlines()[0]}") from None
    return torch.device(name)
