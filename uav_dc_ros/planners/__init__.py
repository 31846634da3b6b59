"""Planners: what decides a mission's moves without having learnt.

A planner makes, from a scenario and the weight w of the objective (`core.objective`), a `core.world.Act`. Its
moves depend on the missions' state only: it keeps no memory, so that a restarted node decides alike.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeAlias

from uav_dc_ros.core.objective import DEFAULT_WEIGHT
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.core.world import Act
from uav_dc_ros.planners import baselines
from uav_dc_ros.planners.cluster_tour import tour
from uav_dc_ros.planners.lookahead import search
from uav_dc_ros.planners.plan import plan

# What a planner knows of the users beside the scenario's numbers and the data collected so far: nothing, the
# clusters' centres (of listed users: their places), or where each user is at present. None knows how users
# will walk.
Knowledge: TypeAlias = Literal["nothing", "centres", "positions"]


@dataclass(frozen=True)
class Planner:
    """A planner; calling it gives its actions in a scenario."""

    name: str
    knows: Knowledge
    make: Callable[[Scenario, float], Act]
    weighs: bool = True  # whether its moves depend on the weight w

    def __call__(self, scenario: Scenario, weight: float = DEFAULT_WEIGHT) -> Act:
        """The actions of missions in `scenario` with the weight w, 0 to 1.

        Raises:
            ParameterError: the scenario is too large for the planner.
        """
        return self.make(scenario, weight)


def _unweighted(make: Callable[[Scenario], Act]) -> Callable[[Scenario, float], Act]:
    return lambda scenario, _: make(scenario)


PLANNERS: dict[str, Planner] = {
    planner.name: planner
    for planner in (
        Planner("random", "nothing", _unweighted(baselines.random), weighs=False),
        Planner("nearest", "centres", _unweighted(baselines.nearest), weighs=False),
        Planner("fixed_tour", "centres", _unweighted(baselines.fixed_tour), weighs=False),
        Planner("tour", "centres", tour),
        Planner("plan", "centres", plan),
        Planner("search", "positions", search),
    )
}
