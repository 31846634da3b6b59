"""The world as a Gymnasium environment."""

from pathlib import Path
from typing import Any, get_args

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.error import InvalidAction, ResetNeeded

from uav_dc_ros import scenarios
from uav_dc_ros.core import energy, observations, world
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.observations import Observation
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.core.users.service import ServiceRecord
from uav_dc_ros.core.world import observe
from uav_dc_ros.env.trajectory import Trajectory

RENDER_MODES = ("rgb_array",)
ACTIONS_TEXT = ", ".join(f"{action.value} {action.label}" for action in Action)


class DataCollectionEnv(gymnasium.Env[Array, np.int64]):
    """A UAV collects data from users on the ground, and lands before its battery is spent.

    Action:
        `Discrete(7)`: 0 left (-x), 1 right (+x), 2 forward (+y), 3 backward (-y), 4 upward, 5 downward,
        6 hover. One move is one cell; a move off the grid or into an obstacle leaves the UAV where it is.

    Observation:
        `Box`, float32. `observation="position"`: the UAV's cell, each index scaled to [0, 1].
        `"mission"` (default): also the remaining steps and the progress in each cluster. `"map"`: also the
        vector to each cluster and to the dock. `"energy"`: `"mission"` and the battery's state of charge. The
        exact layout is in `core.observations`.

    Reward:
        From r^t = beta * (data, mean over users, scaled) + zeta * R_plus (eq. 7), with the data delivered in
        this step (`reward.data = "step"`) or collected so far (`"so_far"`): either its change in this step
        (`reward.form = "immediate"`) or r^t itself (`"episode"`).

    Start:
        The UAV in the scenario's start cell; users uniform in their clusters' discs. In each step the
        UAV moves, then the users move, then data is collected at rates that hold for the step.

    End:
        `episode_end = "at_time_limit"`: terminates after `max_steps`; it has landed if it is over the
        dock then. `"on_arrival"`: terminates over the dock, truncates after `max_steps`. Both terminate when
        the battery is spent, where `energy.ends` is `"battery"` or `"both"`.

    Randomness:
        `reset` draws `np_random.random(scenario.draws_shape)`, and every `step` the same; nothing else draws.

    Info:
        step, cell `[3]`, users_m `[U, 2]`, data_bits `[U]`, collected `[U]`, landed, dock_distance_m
        (horizontal), and of the last step (zero before the first): served `[U]`, sinr `[U]` linear,
        rate_bps `[U]`, sum_rate_bps. In a scenario with `energy` also energy_used_j and state_of_charge, and
        in one with `obstacles` action_mask `[7]`, int8: 1 for a move that has an effect, and for hover.
        At the end of a mission also mean_age_s, fairness and last_collected_step, see `core.users.service`.

    Args:
        scenario: a shipped name, the path of a TOML file, `random:SEED`, or a Scenario.
        observation: `position`, `mission`, `map` or `energy`.
        render_mode: None, or `rgb_array`: a picture of the mission so far, `[H, W, 3]` uint8.

    Raises:
        ScenarioError: an invalid scenario.
        ValueError: an unknown observation or render mode, or an observation that the scenario does not have.
        InvalidAction, ResetNeeded: by `step`, for an action outside the space, or outside an episode.
    """

    # Gymnasium declares it as an instance variable.
    metadata = {"render_modes": list(RENDER_MODES), "render_fps": 6}  # noqa: RUF012

    def __init__(
        self,
        scenario: str | Path | Scenario = "five_clusters",
        observation: Observation = "mission",
        render_mode: str | None = None,
    ) -> None:
        self.observation, self.render_mode = observation, render_mode
        self.scenario, self.observation_space, self.action_space = prepare(scenario, observation, render_mode)
        self._state: world.State | None = None
        self._trajectory = Trajectory(self.scenario)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start a mission; `options` are not used."""
        super().reset(seed=seed)
        self._state = world.initial(self.scenario, self._draws())
        self._trajectory = Trajectory(self.scenario)
        self._trajectory.add(self._state)
        self._service = ServiceRecord(np.zeros(self.scenario.n_users))
        return observe(self.observation, self.scenario, self._state), info(self.scenario, self._state)

    def step(self, action: np.int64) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Fly one step; see the class."""
        if self._state is None:
            raise ResetNeeded("step() outside an episode; expected a call of reset() first")
        if not self.action_space.contains(action):
            raise InvalidAction(f"action is {action!r}; expected an integer: {ACTIONS_TEXT}")
        state, outcome = world.step(self.scenario, self._state, np.asarray(action), self._draws())
        self._trajectory.add(state, outcome.link)
        self._service.add(state.step, outcome.link.served, state.collected)
        terminated, truncated = bool(outcome.terminated), bool(outcome.truncated)
        infos = info(self.scenario, state, outcome)
        self._state = state
        if terminated or truncated:
            self._state = None
            infos |= self._service.figures(self.scenario, state.data_bits)
        observation = observe(self.observation, self.scenario, state)
        return observation, float(outcome.reward), terminated, truncated, infos

    def render(self) -> Array | None:
        """The mission so far as a picture `[H, W, 3]`, uint8; None without a render mode."""
        if self.render_mode is None:
            gymnasium.logger.warn("render() without a render mode; expected render_mode='rgb_array'")
            return None
        if not self._trajectory.cells:
            raise ResetNeeded("render() before the first mission; expected a call of reset() first")
        from uav_dc_ros.env.render import picture  # brings matplotlib

        return picture(self._trajectory)

    def _draws(self) -> Array:
        return self.np_random.random(self.scenario.draws_shape)


