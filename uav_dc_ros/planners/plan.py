"""The planner `plan`: the first move of the best plan by what users have delivered, see `core.entities.plan`.

It knows where clusters are, not where users are. From the last step it knows which users deliver: a user that
is silent, or walked out of reach, is not waited for. It is the policy for any field before its training.
"""

from uav_dc_ros.core import entities, world
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.entities.encoding import planned_action
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.core.world import Act, State
from uav_dc_ros.errors import ParameterError


def plan(scenario: Scenario, weight: float) -> Act:
    """Flies the action after which the best plan is worth most.

    Raises:
        ParameterError: the scenario is too large for the observation `entities`.
    """
    if (problem := entities.problem(scenario)) is not None:
        raise ParameterError(f"planner 'plan' needs {problem}")

    def act(state: State) -> Array:
        return planned_action(world.observe("entities", scenario, state, weight))

    return act
