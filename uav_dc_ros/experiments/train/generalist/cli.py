"""The command line of `python -m uav_dc_ros.train --algo rollouts` (or `pqn`): a policy for unseen fields."""

import argparse
import shutil
import sys
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from uav_dc_ros import __version__, cli, scenarios
from uav_dc_ros.agents import policy
from uav_dc_ros.agents.agent import greedy_act
from uav_dc_ros.agents.policy import LEARNING_CURVE, TRAJECTORY, Policy
from uav_dc_ros.agents.set_policy import PqnSettings, RolloutSettings, SetPolicyConfig
from uav_dc_ros.core.keys import leaves
from uav_dc_ros.experiments.evaluate.evaluation import TEST_SEEDS, save_mission_picture
from uav_dc_ros.experiments.train.generalist.card import card, checkpoint_card
from uav_dc_ros.experiments.train.start import make_folder, option_error, torch_device

if TYPE_CHECKING:
    from uav_dc_ros.experiments.train.generalist.training import GeneralistTraining

RANDOM = "random"  # the value of `--scenario`: random layouts
HOME = "five_clusters"  # the world in which a generalist flies where no other is given
SETTINGS: dict[str, type[RolloutSettings | PqnSettings]] = {
    "rollouts": RolloutSettings,
    "pqn": PqnSettings,
}  # by algorithm
_TEXTS = {
    "iterations": "rounds of flying and fitting",
    "layouts": "new layouts of an iteration",
    "missions": "missions in each layout",
    "batch_size": "decisions in a mini-batch",
    "value_rate": "learning rate of V at the start; it falls to a fiftieth",
    "advantage_rate": "learning rate of A at the start; it falls to a fiftieth",
    "tested": "share of the decisions in which all actions are flown",
    "random_moves": "share of the moves that are random",
    "horizon": "steps that are flown then; the plan estimates what the mission is worth from there",
    "caution": "steps by which an action must be worth more than the plan's own to be preferred",
    "kept": "iterations of which the decisions are fitted",
    "batches": "mini-batches of an iteration",
    "steps_max": "limit of the difference between an action and the plan's own, in steps, that is fitted",
    "epochs": "passes over the decisions of an iteration",
    "learning_rate": "of Adam at the start; it falls to a fiftieth",
    "trace": "lambda of the returns",
    "discount": "of a step",
    "advantage": "alpha of advantage learning",
    "demonstrations": "share of the layouts that the planner `fixed_tour` flies at the start",
    "demonstrations_end": "that share later",
    "shown": "share of the iterations in which it falls to that",
    "epsilon": "probability of the greedy action, or the planner's, at the start",
    "epsilon_end": "that probability at the end",
}


class _SavedProgress(msgspec.Struct):
    """What a checkpoint holds beside the training."""

    every: int  # iterations between checkpoints
    score: float | None = None  # highest J in the layouts that select
    best: str = ""  # the folder of its policy
    scores: list[tuple[int, float]] = []  # iteration and J of each checkpoint
    baselines: dict[str, float] = {}  # J of planners in the same missions
    seconds: float = 0.0  # wall time


