"""The planner `search`: at each step the best plan to the end of the mission, of which it flies one move.

It knows where every user is at present, and the data collected so far. It does not know where users will go,
nor what a random channel will draw. In its model users stay where they are, which is the expectation of
`random_walk`, `static` and, away from the border, of `gauss_markov`; with `random_waypoint` it ignores that
users tend to the middle. The channel is that without shadowing and fading (`channel.path_gain`).

The plan comes from a beam search (`beam`). Its budget is a number of states, not of seconds, so that it
decides alike on every computer. States are compared by an estimate of what they lead to: the users that are
still waiting form at most `GROUPS_MAX` groups, the clusters or several of them; a group takes the way to its
stop and the steps that its slowest user needs there. Of all subsets of the groups, the best that fits into
the time counts, in the order of the shortest way (Held and Karp, 1962).
"""

import numpy as np

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.core.world import Act, State
from uav_dc_ros.planners import beam
from uav_dc_ros.planners.beam import Ranking
from uav_dc_ros.planners.cells import FAR, Cells, Delivery
from uav_dc_ros.planners.missions import one_by_one
from uav_dc_ros.planners.model import Model

WIDTH = 48  # missions of the beam
GROUPS_MAX = 6
_ROUNDING = 1024.0  # parts of a step: sums of such numbers are exact in any order


class StandingUsers(Model):
    """Users that stay where they are, over the channel without shadowing and fading."""

    def __init__(self, scenario: Scenario) -> None:
        """Until `look` the model has no users; raises ParameterError for a scenario that is too large."""
        super().__init__(scenario)
        self.n_steps = 0
        self._look = self._deliver(np.asarray(scenario.user_centres_m))

    def _deliver(self, users_m: Array) -> tuple[bytes, Delivery]:
        return users_m.tobytes(), Delivery(self, users_m)

    def look(self, state: State) -> Delivery:
        """Take the users' positions and the steps that are left from the state of one mission."""
        self.n_steps = self.scenario.mission.max_steps - int(state.step)
        if self._look[0] != state.users_m.tobytes():
            self._look = self._deliver(state.users_m)
        return self._look[1]

    def delivered(self, step: int, cell: Array, collected: Array) -> Array:
        """See `Model.delivered`."""
        return self._look[1].of(cell, collected)


def search(scenario: Scenario, weight: float, width: int = WIDTH) -> Act:
    """Flies the first move of the best plan from each state; see the module."""
    model = StandingUsers(scenario)

    def decide(state: State) -> int:
        ranking = estimate(model, model.look(state), state, weight)
        plan = beam.search(model, state, width=width, weight=weight, ranking=ranking)
        return int(plan.actions[0]) if len(plan.actions) else homewards(model, int(model.index(state.cell)))

    return one_by_one(decide)


def homewards(cells: Cells, cell: int) -> int:
    """The first action of the shortest way to the dock; over it, hover."""
    steps = np.where(cells.has_effect[cell], cells.steps_home[cells.after[cell]], FAR)
    return int(Action.HOVER if steps[Action.HOVER] == steps.min() else steps.argmin())


