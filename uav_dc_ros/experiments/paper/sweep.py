"""The sweep: planned runs become shards, and their results become `Results`."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np
import safetensors.numpy
from safetensors import SafetensorError

from uav_dc_ros import files, scenarios
from uav_dc_ros.agents import network
from uav_dc_ros.core import world
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.core.world import observe
from uav_dc_ros.env.trajectory import Trajectory
from uav_dc_ros.errors import TrainingError
from uav_dc_ros.experiments.evaluate.rollout import roll_out_trajectory
from uav_dc_ros.experiments.paper.plan import FIGURES
from uav_dc_ros.experiments.paper.results import GREEDY, METRICS, Results, SweepMetadata
from uav_dc_ros.experiments.paper.setting import HIDDEN, OBSERVATION, PlannedRun, Scale, Setting
from uav_dc_ros.experiments.paper.shards import Shard, ShardResult, load_result
from uav_dc_ros.experiments.train.population import Population, architecture, layout

# Runs of a shard: enough to hide the overhead of an operation, few enough for a core's cache, and enough
# shards to keep the workers busy to the end.
_SHARD_RUNS = 128
# First seed and number in block 0; disjoint from training, validation and test.
GREEDY_SEEDS = (2_000_000, 20)
_GREEDY_BLOCK = 1_000  # greedy seeds from block to block

RunResults: TypeAlias = dict[PlannedRun, tuple[ShardResult, int]]  # result of its shard, and its index there
# A population of planned runs of a scenario, given by its name.
Populate: TypeAlias = Callable[[str, Sequence[PlannedRun], Scale], Population]
Networks: TypeAlias = dict[int, network.Parameters]  # trained ones of the figure `Traj`, by environment


def population(scenario: str, runs: Sequence[PlannedRun], scale: Scale) -> Population:
    """The runs of a shipped scenario as a population."""
    return Population(
        scenario=scenarios.load(scenario),
        observation=OBSERVATION,
        hidden=HIDDEN,
        runs=tuple(one.run(scale) for one in runs),
    )


def make_shards(
    planned: Sequence[PlannedRun], scale: Scale, populate: Populate = population
) -> list[tuple[Shard, list[PlannedRun]]]:
    """The runs as shards, each with its runs in order; longest first, so that none starts last."""
    groups: dict[tuple[str, int], list[PlannedRun]] = defaultdict(list)
    for one in planned:
        # A batch up to the paper's 32 costs as much as 32; only larger ones are separate.
        groups[one.setting.scenario, max(one.setting.batch_size, 32)].append(one)
    made = []
    for (scenario, _), runs in groups.items():
        # Neighbours with one learning rate share a step of the optimiser.
        runs = sorted(runs, key=lambda one: one.setting.learning_rate)
        for part in np.array_split(np.arange(len(runs)), -(-len(runs) // _SHARD_RUNS)):
            own = [runs[i] for i in part]
            shard = Shard(population=populate(scenario, own, scale), greedy_seeds=greedy_seeds(scale))
            made.append((shard, own))
    return sorted(made, key=lambda one: (-one[0].n_steps, one[0].name))


def greedy_seeds(scale: Scale) -> tuple[int, int]:
    """First seed of the greedy missions after training, and their number: others in each block."""
    return GREEDY_SEEDS[0] + _GREEDY_BLOCK * scale.block, GREEDY_SEEDS[1]


def load_results(shards: Iterable[tuple[Shard, list[PlannedRun]]], folder: Path) -> RunResults:
    """Reads the results of all shards; raises TrainingError if one is missing or damaged."""
    found: RunResults = {}
    for shard, runs in shards:
        result = load_result(folder, shard)
        found |= {one: (result, run) for run, one in enumerate(runs)}
    return found


def collect(planned: Sequence[PlannedRun], metadata: SweepMetadata, found: RunResults) -> Results:
    """The measures of the runs, as means over the episodes of a point and over the greedy missions."""
    n_points, per_point = metadata.scale.n_points, metadata.scale.episodes_per_point

    def curve(one: PlannedRun, name: str) -> Array:
        result, run = found[one]
        return result.curves[name][: n_points * per_point, run].reshape(n_points, per_point).mean(axis=1)

    def greedy(one: PlannedRun) -> list[float]:
        result, run = found[one]
        missions, max_steps = result.greedy, metadata.worlds[one.setting.scenario].max_steps
        values = (  # in the order of GREEDY
            missions.reward,
            missions.episode_return,
            missions.sum_rate_bps,
            missions.users_collected,
            missions.landed,
            np.where(missions.landed, missions.arrival_step, max_steps),
        )
        return [float(np.mean(value[run])) for value in values]

    return Results(
        metadata=metadata,
        planned=tuple(planned),
        episode=per_point * (1 + np.arange(n_points)),
        curves={name: np.stack([curve(one, name) for one in planned]) for name in METRICS},
        greedy=dict(zip(GREEDY, np.array([greedy(one) for one in planned], np.float32).T, strict=True)),
    )


def trajectory_networks(planned: Sequence[PlannedRun], scale: Scale, found: RunResults) -> Networks:
    """The networks of the figure `Traj`; none if its runs are not planned."""
    setting = _trajectory_setting(scale)
    own = {one.environment: found[one] for one in planned if one.setting == setting and one.repeat == 0}
    return {environment: result.parameters[run] for environment, (result, run) in own.items()}


def roll_out_trajectories(networks: Networks, scale: Scale) -> list[Trajectory]:
    """A greedy mission of each network in its environment."""
    scenario, sizes = _trajectory_network(scale)

    def trajectory(environment: int) -> Trajectory:
        def act(state: world.State) -> Array:
            observation = observe(OBSERVATION, scenario, state)
            return network.q_values(sizes, networks[environment], observation).argmax(-1)

        users = layout(environment, scenario.draws_shape)
        return roll_out_trajectory(scenario, act, greedy_seeds(scale)[0], users)

    return [trajectory(environment) for environment in sorted(networks)]


def save_networks(networks: Networks, path: Path) -> None:
    """Writes the networks, each parameter as `ENVIRONMENT.NAME`."""
    arrays = {f"{e}.{name}": values for e, own in networks.items() for name, values in own.items()}
    files.write(path, safetensors.numpy.save(arrays))


def load_networks(path: Path, scale: Scale) -> Networks:
    """Reads what `save_networks` wrote; raises TrainingError for other content."""
    expected = network.shapes(_trajectory_network(scale)[1])
    networks: Networks = defaultdict(dict)
    try:
        for key, values in safetensors.numpy.load(path.read_bytes()).items():
            environment, _, name = key.partition(".")
            networks[int(environment)][name] = values
        for own in networks.values():
            if {name: values.shape for name, values in own.items()} != expected:
                raise ValueError("not the parameters of the networks of a trajectory")
    except (OSError, SafetensorError, ValueError) as error:
        raise TrainingError(f"{path}: cannot be read: {error}") from None
    return networks


def _trajectory_setting(scale: Scale) -> Setting:
    (setting,) = FIGURES["Traj"].panels[0].settings(scale)
    return setting


def _trajectory_network(scale: Scale) -> tuple[Scenario, network.Architecture]:
    """The scenario of the figure `Traj`, and the sizes of its networks."""
    setting = _trajectory_setting(scale)
    made = population(setting.scenario, [PlannedRun(setting, 0, 0)], scale)
    return made.scenario, architecture(made, made.runs[0])
