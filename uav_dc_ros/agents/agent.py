"""What decides the moves of missions: a trained policy, or a planner. Both have one interface here."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from uav_dc_ros.agents import policy as policies
from uav_dc_ros.agents.policy import Policy
from uav_dc_ros.agents.policy_search import PolicySearch
from uav_dc_ros.agents.set_policy import SetPolicyConfig
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.objective import DEFAULT_WEIGHT
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.core.world import Act, State, action_mask
from uav_dc_ros.errors import ParameterError, PolicyError
from uav_dc_ros.planners import PLANNERS, Planner


@dataclass(frozen=True)
class Agent:
    """A policy or a planner, before it has a scenario.

    Raises:
        ParameterError: a planner with a `search`.
    """

    name: str
    source: Policy | Planner
    search: int = 0  # missions of a policy's search before each move, see `policy_search`; 0: none

    def __post_init__(self) -> None:
        """Reject a search on top of a planner."""
        if self.search and self.policy is None:
            raise ParameterError(
                f"search {self.search}: {self.name!r} is a planner; expected it with a policy only"
            )

    @property
    def policy(self) -> Policy | None:
        """The policy; None: it is a planner."""
        return self.source if isinstance(self.source, Policy) else None

    @property
    def sha256(self) -> str | None:
        """Hash of a policy's config and model, in hex."""
        return None if self.policy is None else self.policy.sha256

    @property
    def home(self) -> Scenario | None:
        """The scenario in which a policy was trained."""
        return None if self.policy is None else self.policy.scenario

    @property
    def for_any_field(self) -> bool:
        """Whether it flies in any field: a planner, or a policy that was trained for that."""
        return self.policy is None or isinstance(self.policy.config, SetPolicyConfig)

    @property
    def knows_positions(self) -> bool:
        """Whether it needs the users' positions, `State.users_m`."""
        if isinstance(self.source, Policy):
            return self.search > 0
        return self.source.knows == "positions"

    @property
    def weighs(self) -> bool:
        """Whether its moves depend on the weight of the objective."""
        if isinstance(self.source, Policy):
            return self.search > 0 or self.source.config.observation == "entities"
        return self.source.weighs

    @property
    def argument(self) -> str:
        """What names it for `load` in another process."""
        return str(self.source.folder.absolute()) if isinstance(self.source, Policy) else self.name

    def act_in(self, scenario: Scenario, weight: float = DEFAULT_WEIGHT) -> Act:
        """Its actions in a scenario, with the weight w of the objective.

        Raises:
            PolicyError: a policy that does not fit the scenario.
            ParameterError: a scenario that is too large for a planner.
        """
        if isinstance(self.source, Policy):
            if self.search:
                return PolicySearch(self.source, scenario, weight, self.search)
            return greedy_act(self.source, scenario, weight)
        return self.source(scenario, weight)


def load(name_or_path: str | Path, search: int = 0) -> Agent:
    """The planner with a name, or the policy with a shipped name or in a folder; see `Agent.search`.

    Raises:
        PolicyError: neither, or both; see also `policy.load`.
        ParameterError: a planner with a `search`.
    """
    name = str(name_or_path)
    if name not in PLANNERS:
        policy = policies.load(name_or_path)
        return Agent(policy.name, policy, search)
    if name in policies.names() or Path(name, policies.CONFIG).exists():
        raise PolicyError(
            f"policy {name!r} is a planner, and a policy's folder has the same name; expected another name "
            f"of the folder, or a path such as ./{name}"
        )
    return Agent(name, PLANNERS[name], search)


def greedy_act(policy: Policy, scenario: Scenario, weight: float = DEFAULT_WEIGHT) -> Act:
    """The policy's greedy actions in a scenario; raises PolicyError when it does not fit.

    A policy that observes `entities` also gets the weight w of the objective.
    """
    policy.check(scenario)

    def act(state: State) -> Array:
        observation = policy.observe(
            scenario,
            cell=state.cell,
            step=state.step,
            data_bits=state.data_bits,
            collected=state.collected,
            delivered_bits=state.delivered_bits,
            energy_used_j=state.energy_used_j,
            weight=weight,
        )
        return policy.act(observation, action_mask(scenario, state.cell))

    return act


def state_of(
    scenario: Scenario,
    *,
    cell: Array,
    step: Array,
    data_bits: Array,
    collected: Array,
    delivered_bits: Array,
    energy_used_j: Array,
    users_m: Array | None = None,
) -> State:
    """The state of one mission as an agent knows it; positions and rewards that it does not know are NaN.

    `cell` is `[3]`, `step` and `energy_used_j` `[]`, `data_bits`, `collected` and `delivered_bits` `[U]`,
    `users_m` `[U, 2]`.
    """
    unknown = np.asarray(np.nan)
    return State(
        step=step,
        cell=cell,
        users_m=np.full((scenario.n_users, 2), np.nan) if users_m is None else users_m,
        data_bits=data_bits,
        collected=collected,
        delivered_bits=delivered_bits,
        total_reward=unknown,
        mission_reward=unknown,
        energy_used_j=energy_used_j,
        motion=np.zeros((scenario.n_users, 0)),
        waves=np.zeros((1, 0)),
    )
