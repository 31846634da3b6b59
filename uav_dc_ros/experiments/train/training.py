"""The training loop: N runs side by side, one episode at a time; and their validation. Needs torch.

Every random number of a run comes from the run's own numpy generator and is drawn for a whole episode at
once. So a run learns the same alone and among others, it starts the same on every device, and a GPU does not
wait for the host at every step. The worlds are in numpy beside a learner on the CPU, and in torch on any
other device; they are the same functions.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from msgspec import UNSET
from torch import Tensor

from uav_dc_ros.agents.dqn import Learner, Mask, Member
from uav_dc_ros.agents.replay import ReplayBuffer, TransitionBatch
from uav_dc_ros.core import observations
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.entities.encoding import allowed
from uav_dc_ros.core.observations import Observation
from uav_dc_ros.core.reward import Rewards
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.core.world import BatchWorld, State, observe
from uav_dc_ros.experiments.evaluate.rollout import Missions, roll_out
from uav_dc_ros.experiments.train.episode_stats import CURVES, EpisodeStats
from uav_dc_ros.experiments.train.population import Population, Run, architecture, layout
from uav_dc_ros.recordings.transitions import Transition

# Separates a run's stream from that of the mission with the same seed.
_TRAINING_STREAM = 1
# Missions that select among runs and checkpoints; seeds 0 to 99 evaluate the selected one.
VALIDATION_SEEDS = range(1_000_000, 1_000_100)


def prepare_torch(n_threads: int) -> None:
    """Sets up torch in a process that trains: equal settings give equal results."""
    torch.set_num_threads(n_threads)
    # Adam's moments of a dead unit decay for ever; as denormal numbers they would slow every step.
    torch.set_flush_denormal(True)


class Training:
    """A population between two episodes."""

    def __init__(
        self, population: Population, device: torch.device, worlds_in: Literal["numpy", "torch"] | None = None
    ) -> None:
        """Runs before their first episode; the worlds are in numpy on the CPU, else in torch, by default."""
        self.population, self.device = population, device  # the runs, and where their learner computes
        self._on_host = (worlds_in or ("numpy" if device.type == "cpu" else "torch")) == "numpy"
        self._rngs = [
            np.random.default_rng(np.random.SeedSequence(run.seed, spawn_key=(_TRAINING_STREAM,)))
            for run in population.runs
        ]
        architectures = [architecture(population, run) for run in population.runs]
        members = [
            Member(one, run.hyperparameters, rng, "double" in run.algorithm)
            for one, run, rng in zip(architectures, population.runs, self._rngs, strict=True)
        ]
        mask = action_mask(population.scenario, population.observation)
        self.learner = Learner(members, device, mask)
        first = population.runs[0].hyperparameters
        gammas = torch.tensor([[run.hyperparameters.gamma] for run in population.runs], device=device)
        self._n_steps = 1 if first.n_step is UNSET else first.n_step
        self._buffer = ReplayBuffer(
            len(population.runs), first.buffer_size, architectures[0].n_inputs, device, self._n_steps, gammas
        )
        reward = rewards(population.runs, self._world_array)
        self._worlds = BatchWorld(population.scenario, self._layouts(1)[0], reward)
        self._stats = EpisodeStats(population.scenario, self._worlds.state.total_reward)
        self._curves = np.full(
            (population.n_episodes, len(CURVES), len(population.runs)), np.nan, dtype=np.float32
        )
        self.n_flown = 0  # episodes, by each run

    @property
    def curves(self) -> dict[str, Array]:
        """Statistics of every episode flown, float32 `[n_flown, N]` each; see `episode_stats.CURVES`."""
        return {name: self._curves[: self.n_flown, i] for i, name in enumerate(CURVES)}

    @property
    def replay_size(self) -> int:
        """Transitions in the replay buffer of each run."""
        return len(self._buffer)

    def add_recorded(self, transition: Transition) -> None:
        """Puts a recorded transition into the replay buffer of every run."""
        n_runs = len(self.population.runs)
        numbers = torch.tensor([transition.action, transition.reward, transition.terminated])
        action, reward, terminated = numbers.to(self.device)[:, None].expand(-1, n_runs)
        observation, next_observation = (
            torch.from_numpy(values).to(self.device).expand(n_runs, -1)
            for values in (transition.observation, transition.next_observation)
        )
        transitions = TransitionBatch(observation, action, reward, next_observation, terminated)
        # What is recorded may have gaps: its returns are of one step.
        self._buffer.add(transitions, torch.ones_like(terminated, dtype=torch.bool))

    @torch.inference_mode()  # the learner computes its own gradient, so autograd need not record
    def fly_episode(self) -> None:
        """T_cons iterations of every run, each one step and one gradient step (algorithms 1 and 2).

        Under `on_arrival`, and where a battery ends missions, an episode may hold several missions.
        """
        scenario, worlds, kind = self.population.scenario, self._worlds, self.population.observation
        n_steps, at_any_step = scenario.mission.max_steps, scenario.ends_at_any_step
        walk, explore, choice, replay = self._draws(n_steps)
        starts = self._layouts(n_steps if at_any_step else 1)
        loss = torch.zeros(len(self.population.runs), device=self.device)
        observation = self._tensor(worlds.observe(kind))
        for t in range(n_steps):
            action = self.learner.act(observation, explore[t], choice[t])
            outcome = worlds.step(action.numpy() if self._on_host else action, walk[t])
            next_observation = self._tensor(worlds.observe(kind))
            reward, terminated = self._tensor(outcome.reward), self._tensor(outcome.terminated)
            over = self._tensor(outcome.terminated | outcome.truncated) if self._n_steps > 1 else terminated
            transitions = TransitionBatch(observation, action, reward, next_observation, terminated)
            self._buffer.add(transitions, over)
            loss += self.learner.update(self._buffer.sample(replay[t]))
            self._stats.add_step(worlds.state, outcome)
            # Reading from the device which missions ended would make the host wait: under `at_time_limit`
            # only the last step ends one, unless a battery does; under `on_arrival` every step can.
            if at_any_step or t == n_steps - 1:
                ended = outcome.terminated | outcome.truncated
                self._stats.end_missions(ended, worlds.state, outcome)
                worlds.restart(ended, starts[t - n_steps])
                next_observation = self._tensor(worlds.observe(kind))
            observation = next_observation
        self._curves[self.n_flown] = [*self._stats.take(), (loss / n_steps).cpu().numpy()]
        self.n_flown += 1

    def _draws(self, n_steps: int) -> tuple[Array, Tensor, Tensor, Tensor]:
        """Uniform draws for walks `[T, N, U, D]`, explore and choice `[T, N]`, and replay `[T, N, B]`."""
        shape, runs = self.population.scenario.draws_shape, self.population.runs
        sizes = [run.hyperparameters.batch_size for run in runs]
        walk = np.empty((n_steps, len(runs), shape[0] * shape[1]), np.float32)
        pick = np.zeros((n_steps, len(runs), 2 + max(sizes)), np.float32)
        for i, (rng, size) in enumerate(zip(self._rngs, sizes, strict=True)):
            walk[:, i] = rng.random((n_steps, shape[0] * shape[1]), np.float32)
            pick[:, i, : 2 + size] = rng.random((n_steps, 2 + size), np.float32)
        walks = self._world_array(walk.reshape(n_steps, len(runs), *shape))
        picks = torch.from_numpy(pick).to(self.device)
        return walks, picks[..., 0], picks[..., 1], picks[..., 2:]

    def _layouts(self, n: int) -> Array:
        """Draws for the initial users of n missions, `[n, N, U, D]`."""
        shape = self.population.scenario.draws_shape
        starts = np.empty((n, len(self.population.runs), *shape), np.float32)
        for i, (rng, run) in enumerate(zip(self._rngs, self.population.runs, strict=True)):
            fixed = None if run.environment is None else layout(run.environment, shape)
            starts[:, i] = rng.random((n, *shape), np.float32) if fixed is None else fixed
        return self._world_array(starts)

    def _world_array(self, values: np.ndarray) -> Array:
        return values if self._on_host else torch.from_numpy(values).to(self.device)

    def _tensor(self, values: Array) -> Tensor:
        """An array of the worlds for the learner, without a copy."""
        return torch.from_numpy(values) if self._on_host else values

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Everything that later episodes depend on: arrays, and values that JSON can hold."""
        parts = {
            "learner": self.learner.state(),
            "buffer": self._buffer.state(),
            "world": {name: torch.as_tensor(v) for name, v in asdict(self._worlds.state).items()},
            "books": {name: torch.as_tensor(v) for name, v in self._stats.state().items()},
        }
        arrays = {f"{part}.{name}": v for part, values in parts.items() for name, v in values.items()}
        arrays["curves"] = torch.from_numpy(self._curves[: self.n_flown])
        return arrays, {"n_flown": self.n_flown, "rngs": [rng.bit_generator.state for rng in self._rngs]}

    def restore(self, arrays: dict[str, Tensor], values: dict[str, Any]) -> None:
        """Sets what `state` returned for the same population, device and library of worlds."""

        def part(name: str) -> dict[str, Tensor]:
            return {key.partition(".")[2]: v for key, v in arrays.items() if key.startswith(f"{name}.")}

        def in_worlds(name: str) -> dict[str, Array]:
            return {key: self._world_array(v.numpy()) for key, v in part(name).items()}

        self.learner.restore(part("learner"))
        self._buffer.restore(part("buffer"))
        state = in_worlds("world")
        # Checkpoints of version 0.1.0 lack it. Their data is that so far.
        state.setdefault("mission_reward", state["total_reward"])
        state.setdefault(
            "delivered_bits", 0.0 * state["data_bits"]
        )  # nor that: no observation of theirs has it
        state.setdefault("energy_used_j", 0.0 * state["total_reward"])  # nor that: they have no battery
        state.setdefault("motion", state["users_m"][..., :0])  # nor that: their users walk at random
        state.setdefault("waves", state["data_bits"][..., None, :0])  # nor shadowing
        self._worlds.state = State(**state)
        self._stats.restore(in_worlds("books"))
        self.n_flown = values["n_flown"]
        self._curves[: self.n_flown] = arrays["curves"].numpy()
        for rng, state in zip(self._rngs, values["rngs"], strict=True):
            rng.bit_generator.state = state


