"""Policies that learn nothing, to see whether learning is worth it.

Each is a function of the state of many missions that gives an action for each, as a trained policy's
`steer` is: see `experiments.evaluate.rollout.Act`. They know the clusters' centres, which a policy that was
trained in the scenario has learnt, but not where single users are.
"""

from collections.abc import Callable

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.core.world import State
from uav_dc_ros.planners.plans import nearest, random, tour

PLANNERS: dict[str, Callable[[Scenario], Callable[[State], Array]]] = {
    "random": random,
    "nearest": nearest,
    "tour": tour,
}

__all__ = ["PLANNERS", "nearest", "random", "tour"]