def options_parser(prog: str, algorithm: str) -> cli.Parser:
    """The parser of the options of an algorithm, a key of `SETTINGS`."""
    parser = cli.Parser(
        prog=prog,
        description="Train a policy for any field, on random layouts.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    add = parser.add_argument
    add("--algo", required=True, choices=[algorithm], help="others have other options")
    add("--scenario", required=True, choices=[RANDOM], help="random layouts, new ones in each iteration")
    add("--observation", default="entities", choices=["entities"], help="what the agent sees")
    add("--out", required=True, type=Path, metavar="DIR", help="folder to make, such as policies/NAME")
    count: dict[str, Any] = {"type": cli.count, "metavar": "N"}
    add("--width", default=64, help="units of the layers of a cluster", **count)
    add("--hidden", default=[128, 128], nargs="+", help="units of each layer behind the pooling", **count)
    add("--seed", default=0, type=int, metavar="N", help="of the run")
    add("--checkpoint-every", default=20, help="iterations between validations and checkpoints", **count)
    add("--resume", action="store_true", help="resume from the last checkpoint of the same command, if any")
    add("--threads", default=1, help="of torch: equal numbers give equal results", **count)
    learning = parser.add_argument_group("learning")
    for name in SETTINGS[algorithm].__struct_fields__:
        default = getattr(SETTINGS[algorithm](), name)
        option, text = f"--{name.replace('_', '-')}", _TEXTS[name]
        learning.add_argument(option, metavar="X", default=default, type=type(default), help=text)
    return parser


def train(options: argparse.Namespace, command: str, prog: str) -> int:
    """Train, and write the policy with the highest J in the layouts that select; the exit status."""
    config = _config(options)
    command = command.replace(" --resume", "")  # which changes nothing of the result
    torch_device("cpu", options.threads)
    # These need torch.
    from uav_dc_ros.experiments.train import checkpoint
    from uav_dc_ros.experiments.train.generalist.pqn import PqnTraining
    from uav_dc_ros.experiments.train.generalist.rollout_training import RolloutTraining
    from uav_dc_ros.experiments.train.generalist.training import BASELINES

    folder = options.out.with_name(f"{options.out.name}.checkpoints")
    saved, every = folder / "training.safetensors", options.checkpoint_every
    policy.check_new(options.out)
    architecture = config.architecture(scenarios.load(HOME))
    training: GeneralistTraining
    if isinstance(config.hyperparameters, RolloutSettings):
        training = RolloutTraining(config.hyperparameters, architecture, config.seed)
    else:
        training = PqnTraining(config.hyperparameters, architecture, config.seed)
    progress = _SavedProgress(every)
    if options.resume and saved.is_file():
        with checkpoint.reading(saved) as (arrays, values):
            before, here = (dict(leaves(value)) for value in (values["config"], msgspec.to_builtins(config)))
            for key in here | before:
                checkpoint.refuse_other(saved, key, before.get(key, "absent"), here.get(key, "absent"))
            training.restore(arrays, values)
            progress = msgspec.convert(values["progress"], _SavedProgress)
        checkpoint.refuse_other(saved, "checkpoint_every", progress.every, every)
        policy.load(folder / progress.best)  # a damaged one is an error now, not after the training
    make_folder(folder, options.resume, "iteration_", training.n_done)
    started = time.monotonic() - progress.seconds
    total = config.hyperparameters.iterations
    try:
        if not progress.baselines:
            progress.baselines = {name: training.baseline(name) for name in BASELINES}
            progress.baselines["the plan alone"] = training.plan()
            others = ", ".join(f"{name} {value:.4f}" for name, value in progress.baselines.items())
            print(f"J in the layouts that select: {others}", flush=True)
        while training.n_done < total:
            training.iterate()
            if training.n_done % every and training.n_done < total:
                continue
            score = training.validate()
            progress.scores.append((training.n_done, score))
            if progress.score is None or score > progress.score:
                progress.score, progress.best = score, f"iteration_{training.n_done:06d}"
                made = msgspec.structs.replace(config, iteration=training.n_done)
                text = partial(checkpoint_card, score=score, command=command)
                policy.save(folder / progress.best, made, training.learner.parameters(), text)
            progress.seconds = time.monotonic() - started
            arrays, values = training.state()
            checkpoint.write(saved, arrays, values | {"config": config, "progress": progress})
            print(_line(training, progress), flush=True)
    except KeyboardInterrupt:
        if saved.is_file():
            kept = f"the best policy until now is {folder / progress.best}; --resume continues"
        else:
            shutil.rmtree(folder, ignore_errors=True)
            kept = "there is no checkpoint yet"
        print(f"{prog}: stopped; {kept}", file=sys.stderr)
        return cli.INTERRUPTED
    best = policy.load(folder / progress.best)
    assert progress.score is not None, "the last iteration is validated"
    decisions = sum(one.decisions for one in training.curve)

    def text_of(made: Policy) -> str:
        return card(made, command, progress.seconds, decisions, progress.score or 0.0, progress.baselines)

    def draw(made: Policy, into: Path) -> None:
        from uav_dc_ros.experiments.train.generalist.curve import save_curve  # needs matplotlib

        save_curve(training.curve, progress.scores, progress.baselines, into / LEARNING_CURVE)
        save_mission_picture(greedy_act(made, made.scenario), made.scenario, TEST_SEEDS[0], into / TRAJECTORY)

    policy.save(options.out, best.config, best.parameters, text_of, draw)
    shutil.rmtree(folder)
    print(f"{options.out}: J {progress.score:.4f} in the layouts that select")
    return 0


def _line(training: "GeneralistTraining", progress: _SavedProgress) -> str:
    latest = training.curve[-progress.every :]
    explored = sum(one.objective for one in latest) / len(latest)
    landed = sum(one.landed for one in latest) / len(latest)
    decisions = sum(one.decisions for one in training.curve)
    return (
        f"iteration {training.n_done}: J {progress.scores[-1][1]:.4f}, best {progress.score:.4f}; exploring "
        f"{explored:.4f}, landed {landed:.2%}, loss {latest[-1].loss:.5f}; {decisions / 1e6:.1f}M decisions "
        f"in {progress.seconds / 60:.1f} minutes"
    )


def _config(options: argparse.Namespace) -> SetPolicyConfig:
    """The policy's config before training, from the options."""
    try:
        return msgspec.convert(
            {
                "name": options.out.name,
                "width": options.width,
                "hidden": options.hidden,
                "hyperparameters": {"type": options.algo}
                | {name: getattr(options, name) for name in SETTINGS[options.algo].__struct_fields__},
                "seed": options.seed,
                "iteration": 0,
                "version": __version__,
                "scenario": msgspec.to_builtins(scenarios.load(HOME)),
            },
            SetPolicyConfig,
        )
    except msgspec.ValidationError as error:
        raise option_error(error, options) from None
