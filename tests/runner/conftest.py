"""The small missions of the nodes' tests."""

from tests.nodes.conftest import alone, low, observed, small_policy, small_scenario

__all__ = ["alone", "low", "observed", "small_policy", "small_scenario"]
