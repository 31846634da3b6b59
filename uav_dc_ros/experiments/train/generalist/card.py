"""The card of a policy for any field: its training, evaluation and limits."""

from collections.abc import Mapping

from uav_dc_ros import __version__
from uav_dc_ros.agents.policy import Policy
from uav_dc_ros.agents.set_policy import PqnSettings, RolloutSettings, SetPolicyConfig
from uav_dc_ros.core.entities.encoding import CLUSTERS_MAX, SHAPE_MAX
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.experiments.evaluate.evaluation import TEST_SEEDS, evaluate, mean_and_interval
from uav_dc_ros.experiments.train.generalist.layouts import (
    SELECTION_LAYOUTS,
    SELECTION_MISSIONS,
    SELECTION_SEEDS,
    TRAINING_SEEDS,
)
from uav_dc_ros.scenarios import load, names

_FIGURES = ("objective", "landing_rate", "users_collected", "arrival_step")


def card(
    policy: Policy,
    command: str,
    seconds: float,
    decisions: int,
    score: float,
    baselines: Mapping[str, float],
) -> str:
    """Text of a policy's README.md.

    `seconds` is the wall time of the training, `decisions` the number that it learnt from, and `score` and
    `baselines` are J of the policy and of planners in the layouts that select.
    """
    config = policy.config
    assert isinstance(config, SetPolicyConfig), "made by this trainer"
    values, first = config.hyperparameters, TRAINING_SEEDS.start
    used = first + config.seed * values.iterations * values.layouts
    others = ", ".join(f"{name} {value:.4f}" for name, value in baselines.items())
    lines = ["| scenario | J | landed | users collected | at the dock by step |", "|---|---|---|---|---|"]
    table = "\n".join([*lines, *(row(policy, load(name)) for name in names())])
    hidden, shape = " and ".join(map(str, config.hidden)), " x ".join(map(str, SHAPE_MAX))
    last = used + values.iterations * values.layouts - 1
    return f"""# {config.name}

One policy for fields that it has not seen, with the `entities` observation: two networks, of V and of the
advantages, each with shared layers of {config.width} units for each cluster and hidden layers of {hidden}
units; {len(config.actions)} actions. The weight w of the objective J is an input: it is chosen when the
policy flies.

## How it was made

```
{command}
```

- uav_dc_ros {__version__}; {seconds / 60:.1f} minutes on one core, {decisions / 1e6:.1f} million decisions
- {_how(values)}
- random layouts, seeds {used} to {last}, {values.layouts} of {values.missions} missions an iteration, each
  flown in one iteration only; the reward is J, with w drawn for each mission
- chosen among all checkpoints by J in {SELECTION_LAYOUTS} layouts, seeds from {SELECTION_SEEDS.start}, with
  {SELECTION_MISSIONS} missions each and w from 0 to 1: iteration {config.iteration} with {score:.4f}; there
  {others}

## How it does

In the shipped scenarios, in none of which it was trained: {len(TEST_SEEDS)} missions each, seeds
{TEST_SEEDS[0]} to {TEST_SEEDS[-1]}, with the default w. 95% intervals of the mean by the bootstrap.

{table}

## Limits

It takes grids up to {shape} cells and up to {CLUSTERS_MAX} clusters or single users. It knows where the
clusters are, but not where single users walk, and expects each where it starts. It has met a line-of-sight
channel in simulation only: no wind, no fading, no lost packets.
"""


def _how(values: RolloutSettings | PqnSettings) -> str:
    """The algorithm and its hyperparameters."""
    if isinstance(values, RolloutSettings):
        return f"""policy improvement with rollouts (AggreVaTe; Ross and Bagnell, 2014): {values.iterations}
  iterations; in {values.tested:.0%} of the decisions all actions were flown, then the plan, for
  {values.horizon} steps; {values.random_moves:.0%} of the policy's moves were random; an iteration fits the
  decisions of the last {values.kept} with {values.batches} batches of {values.batch_size}, seen in the eight
  symmetries of the grid; an action must be worth {values.caution:g} steps more than the plan's; differences
  up to {values.steps_max:g} steps; learning rates {values.value_rate:g} of V and {values.advantage_rate:g} of
  A, which fall to a fiftieth"""
    return f"""PQN (Gallici et al., 2025): {values.iterations} iterations, {values.epochs} pass(es), batches
  of {values.batch_size}, learning rate {values.learning_rate:g}, which falls to a fiftieth, lambda
  {values.trace:g}, discount {values.discount:g}, advantage learning with alpha {values.advantage:g},
  probability of the greedy action (epsilon) {values.epsilon:g} to {values.epsilon_end:g}; the planner
  `fixed_tour` flies {values.demonstrations:.0%} of the layouts as demonstrations at first, and
  {values.demonstrations_end:.0%} after {values.shown:.0%} of the iterations"""


def row(policy: Policy, scenario: Scenario) -> str:
    """The table's row of a scenario: missions of the test seeds, with the default weight."""
    evaluation = evaluate(policy, scenario)
    shown = [mean_and_interval(figure, getattr(evaluation, figure)) for figure in _FIGURES]
    cells = [f"{mean} ({interval})" for mean, interval in shown]
    cells[2] += f" of {scenario.n_users}"
    cells[3] += f" of {scenario.mission.max_steps}"
    return f"| `{scenario.name}` | {' | '.join(cells)} |"


def checkpoint_card(policy: Policy, *, score: float, command: str) -> str:
    """Text of the README.md of a policy saved during training."""
    config = policy.config
    assert isinstance(config, SetPolicyConfig), "made by this trainer"
    return f"""# {config.name}, checkpoint

The best policy until iteration {config.iteration}: J {score:.4f} in the layouts that select. Made by

```
{command}
```
"""
