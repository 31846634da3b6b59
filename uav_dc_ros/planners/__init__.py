"""Baselines that learn nothing. Each is a function from a scenario to an `core.world.Act`.

Like a policy trained in the scenario, they know the cluster centres, but not where single users are.
"""

from collections.abc import Callable

from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.core.world import Act
from uav_dc_ros.planners.plans import nearest, random, tour

PLANNERS: dict[str, Callable[[Scenario], Act]] = {"random": random, "nearest": nearest, "tour": tour}

__all__ = ["PLANNERS", "nearest", "random", "tour"]
