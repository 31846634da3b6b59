"""The card of a policy: its training, evaluation and limits."""

from uav_dc_ros import __version__
from uav_dc_ros.agents.policy import Policy, PolicyConfig
from uav_dc_ros.core import channel, reward
from uav_dc_ros.core.mobility import GaussMarkov, RandomWalk, RandomWaypoint, Static
from uav_dc_ros.core.objective import DEFAULT_WEIGHT
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.experiments.evaluate.evaluation import (
    COLUMNS,
    OBJECTIVE_IN_WORDS,
    ONE_MISSION,
    card_seeds,
    evaluate,
    rows,
)
from uav_dc_ros.experiments.train.replay_from_bags import PrefilledReplay

_ALGORITHMS = {
    "dqn": "DQN",
    "dueling_dqn": "Dueling DQN",
    "double_dqn": "Double DQN",
    "dueling_double_dqn": "Dueling double DQN",
}
_LIMITS = {
    "position": """\
It sees its cell and nothing else: it cannot know what it has collected or how much time is left, so its
greedy mission is one fixed path, and where it stays for one step it stays for good.""",
    "mission": "It sees how far each cluster is collected, but not where single users are.",
    "energy": "It sees how far each cluster is collected and how full the battery is, but not single users.",
    "entities": "It sees the clusters and which actions can still land, but it has met no other map.",
    "map": "It sees where the clusters are, but it has met no other map than this one.",
}
_USERS = {
    RandomWalk: "slowly walking users",
    Static: "users that stand still",
    RandomWaypoint: "users on the way to random waypoints",
    GaussMarkov: "Gauss-Markov users",
}


def card(
    policy: Policy,
    scenario: Scenario,
    command: str,
    n_runs: int,
    seconds: float,
    score: float,
    prefilled: PrefilledReplay | None,
) -> str:
    """Text of a policy's README.md.

    `scenario`, without the overrides of `command`, evaluates the policy. `seconds` is the wall time of the
    training, and `score` the number of users brought home in validation.
    """
    config = policy.config
    assert isinstance(config, PolicyConfig), "made by this trainer"
    values = config.hyperparameters
    hidden = " and ".join(map(str, config.hidden))
    seeds, radio = card_seeds(scenario), channel.title(scenario.radio)
    missions = f"One mission, flown greedily: {ONE_MISSION}."
    if scenario.is_random:
        missions = f"{len(seeds)} missions, seeds {seeds[0]} to {seeds[-1]}, flown greedily, each drawn anew."
    met = "a line-of-sight channel" if radio == "free_space" else f"the channel {radio}"
    calm = "no wind, no fading" if scenario.radio.fading is None else "no wind"
    users = _USERS[type(scenario.users.moves)]
    algorithm, n_users = _ALGORITHMS[config.algorithm], scenario.n_users
    lines = (COLUMNS, ["---"] * len(COLUMNS), *rows(evaluate(policy, scenario, seeds)))
    began = "" if prefilled is None else f"\n- the replay buffer began with {prefilled}"
    table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    return f"""# {config.name}

{algorithm} for the scenario `{scenario.name}`, with the `{config.observation}` observation,
hidden layers of {hidden} units and {len(config.actions)} actions.

## How it was made

```
{command}
```

- uav_dc_ros {__version__}; {seconds / 60:.1f} minutes for {n_runs} run(s) of {values.episodes} episodes
- chosen among all runs and checkpoints by validation missions, which share no seed with those below, for the
  highest mean objective J with w = {DEFAULT_WEIGHT:.3f}: the run with seed {config.seed} after episode
  {config.episode}, which brought {score:.2f} of {n_users} users home
- gamma {values.gamma:g}, epsilon {values.epsilon:g} (probability of the greedy action)
- batches of {values.batch_size}, learning rate {values.learning_rate:g}
- target network copied every {values.target_every} iterations, replay buffer of {values.buffer_size}{began}
- the reward it learnt from: {_reward(policy.scenario)}

## How it does

{missions}
Rewards are those of the scenario as it is shipped: {_reward(scenario)}.
The arrival step is over missions that landed. Intervals of the mean are by the bootstrap.
{OBJECTIVE_IN_WORDS}

{table}

## Limits

{_LIMITS[config.observation]}
It knows one field: another layout of clusters on the same grid would be flown as if it were this one. It has
met {users} and {met}, in simulation only: {calm}, no lost packets.
"""


def checkpoint_card(config: PolicyConfig, score: float, command: str) -> str:
    """Text of the README.md of a policy saved during training."""
    return f"""# {config.name}, checkpoint

The best policy until episode {config.episode}, from the run with seed {config.seed}. In validation it brought
{score:.2f} users home; it is not evaluated yet. Made by

```
{command}
```
"""


def _reward(scenario: Scenario) -> str:
    values = scenario.reward
    weights = f"beta {values.beta:g}, zeta {values.zeta:g}"
    return f"{weights}, {values.r_plus} R_plus, {values.form} form, {reward.DATA[values.data]}"
