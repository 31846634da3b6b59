"""The policy: decides a move for each step that the vehicle is ready for. Needs no torch.

It is the same node in simulation and on an aircraft: it receives the vehicle's state in `mission` only.
"""

import numpy as np

from uav_dc_ros import messages, payloads, scenarios
from uav_dc_ros.agents import policy as policies
from uav_dc_ros.core import world
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.grid import Action
from uav_dc_ros.nodes.framework import node_main
from uav_dc_ros.nodes.framework.acknowledgements import AcknowledgementWindow
from uav_dc_ros.nodes.framework.mission_node import MissionNode
from uav_dc_ros.nodes.framework.step_synchronizer import StepSynchronizer


class PolicyNode(MissionNode):
    """Flies a trained policy."""

    def __init__(self) -> None:
        super().__init__("policy")

    def configure(self) -> None:
        """Load the policy, and check that it fits the mission's scenario."""
        self.policy = policies.load(self.values["policy"])
        scenario = self.values["scenario"]
        self.scenario = scenarios.load(scenario) if scenario else self.policy.scenario
        self.policy.check(self.scenario)
        cell, zeros = np.asarray(self.scenario.start_cell), np.zeros(self.scenario.n_users)
        energy_used_j = np.asarray(0.0)
        self._decide(cell, np.asarray(0), zeros, zeros > 0, energy_used_j)  # the first call is the slowest

    def activate(self) -> None:
        """Begin without a pending step."""
        self._steps = StepSynchronizer()
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

    def _add(self, payload: messages.Mission | messages.Rates) -> None:
        if (pair := self._steps.add(payload)) is None:
            return
        mission, rates = pair
        data_bits, collected = payloads.collection(rates, self.scenario)
        steps_flown = self.scenario.mission.max_steps - mission.remaining_steps
        energy_used_j = payloads.energy_used_j(mission)
        action = self._decide(
            np.asarray(mission.cell), np.asarray(steps_flown), data_bits, collected, energy_used_j
        )
        move = messages.Move(run=mission.run, mission=mission.mission, step=mission.step, action=action.label)
        self._unacknowledged.step()
        self.publish_payload("move", move)

    def _decide(
        self, cell: Array, step: Array, data_bits: Array, collected: Array, energy_used_j: Array
    ) -> Action:
        observation = self.policy.observe(
            self.scenario,
            cell=cell,
            step=step,
            data_bits=data_bits,
            collected=collected,
            energy_used_j=energy_used_j,
        )
        return Action(int(self.policy.act(observation, world.action_mask(self.scenario, cell))))


if __name__ == "__main__":
    node_main.main(PolicyNode)
