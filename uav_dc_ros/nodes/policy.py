"""The policy node: decides a move for each step that the vehicle is ready for. Needs no torch.

It flies a trained policy, with or without a search, or a planner. It is the same node in simulation and on an
aircraft: it receives the vehicle's state in `mission`. It subscribes to `users` only for a search, and for a
planner that knows the users' positions.
"""

import numpy as np
from msgspec import UNSET

from uav_dc_ros import messages, payloads, scenarios
from uav_dc_ros.agents import agent as agents
from uav_dc_ros.agents.policy_search import PolicySearch, SearchedMove
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.grid import Action
from uav_dc_ros.errors import ParameterError
from uav_dc_ros.nodes.framework import node_main
from uav_dc_ros.nodes.framework.acknowledgements import AcknowledgementWindow
from uav_dc_ros.nodes.framework.mission_node import MissionNode
from uav_dc_ros.nodes.framework.node_table import NODES, POLICY_WITH_POSITIONS
from uav_dc_ros.nodes.framework.step_synchronizer import StepSynchronizer


class PolicyNode(MissionNode):
    """Flies a policy or a planner."""

    def __init__(self) -> None:
        super().__init__("policy")

    def configure(self) -> None:
        """Load the policy or planner, and check that it fits the mission's scenario."""
        agent = agents.load(self.values["policy"], self.values["search"])
        scenario = scenarios.load(self.values["scenario"]) if self.values["scenario"] else agent.home
        if scenario is None:
            raise ParameterError(f"scenario: none; expected one for the planner {agent.name!r}")
        self.scenario = scenario
        self.row = POLICY_WITH_POSITIONS if agent.knows_positions else NODES["policy"]
        self._kinds = (messages.Users,) if agent.knows_positions else ()
        self._act = agent.act_in(self.scenario, self.values["objective_weight"])
        self._n_timed_out = self._n_reported = 0  # searches
        self._time_limit_s: float | None = None  # not of the first decision, which prepares tables
        zeros = np.zeros(self.scenario.n_users)
        self._decide(  # the first call is the slowest
            cell=np.asarray(self.scenario.start_cell),
            step=np.asarray(0),
            data_bits=zeros,
            collected=zeros > 0,
            delivered_bits=zeros,
            energy_used_j=np.asarray(0.0),
            users_m=np.asarray(self.scenario.user_centres_m),
        )
        self._time_limit_s = self.values["search_time_limit_s"] or None

    def activate(self) -> None:
        """Begin without a pending step."""
        self._steps = StepSynchronizer(messages.Mission, messages.Rates, *self._kinds)
        self._unacknowledged = AcknowledgementWindow([self.publishers_of["move"]])

    def on_mission(self, payload: messages.Mission) -> None:
        """Receive a step that the vehicle is ready for."""
        payloads.check(payload, self.scenario)
        if payload.phase is messages.Phase.READY:
            self._add(payload)

    def on_rates(self, payload: messages.Rates) -> None:
        """Receive the data collected by a step."""
        payloads.check(payload, self.scenario)
        self._add(payload)

    def on_users(self, payload: messages.Users) -> None:
        """Receive the users' positions in a step."""
        payloads.check(payload, self.scenario)
        self._add(payload)

    def _add(self, payload: messages.Mission | messages.Rates | messages.Users) -> None:
        if (complete := self._steps.add(payload)) is None:
            return
        mission, rates, *users = complete
        data_bits, collected = payloads.collection(rates, self.scenario)
        decided = self._decide(
            cell=np.asarray(mission.cell),
            step=np.asarray(self.scenario.mission.max_steps - mission.remaining_steps),
            data_bits=data_bits,
            collected=collected,
            delivered_bits=payloads.delivered_bits(rates, self.scenario),
            energy_used_j=payloads.energy_used_j(mission),
            users_m=payloads.users_m(users[0], self.scenario) if users else None,
        )
        self._n_timed_out += decided.timed_out
        move = messages.Move(
            run=mission.run,
            mission=mission.mission,
            step=mission.step,
            action=Action(decided.action).label,
            search_timed_out=decided.timed_out or UNSET,
        )
        self._unacknowledged.step()
        self.publish_payload("move", move)

    def _decide(self, **known: Array) -> SearchedMove:
        """The action in a state, see `agent.state_of`."""
        state = agents.state_of(self.scenario, **known)
        if isinstance(self._act, PolicySearch):
            return self._act.decide(state, self._time_limit_s)
        return SearchedMove(int(self._act(state)))

    def diagnose(self) -> tuple[list[str], dict[str, str]]:
        """The number of searches that ran out of time; a warning if some did since the last report."""
        if not isinstance(self._act, PolicySearch):
            return [], {}
        recent, self._n_reported = self._n_timed_out - self._n_reported, self._n_timed_out
        warnings = ["searches ran out of time"] if recent else []
        return warnings, {"searches out of time": str(self._n_timed_out)}


if __name__ == "__main__":
    node_main.main(PolicyNode)
