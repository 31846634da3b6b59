"""The planner `tour`: a routing baseline over the clusters, which are single users in a field of listed ones.

It knows where clusters are, how large their discs are, and the data collected so far. From these follow:

- a stop over each cluster: the cell over which users spread evenly over its disc wait least;
- one order of all stops, the shortest way from the start past them to the dock: exact for up to
  `EXACT_MAX` stops; with more, improved by 2-opt (Croes, 1958) and Or-opt (Or, 1976) from the nearest
  neighbour's order;
- the steps at the stop that each waiting user still needs, from the rates there and on the way there, and
  from its own data.

At each step it chooses, in that order, which clusters to visit and how many users of each to wait for. The
choice maximises J: w / U for each user, less (1 - w) / T_cons for each step until the dock. It is exact, by
dynamic programming over the order; where the time is too short for it, over the order and the steps that are
left.
"""

import itertools

import numpy as np

from uav_dc_ros.core import mission
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.grid import Action
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.core.world import Act, State
from uav_dc_ros.planners.cells import FAR, Cells, Delivery

HOVERS_MAX = 16  # steps over a stop within which a user is collected, or not counted
APPROACH_MAX = 8  # moves to a stop on which it is expected to receive data
EXACT_MAX = 8  # stops of which every order is tried
_GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0


def tour(scenario: Scenario, weight: float) -> Act:
    """Flies past the clusters that are worth their time, and home in time; see the module."""
    return _Tour(scenario, weight).act


