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

from collections.abc import Callable

import numpy as np

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.mobility import Static
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.core.world import Act, State
from uav_dc_ros.planners import table_beam as beam
from uav_dc_ros.planners.cells import Cells, Delivery
from uav_dc_ros.planners.table_beam import Guess, Guide, Plan, Start

WIDTH = 48  # states of a depth
GROUPS_MAX = 6
_ROUNDING = 1024.0  # parts of a step: sums of such numbers are exact in any order


def search(scenario: Scenario, weight: float, width: int = WIDTH) -> Act:
    """Flies the first move of the best plan from each state; see the module."""
    cells = Cells(scenario)
    plan = planner(cells, weight, width)

    def act(state: State) -> Array:
        shape = state.step.shape
        numbers = cells.number(state.cell).reshape(-1).tolist()
        rows = zip(
            numbers,
            state.step.reshape(-1).tolist(),
            state.users_m.reshape(-1, scenario.n_users, 2),
            state.data_bits.reshape(-1, scenario.n_users),
            state.collected.reshape(-1, scenario.n_users),
            np.broadcast_to(state.energy_used_j, shape).reshape(-1).tolist(),
            strict=True,
        )
        actions = [
            _first(cells, number, plan(users_m, Start(step, number, data_bits, collected, used_j)))
            for number, step, users_m, data_bits, collected, used_j in rows
        ]
        return np.asarray(actions).reshape(shape)

    return act


def planner(cells: Cells, weight: float, width: int = WIDTH) -> Callable[[Array, Start], Plan | None]:
    """The plan from a start with the users at `[U, 2]`, metres, or None; see `beam.search`."""
    known: dict[bytes, Delivery] = {}  # of users that do not move
    moves = not isinstance(cells.scenario.users.moves, Static)

    def plan(users_m: Array, start: Start) -> Plan | None:
        where = users_m.tobytes()
        if moves:
            known.clear()
        if (delivery := known.get(where)) is None:
            delivery = known[where] = Delivery(cells, users_m)
        guide = estimate(cells, delivery, users_m, start, weight)
        return beam.search(cells, lambda _, *at: delivery.of(*at), guide, start, weight, width)

    return plan


def _first(cells: Cells, number: int, plan: Plan | None) -> int:
    """The first action of a plan; over the dock, hover; without a plan, the shortest way home."""
    if plan is not None:
        return plan.actions[0] if plan.actions else int(Action.HOVER)
    steps = np.where(cells.valid[number], cells.to_dock[cells.after[number]], np.iinfo(np.int64).max)
    return int(len(steps) - 1 - steps[::-1].argmin())  # hover first


def estimate(cells: Cells, delivery: Delivery, users_m: Array, start: Start, weight: float) -> Guide:
    """The guide of a search from `start`, see the module."""
    scenario = cells.scenario
    n_users, max_steps = scenario.n_users, scenario.mission.max_steps
    r_min_bits = np.broadcast_to(scenario.user_r_min_bits(start.data_bits), (n_users,))
    left_bits = np.where(start.collected, 0.0, r_min_bits - start.data_bits)
    bits = delivery.everywhere(start.collected)
    with np.errstate(divide="ignore", invalid="ignore"):
        alone = left_bits / bits.max(axis=0)  # steps at the best cell of each user
        # More steps than a user is worth are spent on it by accident only.
        worth = max(weight / n_users * max_steps / (1.0 - weight), 1.0) if weight < 1.0 else np.inf
    waiting = np.flatnonzero(~start.collected & (alone <= min(worth, max_steps - start.step)))
    if not waiting.size:
        return _home(cells)
    groups = _groups(scenario, users_m, waiting)
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
    price = (1.0 - weight) / max_steps
    user_value = weight / n_users

    def guide(step: int, number: Array, data_bits: Array, collected: Array, arrival: Array) -> Guess:
        open_ = ~collected[:, users]
        needs = np.where(open_, (wanted - data_bits[:, users]) * per_bit, 0.0)
        needs = np.rint(np.maximum.reduceat(needs, firsts, axis=1) * _ROUNDING) / _ROUNDING
        waits = np.add.reduceat(open_.astype(np.float64), firsts, axis=1)
        more = waits @ member.T  # [N, 2^G]
        finish = step + ways[number] + needs @ member.T
        finish[:, 0] = np.where(cells.at_dock[number], arrival, finish[:, 0])
        values = np.where(finish <= max_steps, user_value * more - price * finish, -np.inf)
        values[:, 0] = np.maximum(values[:, 0], -price * max_steps)  # the way home fits, see `beam.search`
        chosen = values.argmax(axis=1)
        row = np.arange(len(number))
        return Guess(more[row, chosen], finish[row, chosen])

    return guide


def _home(cells: Cells) -> Guide:
    """The guide where no user is left: home."""

    def guide(step: int, number: Array, _: Array, collected: Array, arrival: Array) -> Guess:
        home = np.where(cells.at_dock[number], arrival, step + cells.to_dock[number])
        return Guess(np.zeros(len(number)), home)

    return guide


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
    ways[0] = cells.to_dock
    for subset in range(1, 2**n):
        ways[subset] = np.min(
            [legs[i] + ways[subset ^ (1 << i), stops[i]] for i in range(n) if subset >> i & 1], axis=0
        )
    return np.ascontiguousarray(ways.T), member.astype(np.float64)