def action_mask(scenario: Scenario, observation: Observation) -> Mask | None:
    """The learner's mask of actions; None: a scenario without obstacles.

    With the observation `entities` it is that of the actions from which the UAV can still land.
    """
    if observation == "entities":
        return allowed
    if (moves := scenario.moves) is None:
        return None
    return lambda observation: moves.valid(observations.cell(scenario, observation))


def rewards(runs: Sequence[Run], array: Callable[[np.ndarray], Array]) -> Rewards:
    """The reward parameters of each run's world, `[N]`, converted by `array`."""
    terms = [run.reward for run in runs]
    weights = {
        name: array(np.array([getattr(term, name) for term in terms], np.float32))
        for name in ("beta", "zeta", "data_scale_bits")
    }
    return Rewards(
        **weights,
        r_plus=array(np.array([term.r_plus == "exponential" for term in terms])),
        form=array(np.array([term.form == "episode" for term in terms])),
        data=array(np.array([term.data == "step" for term in terms])),
    )


def roll_out_greedily(training: Training, seeds: range) -> Missions:
    """Every run's greedy policy on the missions with these seeds, with the run's own reward, each `[N, S]`.

    A run with an environment starts from its layout; the seed decides how the users walk.
    """
    population, learner = training.population, training.learner
    shape = population.scenario.draws_shape
    fixed = [None if run.environment is None else layout(run.environment, shape) for run in population.runs]

    def act(state: State) -> Array:
        observation = torch.from_numpy(observe(population.observation, population.scenario, state))
        return learner.greedy(observation.to(training.device)).cpu().numpy()

    own = rewards(population.runs, lambda values: values[:, None])
    return roll_out(population.scenario, act, seeds, layouts=fixed, rewards=own, service=False)


class Validation(NamedTuple):
    """Scores of each run's policy, `[N]` each."""

    brought_home: np.ndarray  # mean number of users collected; 0 for a mission that does not land
    selection_score: np.ndarray  # mean objective J with the default weight; it selects the policy


def validate(training: Training) -> Validation:
    """Flies the validation missions with every run's greedy policy."""
    scenario, missions = training.population.scenario, roll_out_greedily(training, VALIDATION_SEEDS)
    brought_home = np.where(missions.landed, missions.users_collected, 0).mean(axis=-1)
    return Validation(brought_home, missions.objective(scenario).mean(axis=-1))