class _Tour:
    """The stops, their order, and the choice of what to visit."""

    def __init__(self, scenario: Scenario, weight: float) -> None:
        self.scenario, self.cells = scenario, Cells(scenario)
        self._user_value = weight / scenario.n_users
        self._step_cost = (1.0 - weight) / scenario.mission.max_steps
        stops, needs, approaches = _stops(self.cells)
        legs = np.stack([self.cells.steps_to(int(stop)) for stop in stops])  # [M, C], moves to each stop
        start = self.cells.index(np.asarray(scenario.start_cell))
        to_dock = self.cells.steps_home
        order = _order(legs[:, stops], legs[:, start], to_dock[stops])
        self._stops, self._legs = stops[order], legs[order]  # in the order of the tour
        self._between = self._legs[:, self._stops]  # [M, M], symmetric
        starts = np.cumsum([0, *scenario.users.sizes])
        self._users = [np.arange(starts[i], starts[i + 1]) for i in order]
        # Share of a user's data that the last 0, 1, ... moves to the stop deliver, `[M, APPROACH_MAX + 1]`
        self._approaches = approaches[order]
        self._need = needs[order, 0]  # mean steps at the stop until a user is collected, `[M]`
        # The step at which a stop closes, if one of its users is collected, `[M]`: when its own and earlier
        # ways and waits have lasted as long as expected. Users that have walked out of reach are left behind.
        ways = np.concatenate([self._legs[:1, start], np.diagonal(self._between, 1)])
        self._deadlines = np.cumsum(ways + needs[order, 1])

    def act(self, state: State) -> Array:
        """The actions of missions."""
        shape = state.step.shape
        number = self.cells.index(state.cell).reshape(-1)
        left = self._left(state).reshape(-1)
        data_bits = state.data_bits.reshape(len(left), -1)
        collected = state.collected.reshape(len(left), -1)
        needs = self._needs(number, state.step.reshape(-1), data_bits, collected)
        goal = self._goals(number, left, needs)
        return self._towards(number, left, goal).reshape(shape)

    def _left(self, state: State) -> Array:
        """Steps that are left, of the mission and of the battery, integers `[...]`."""
        left = self.scenario.mission.max_steps - state.step
        energy = self.scenario.energy
        if energy is None or energy.ends == "steps":
            return left
        # As many as the dearest kind of step allows: a way with obstacles may climb.
        steps = (energy.battery_j - state.energy_used_j) / max(self.scenario.step_energies_j)
        return np.minimum(left, np.floor(steps).astype(np.int64))

    def _needs(self, number: Array, step: Array, data_bits: Array, collected: Array) -> Array:
        """Steps at each stop until 0 to K more users are collected, K the largest cluster, `[S, M, K + 1]`.

        They are infinite where no more users wait, or the stop is closed.
        """
        r_min_bits = np.broadcast_to(self.scenario.user_r_min_bits(data_bits), data_bits.shape)
        n_most = max(map(len, self._users))
        needs = np.full((len(data_bits), len(self._users), n_most + 1), np.inf)
        needs[..., 0] = 0.0
        for i, (users, steps) in enumerate(zip(self._users, self._need, strict=True)):
            waiting, data, wanted = ~collected[:, users], data_bits[:, users], r_min_bits[:, users]
            is_open = ((step < self._deadlines[i]) | waiting.all(axis=1))[:, None]
            moves = np.minimum(self._legs[i, number], APPROACH_MAX)
            left = np.maximum(1.0 - data / wanted - self._approaches[i, moves][:, None], 0.0)
            need = np.where(waiting & is_open, steps * left, np.inf)
            needs[:, i, 1 : len(users) + 1] = np.sort(need, axis=1)
        return needs

    def _goals(self, number: Array, left: Array, needs: Array) -> Array:
        """The stop to fly to, integers `[S]`, by its place in the order; M is the dock."""
        goal, steps = self._best(number, needs)
        late = np.flatnonzero(steps > left)
        if late.size:
            goal[late] = self._best_in_time(number[late], left[late], needs[late])
        return goal

    def _best_in_time(self, number: Array, left: Array, needs: Array) -> Array:
        """As `_goals`, of the choices that last no longer than the steps that are left."""
        n_stops, n_steps, price = len(self._stops), max(int(left.max()), 0), self._step_cost
        waits = np.arange(min(n_steps, HOVERS_MAX) + 1)
        # Users that are collected at each stop within some waits, [S, M, W]
        users = (np.ceil(needs)[..., 1:, None] <= waits).sum(axis=2)
        worth = np.where(users > 0, self._user_value * users - price * waits, -np.inf)
        # Of a tour from stop i on, by the steps that are left there; the last column is the dock.
        value = np.full((len(left), n_stops + 1, n_steps + 1), -np.inf)
        value[:, n_stops] = 0.0
        row = np.arange(len(left))[:, None, None]
        for i in reversed(range(n_stops)):
            legs = np.append(self._between[i, i + 1 :], self.cells.steps_home[self._stops[i]])
            then = np.arange(n_steps + 1) - legs[:, None]  # steps left there, [M - i, T + 1]
            there = value[row, np.arange(i + 1, n_stops + 1)[:, None], np.maximum(then, 0)]
            after = np.where(then >= 0, there - price * legs[:, None], -np.inf).max(axis=1)
            for wait in waits:
                value[:, i, wait:] = np.maximum(
                    value[:, i, wait:], worth[:, i, wait, None] + after[:, : n_steps + 1 - wait]
                )
        legs = np.column_stack([self._legs[:, number].T, self.cells.steps_home[number]])
        then = left[:, None] - legs
        there = value[row[..., 0], np.arange(n_stops + 1), np.maximum(then, 0)]
        values = np.where(then >= 0, there - price * legs, -np.inf)
        values[:, -1] = np.maximum(values[:, -1], -1e9)  # the dock, where nothing is in time
        return values.argmax(axis=1)

    def _best(self, number: Array, needs: Array) -> tuple[Array, Array]:
        """The best choice without a limit of time: its first stop, and its steps until the dock, `[S]`."""
        price = np.full(len(number), self._step_cost)
        is_offered = np.isfinite(needs)
        cost = price[:, None, None] * np.where(is_offered, needs, 0.0)
        worth = np.where(is_offered, self._user_value * np.arange(needs.shape[-1]) - cost, -np.inf)
        kept = worth.argmax(axis=-1)[..., None]
        worth = np.take_along_axis(worth, kept, axis=-1)[..., 0]  # [S, M]
        stays = np.ceil(np.take_along_axis(needs, kept, axis=-1)[..., 0])
        n_stops = len(self._stops)
        to_dock = self.cells.steps_home
        # Of a tour that begins with stop i: its value and its steps, of the dock alone in the last column
        value, steps = np.zeros((len(price), n_stops + 1)), np.zeros((len(price), n_stops + 1))
        for i in reversed(range(n_stops)):
            after, length, _ = self._next(
                i + 1, self._between[i], to_dock[self._stops[i]], price, value, steps
            )
            value[:, i], steps[:, i] = worth[:, i] + after, stays[:, i] + length
        # A stop at which no user is worth waiting for gives nothing.
        value[:, :-1] = np.where(kept[..., 0] > 0, value[:, :-1], -np.inf)
        _, length, goal = self._next(0, self._legs[:, number].T, to_dock[number], price, value, steps)
        return goal, length

    def _next(
        self, first: int, legs: Array, home: Array, price: Array, value: Array, steps: Array
    ) -> tuple[Array, Array, Array]:
        """The best of the stops from `first` on and the dock, `legs` and `home` moves away.

        Its value, its steps until the dock, and its place in the order, `[S]` each.
        """
        n = len(price)
        away = np.concatenate(
            [np.broadcast_to(legs, (n, len(self._stops)))[:, first:], np.broadcast_to(home, (n,))[:, None]],
            axis=1,
        )
        values = value[:, first:] - price[:, None] * away
        best = values.argmax(axis=1)
        row = np.arange(n)
        return values[row, best], (steps[:, first:] + away)[row, best], first + best

    def _towards(self, number: Array, left: Array, goal: Array) -> Array:
        """The action on a shortest way to the goals, or to the dock where time would run out, `[S]`."""
        cells, is_dock = self.cells, goal == len(self._stops)
        after, valid = cells.after[number], cells.has_effect[number]
        to_goal = np.where(
            is_dock[:, None],
            cells.steps_home[after],
            self._legs[np.minimum(goal, len(self._stops) - 1)[:, None], after],
        )
        in_time = valid & (cells.steps_home[after] <= left[:, None] - 1)
        steps = np.where(in_time, to_goal, np.where(valid, FAR + cells.steps_home[after], 10**10))
        return _PREFERRED[steps[:, _PREFERRED].argmin(axis=1)]


