"""The recorder: everything in the mission's namespace into a bag, serialised as it came.

It waits for the topics of the table, and finds all others as they appear. A recorder that was killed goes on
in the same bag, in a new part: latched topics tell it what it missed.
"""

import json
from collections.abc import Mapping

import msgspec

from uav_dc_ros import __version__, scenarios
from uav_dc_ros.agents import policy as policies
from uav_dc_ros.core import pace
from uav_dc_ros.messages import PAYLOADS
from uav_dc_ros.nodes.framework import node_main
from uav_dc_ros.nodes.record.recorder_base import RecorderBase
from uav_dc_ros.topics import JSON, SIMULATED, TOPICS


class RecorderNode(RecorderBase):
    """Writes a mission's bag; what it is about (scenario, policy and its hash, seed) goes inside."""

    delays_new_topics = True  # a later scan tells whether another mission owns their namespace

    def __init__(self) -> None:
        super().__init__("recorder")

    def about(self) -> Mapping[str, str]:
        """Scenario, policy, seed, missions, pace, and what flies."""
        given = self.values
        scenario = scenarios.load(given["scenario"])
        about = {
            "version": __version__,
            "scenario": scenario.name,
            "scenario_fingerprint": scenario.fingerprint,
            "scenario_values": json.dumps(msgspec.to_builtins(scenario)),
            "seed": str(given["seed"]),
            "missions": str(given["missions"]),
            "vehicle": given["vehicle"],
        }
        if given["vehicle"] == SIMULATED:  # a real one has its own
            about["pace"] = pace.text(given["pace"])
        if given["policy"]:
            loaded = policies.load(given["policy"])
            about |= {"policy": loaded.name, "policy_sha256": loaded.sha256}
        return about

    def on_peers(self) -> None:
        """Enter every topic, also those that will stay silent; then say ready."""
        for name in self.row.subscribes:
            self.announce(self.resolve_topic_name(name), TOPICS[name])
        super().on_peers()

    def other_missions(self, found: Mapping[str, list[str]]) -> set[str]:
        """Namespaces inside ours in which another mission is flown: that has a bag of its own."""
        ours = self.get_namespace().rstrip("/")
        places = (
            name.rsplit("/", 1)
            for name, types in found.items()
            if name.rsplit("/", 1)[-1] in PAYLOADS and JSON in types
        )
        return {place for place, _ in places if place != ours}


if __name__ == "__main__":
    node_main.main(RecorderNode)
