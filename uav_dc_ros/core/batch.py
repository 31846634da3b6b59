"""Many worlds side by side, each starting afresh on its own: `core.world` with leading batch dimensions.

The trainer and the vector environment both stand on it, so there is one physics.
"""

from dataclasses import fields

from uav_dc_ros.core import observations, world
from uav_dc_ros.core.arrays import Array, array_namespace
from uav_dc_ros.core.observations import Observation
from uav_dc_ros.core.reward import Rewards
from uav_dc_ros.core.scenario import Scenario


def select(where: Array, chosen: world.State, other: world.State) -> world.State:
    """`chosen` in the worlds in which `where` (bool `[...]`) holds, `other` elsewhere."""
    xp = array_namespace(where)

    def pick(a: Array, b: Array) -> Array:
        return xp.where(xp.reshape(where, (*where.shape, *(1,) * (a.ndim - where.ndim))), a, b)

    return world.State(
        **{f.name: pick(getattr(chosen, f.name), getattr(other, f.name)) for f in fields(world.State)}
    )


class BatchWorld:
    """Worlds of one scenario that advance together, on numpy or torch.

    Attributes:
        scenario: the values of every world.
        state: all worlds between two steps, `[N, ...]`.
    """

    def __init__(self, scenario: Scenario, draws: Array, rewards: Rewards | None = None) -> None:
        """Worlds before their first step.

        Args:
            scenario: the values of every world.
            draws: uniform in [0, 1), `[N, U, 2]`.
            rewards: how each world is paid, `[N]`; all as the scenario says unless told.
        """
        self.scenario = scenario
        self._rewards = rewards
        self.state = world.initial(scenario, draws)

    def step(self, action: Array, draws: Array) -> world.Outcome:
        """One step of every world: integers `[N]`, and uniform draws `[N, U, 2]`."""
        self.state, outcome = world.step(self.scenario, self.state, action, draws, self._rewards)
        return outcome

    def restart(self, where: Array, draws: Array) -> None:
        """Starts the worlds in `where` (bool `[N]`) afresh, from their share of `draws` `[N, U, 2]`."""
        self.state = select(where, world.initial(self.scenario, draws), self.state)

    def observe(self, kind: Observation) -> Array:
        """What an agent sees in each world, float32 `[N, D]`."""
        return observe(kind, self.scenario, self.state)


def observe(kind: Observation, scenario: Scenario, state: world.State) -> Array:
    """The observation of a state, float32 `[..., D]`; see `observations.encode`."""
    return observations.encode(
        kind,
        scenario,
        cell=state.cell,
        step=state.step,
        data_bits=state.data_bits,
        collected=state.collected,
    )
