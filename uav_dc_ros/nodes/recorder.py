"""The recorder: writes all topics in the mission's namespace into a bag, serialised.

It waits for the topics of the table, and finds others as they appear. A recorder that was killed continues
the bag in a new part: from latched topics it receives the messages that it missed.
"""

import json
from collections.abc import Mapping

import msgspec

from uav_dc_ros import __version__, scenarios
from uav_dc_ros.agents import agent as agents
from uav_dc_ros.core import pace
from uav_dc_ros.messages import PAYLOADS
from uav_dc_ros.nodes.framework import node_main
from uav_dc_ros.nodes.record.last_step import LastStep
from uav_dc_ros.nodes.record.recorder_base import RecorderBase
from uav_dc_ros.topics import JSON, SIMULATED, TOPICS


class RecorderNode(RecorderBase):
    """Writes a mission's bag, with metadata: scenario, policy and its hash or planner, seed."""

    delays_new_topics = True  # a later scan shows whether another mission owns their namespace

    def __init__(self) -> None:
        super().__init__("recorder")

    def configure(self) -> None:
        """Load the scenario, and create the bag."""
        self.scenario = scenarios.load(self.values["scenario"])
        super().configure()
        missions, lockstep = self.values["missions"], self.values["pace"] is None
        self._last_step = LastStep(self.scenario, self.newest, missions=missions, lockstep=lockstep)

    def about(self) -> Mapping[str, str]:
        """Metadata of the bag: scenario, policy, seed, missions, pace, vehicle."""
        values, scenario = self.values, self.scenario
        about = {
            "version": __version__,
            "scenario": scenario.name,
            "scenario_fingerprint": scenario.fingerprint,
            "scenario_values": json.dumps(msgspec.to_builtins(scenario)),
            "seed": str(values["seed"]),
            "missions": str(values["missions"]),
            "vehicle": values["vehicle"],
        }
        if values["vehicle"] == SIMULATED:  # a real one has no pace
            about["pace"] = pace.text(values["pace"])
        if values["policy"]:
            agent = agents.load(values["policy"], values["search"])
            about["policy"] = agent.name
            if agent.sha256 is not None:
                about["policy_sha256"] = agent.sha256
            if agent.weighs:
                about["objective_weight"] = repr(values["objective_weight"])
            if agent.search:
                about["search"] = str(agent.search)
        return about

    def missing(self) -> Mapping[str, str]:
        """What the last step lacks; of a real vehicle it is not known."""
        if self.values["vehicle"] != SIMULATED:
            return {}
        missing = self._last_step.missing()
        return {
            self.resolve_topic_name(topic): f"of step {step} of mission {mission}"
            for topic, (mission, step) in missing.items()
        }

    def is_caught_up(self) -> bool:
        """Whether it has received the latched `mission`. Publishers that stop wait until the rest is."""
        is_recorded = not self.selected or self.resolve_topic_name("mission") in self.selected
        return super().is_caught_up() and ("mission" in self.newest or not is_recorded)

    def on_peers(self) -> None:
        """Add the topics of the row to the bag, also those without a message, before `ready`."""
        for name in self.row.subscribes:
            self.announce(self.resolve_topic_name(name), TOPICS[name])
        super().on_peers()

    def other_missions(self, found: Mapping[str, list[str]]) -> set[str]:
        """Namespaces inside ours in which another mission is flown: that has a bag of its own."""
        parts = (name.rpartition("/") for name, types in found.items() if JSON in types)
        own = self.get_namespace().rstrip("/")
        return {namespace for namespace, _, name in parts if name in PAYLOADS} - {own}


if __name__ == "__main__":
    node_main.main(RecorderNode)