# Of several actions on shortest ways the first one is taken: nearer to the users first.
_PREFERRED = np.asarray(
    [Action.HOVER, Action.DOWNWARD, Action.LEFT, Action.RIGHT, Action.BACKWARD, Action.FORWARD, Action.UPWARD]
)


def _stops(cells: Cells) -> tuple[Array, Array, Array]:
    """The number of the stop over each cluster, `[M]`, and the steps there until its users are collected.

    Users are spread evenly over their disc. The stop is the cell over which they wait least in sum. The steps
    are the mean and the maximum of those that are collected within `HOVERS_MAX`, `[M, 2]`. The last result is
    the share of a user's data that the last 0, 1, ... moves to the stop deliver, `[M, APPROACH_MAX + 1]`.
    """
    scenario = cells.scenario
    discs, sizes = scenario.users.clusters, scenario.users.sizes
    places_m = np.concatenate(
        [_spread(disc.centre_m, disc.radius_m, size) for disc, size in zip(discs, sizes, strict=True)]
    )
    delivery, numbers = Delivery(cells, places_m), np.arange(len(cells.cells))
    data_bits = np.zeros((len(numbers), scenario.n_users))
    r_min_bits = scenario.user_r_min_bits(data_bits)
    collected, steps = data_bits > 0.0, data_bits.copy()  # hovers until a user is collected
    for _ in range(HOVERS_MAX):
        more_bits = delivery.of(numbers, collected)
        left_bits = np.maximum(r_min_bits - data_bits, 0.0)
        steps += np.where(collected, 0.0, np.minimum(left_bits / np.maximum(more_bits, 1e-9), 1.0))
        data_bits, collected = mission.collect(data_bits, collected, more_bits, r_min_bits)
    waits = np.where(collected, steps, 2.0 * HOVERS_MAX)
    stops = np.add.reduceat(waits, np.cumsum([0, *sizes[:-1]]), axis=1).argmin(axis=0)
    needs = []
    for cluster, stop in enumerate(stops):
        of_cluster = (scenario.user_cluster == cluster) & collected[stop]
        needs.append(
            (steps[stop, of_cluster].mean(), steps[stop, of_cluster].max()) if of_cluster.any() else (1, 1)
        )
    shares = delivery.everywhere(np.zeros(scenario.n_users, dtype=bool)) / r_min_bits
    approaches = np.zeros((len(stops), APPROACH_MAX + 1))
    for cluster, stop in enumerate(stops):
        mean_share = shares[:, scenario.user_cluster == cluster].mean(axis=1)
        in_layer = cells.cells[:, 2] == cells.cells[stop, 2]
        for moves in range(1, APPROACH_MAX):
            there = in_layer & (cells.steps_to(int(stop)) == moves)
            approaches[cluster, moves + 1] = approaches[cluster, moves]
            approaches[cluster, moves + 1] += mean_share[there].mean() if there.any() else 0.0
    return stops, np.asarray(needs, dtype=np.float64), approaches