def estimate(cells: Cells, delivery: Delivery, state: State, weight: float) -> Ranking:
    """What the missions of a search from the state of one mission lead to, see the module."""
    scenario = cells.scenario
    n_users, max_steps = scenario.n_users, scenario.mission.max_steps
    user_value, price = weight / n_users, (1.0 - weight) / max_steps
    r_min_bits = np.broadcast_to(scenario.user_r_min_bits(state.data_bits), (n_users,))
    left_bits = np.where(state.collected, 0.0, r_min_bits - state.data_bits)
    bits = delivery.everywhere(state.collected)
    with np.errstate(divide="ignore", invalid="ignore"):
        alone = left_bits / bits.max(axis=0)  # steps over the best cell of each user
    # A user that needs more steps than it is worth is only collected on the way.
    worth = max(user_value / price, 1.0) if price > 0.0 else np.inf
    waiting = np.flatnonzero(~state.collected & (alone <= min(worth, max_steps - int(state.step))))
    if not waiting.size:
        return lambda _, n_flown, cell, data_bits, collected: (
            user_value * collected.sum(axis=1) - price * (n_flown + cells.steps_home[cell]),
            (~collected).sum(axis=1),
        )
    groups = _groups(scenario, state.users_m, waiting)
    order = np.argsort(groups, kind="stable")
    users, groups = waiting[order], groups[order]
    firsts = np.flatnonzero(np.diff(groups, prepend=-1))
    stops = _stops(bits, users, firsts, left_bits, alone)
    at_stop = bits[np.repeat(stops, np.diff([*firsts, len(users)])), users]
    best = bits[:, users].max(axis=0)
    # A user that its group's stop serves badly is collected elsewhere on the way.
    per_bit = 1.0 / np.where(at_stop >= 0.25 * best, at_stop, best)
    wanted = r_min_bits[users]
    ways, member = _ways(cells, stops)

    def ranking(_: int, n_flown: int, cell: Array, data_bits: Array, collected: Array) -> tuple[Array, Array]:
        open_ = ~collected[:, users]
        needs = np.where(open_, (wanted - data_bits[:, users]) * per_bit, 0.0)
        needs = np.rint(np.maximum.reduceat(needs, firsts, axis=1) * _ROUNDING) / _ROUNDING
        waits = np.add.reduceat(open_.astype(np.float64), firsts, axis=1)
        finish = n_flown + ways[cell] + needs @ member.T  # by subset, `[B, 2^G]`
        values = np.where(finish <= max_steps, user_value * (waits @ member.T) - price * finish, -np.inf)
        uncollected = (~collected).sum(axis=1)
        return user_value * (n_users - uncollected) + values.max(axis=1), uncollected

    return ranking


def _groups(scenario: Scenario, users_m: Array, users: Array) -> Array:
    """The group of each of some users, integers `[V]`, at most `GROUPS_MAX`: clusters, near ones together."""
    _, groups = np.unique(scenario.user_cluster[users], return_inverse=True)
    while (n := int(groups.max()) + 1) > GROUPS_MAX:
        sizes = np.bincount(groups)
        places_m = np.stack([np.bincount(groups, users_m[users, i]) / sizes for i in (0, 1)], axis=-1)
        apart = ((places_m[:, None] - places_m) ** 2).sum(axis=-1) * np.minimum(sizes[:, None], sizes)
        one, other = np.unravel_index(np.where(np.tri(n, k=-1, dtype=bool), apart, np.inf).argmin(), (n, n))
        groups = np.where(groups == one, other, groups)
        _, groups = np.unique(groups, return_inverse=True)
    return groups


def _stops(bits: Array, users: Array, firsts: Array, left_bits: Array, alone: Array) -> Array:
    """The cell at which the users of each group, ordered by group, wait least in sum, integers `[G]`."""
    with np.errstate(divide="ignore"):
        needs = left_bits[users] / bits[:, users]
    needs = np.minimum(needs, 4.0 * alone[users] + 4.0)
    return np.add.reduceat(needs, firsts, axis=1).argmin(axis=0)


def _ways(cells: Cells, stops: Array) -> tuple[Array, Array]:
    """Moves from each cell past the stops of each subset to the dock, `[C, 2^G]`, and the subsets.

    The latter are numbers 0 and 1, `[2^G, G]`; subset 0 has no stop.
    """
    n = len(stops)
    legs = np.stack([cells.steps_to(int(stop)) for stop in stops])  # [G, C]
    member = (np.arange(2**n)[:, None] >> np.arange(n)) & 1
    ways = np.empty((2**n, len(cells.cells)))
    ways[0] = cells.steps_home
    for subset in range(1, 2**n):
        ways[subset] = np.min(
            [legs[i] + ways[subset ^ (1 << i), stops[i]] for i in range(n) if subset >> i & 1], axis=0
        )
    return np.ascontiguousarray(ways.T), member.astype(np.float64)