def prepare(
    scenario: str | Path | Scenario, observation: Observation, render_mode: str | None
) -> tuple[Scenario, spaces.Box, spaces.Discrete]:
    """The scenario and the spaces of one environment, from its arguments; raises its errors."""
    if observation not in get_args(Observation):
        raise ValueError(f"observation is {observation!r}; expected {', '.join(get_args(Observation))}")
    if render_mode not in (None, *RENDER_MODES):
        raise ValueError(f"render_mode is {render_mode!r}; expected None or {', '.join(RENDER_MODES)}")
    loaded = scenario if isinstance(scenario, Scenario) else scenarios.load(scenario)
    if (problem := observations.problem(observation, loaded)) is not None:
        raise ValueError(problem)
    low, high = observations.bounds(observation, loaded)
    return loaded, spaces.Box(low, high, dtype=np.float32), spaces.Discrete(len(Action))


def info(scenario: Scenario, state: world.State, outcome: world.Outcome | None = None) -> dict[str, Any]:
    """The `info` of `reset` and `step`, with the batch dimensions of `state`."""
    zeros, no_users = np.zeros_like(state.data_bits), np.zeros_like(state.collected)
    link = outcome.link if outcome else None
    extra: dict[str, Any] = {}
    if scenario.energy is not None:
        charge = energy.state_of_charge(scenario.energy, state.energy_used_j)
        extra |= {"energy_used_j": state.energy_used_j, "state_of_charge": charge}
    if (mask := world.action_mask(scenario, state.cell)) is not None:
        extra["action_mask"] = mask.astype(np.int8)
    return {
        "step": state.step,
        "cell": state.cell,
        "users_m": state.users_m,
        "data_bits": state.data_bits,
        "collected": state.collected,
        "landed": outcome.landed if outcome else no_users[..., 0],
        "dock_distance_m": world.dock_distance_m(scenario, state.cell, like=state.data_bits),
        "served": link.served if link else no_users,
        "sinr": link.sinr if link else zeros,
        "rate_bps": link.rate_bps if link else zeros,
        "sum_rate_bps": link.sum_rate_bps if link else zeros[..., 0],
        **extra,
    }