def _spread(centre_m: tuple[float, float], radius_m: float, n: int) -> Array:
    """n points that are spread evenly over a disc, metres, `[n, 2]`: a sunflower's."""
    radius = radius_m * np.sqrt((np.arange(n) + 0.5) / n)
    angle_rad = 2.0 * np.pi * _GOLDEN * np.arange(n)
    return np.asarray(centre_m) + np.stack([radius * np.cos(angle_rad), radius * np.sin(angle_rad)], axis=-1)


def _order(between: Array, from_start: Array, to_dock: Array) -> Array:
    """An order of the stops on a short way from the start past all of them to the dock, integers `[M]`.

    `between` `[M, M]`, symmetric, `from_start` and `to_dock` `[M]` are moves.
    """
    n = len(between)
    legs = np.zeros((n + 2, n + 2), dtype=np.int64)  # the start is stop n, the dock stop n + 1
    legs[:n, :n] = between
    legs[n, :n] = legs[:n, n] = from_start
    legs[n + 1, :n] = legs[:n, n + 1] = to_dock
    if n <= EXACT_MAX:
        orders = np.asarray(list(itertools.permutations(range(n))))
        ends = np.full(len(orders), n)
        paths = np.column_stack([ends, orders, ends + 1])
        return orders[legs[paths[:, :-1], paths[:, 1:]].sum(axis=1).argmin()]
    path = [n]
    while len(path) <= n:
        path.append(min(set(range(n)) - set(path), key=lambda i: (legs[path[-1], i], i)))
    best: Array = np.asarray([*path, n + 1])
    while (shorter := _improved(best, legs)) is not None:
        best = shorter
    return best[1:-1]


def _improved(path: Array, legs: Array) -> Array | None:
    """The path `[M + 2]` after the best change by 2-opt or Or-opt; None: no change makes it shorter."""
    n, at = len(path) - 2, legs[path[:, None], path]  # between places on the path
    saved = np.diagonal(at, 1)  # by each edge that is left out, `[M + 1]`
    # 2-opt: the stops from i to j in reverse
    i, j = np.argwhere(np.tri(n, n, -1, dtype=bool).T).T + 1
    gains: Array = saved[i - 1] + saved[j] - at[i - 1, j] - at[i, j + 1]
    best, change = gains.max(initial=0), None
    if best > 0:
        first, last = i[gains.argmax()], j[gains.argmax()]
        change = np.concatenate([path[:first], path[first : last + 1][::-1], path[last + 1 :]])
    # Or-opt: up to three stops from i on go between k and k + 1, as they are or in reverse
    for size in range(1, min(3, n - 1) + 1):
        i, k = np.indices((n + 1 - size, n + 1))
        i += 1
        j = i + size - 1
        closed = saved[i - 1] + saved[j] - at[i - 1, j + 1] + saved[k]
        outside = (k < i - 1) | (k > j)
        for first, last, step in ((i, j, 1), (j, i, -1)):
            gains = np.where(outside, closed - at[k, first] - at[last, k + 1], 0)
            if gains.max() > best:
                best, found = gains.max(), np.unravel_index(gains.argmax(), gains.shape)
                begin, end, after = (int(places[found]) for places in (i, j + 1, k))
                part, others = path[begin:end][::step], np.delete(path, np.arange(begin, end))
                cut = after + 1 if after < begin else after + 1 - size
                change = np.concatenate([others[:cut], part, others[cut:]])
    return change
