"""What a mission promises to end with: the estimate by which a search ranks missions."""

import numpy as np

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.planners.model import MissionModel

_REFRESHED_EVERY = 8  # steps, since users move
_GROUPS_MAX = 7  # of users, of which every order is tried
_NEVER = 1e9  # steps


class Promise:
    """J that a mission may end with, by a tour of the groups of users that it has still to collect.

    From a cell, a user is collected after the moves to some cell and the hovering there, at the least. A
    group is collected with the last of its users. A tour goes from group to group, and then to the dock.
    Groups that it has no time for, or that are not worth their time, are left out.
    """

    def __init__(self, model: MissionModel, r_min_bits: float | Array, weight: float) -> None:
        scenario = self._scenario = model.scenario
        self._model, self._r_min_bits, self._weight = model, r_min_bits, weight
        self._n_steps = scenario.mission.max_steps
        self._per_user, self._per_step = weight / scenario.n_users, (1.0 - weight) / self._n_steps
        self._refreshed: int | None = None  # step
        self._users_m: Array | None = None

    def __call__(
        self, step: int, n_flown: int, cell: Array, data_bits: Array, collected: Array
    ) -> tuple[Array, Array]:
        """The promise of missions, `[B]`, and the number of further users that they may collect, `[B]`."""
        if self._refreshed is None or step - self._refreshed >= _REFRESHED_EVERY:
            self._refreshed = step
            middle = min(step + _REFRESHED_EVERY // 2, self._model.n_steps - 1)
            self._refresh(self._model.walks.users_m[middle])
        left, home = self._n_steps - n_flown, self._model.steps_home[cell]
        is_open = ~collected & (self._steps_past[cell] <= left)
        steps_alone = self._steps_to[cell] - self._hover_steps * (data_bits / self._r_min_bits)
        # By group, `[B, G]`: users to collect, and steps until the last of them is.
        n_open = np.add.reduceat(is_open[:, self._order], self._starts, axis=-1)
        steps = np.maximum.reduceat(
            np.where(is_open, steps_alone, 0.0)[:, self._order], self._starts, axis=-1
        )
        promise = -self._per_step * home
        for wanted in (n_open > 0, 2 * n_open > self._sizes):  # the second leaves stragglers behind
            sets = (wanted << np.arange(len(self._sizes))).sum(axis=-1)
            missing = np.where(wanted, self._sizes - n_open, 0).sum(axis=-1)
            for group in range(len(self._sizes)):
                after = np.clip(np.floor(left - steps[:, group]), -1, self._n_steps).astype(np.int64)
                value = self._tours[sets, group, after + 1]
                value = value - self._per_step * steps[:, group] - self._per_user * missing
                promise = np.maximum(promise, np.where(wanted[:, group], value, -np.inf))
        # One user alone, where there is no time for a group.
        alone = np.maximum(steps_alone + self._home, home[:, None])
        in_time = is_open & (alone <= left)
        value = self._per_user - self._per_step * np.where(in_time, alone, 0.0)
        promise = np.maximum(promise, np.where(in_time, value, -np.inf).max(axis=-1))
        return self._per_user * collected.sum(axis=-1) + promise, is_open.sum(axis=-1)

    def _refresh(self, users_m: Array) -> None:
        """The steps to users at `users_m` `[U, 2]`, their groups, and the tours."""
        if self._users_m is not None and np.array_equal(users_m, self._users_m):
            return
        self._users_m, model = users_m, self._model
        bits = model.mean_delivered(users_m)
        share = bits / self._r_min_bits
        with np.errstate(divide="ignore"):
            hover = np.maximum(1.0 / share, 1.0)  # steps over each cell that collect the user, `[C, U]`
        self._hover_steps = hover.min(axis=0)  # `[U]`
        self._hover_steps[~np.isfinite(self._hover_steps)] = 0.0
        self._steps_to = model.spread(hover)  # to fly to a cell and collect the user there, `[C, U]`
        home = np.where(bits > 0.0, model.steps_home[:, None], np.inf)
        self._home = home.min(axis=0)  # moves home from the reach of each user, at least, `[U]`
        # And before them the moves into its reach, `[C, U]`
        self._steps_past = model.spread(np.where(bits > 0.0, 0.0, np.inf)) + self._home
        group = groups_of_users(self._scenario, users_m, _GROUPS_MAX)
        self._order = np.argsort(group, kind="stable")
        self._sizes = np.bincount(group)
        self._starts = np.cumsum([0, *self._sizes[:-1]])
        self._tours = self._best_tours()

    def _best_tours(self) -> Array:
        """Value of the best tour of some groups after one of them is collected, `[2^G, G, T + 2]`.

        By set of groups, by the group collected, and by the steps left, from -1 (no value) to T.
        """
        n = len(self._sizes)
        last_of = np.maximum.reduceat(self._steps_to[:, self._order], self._starts, axis=-1)  # `[C, G]`
        last_of = np.where(np.isfinite(last_of), last_of, 2.0 * self._n_steps)
        cell = last_of.argmin(axis=0)  # of each group, where it is collected soonest
        legs, home = last_of[cell], self._model.steps_home[cell]  # `[G, G]`, `[G]`
        length = np.full((1 << n, n), _NEVER)
        for group in range(n):
            length[1 << group, group] = home[group]
        for groups in range(1, 1 << n):
            members = [group for group in range(n) if groups >> group & 1]
            for group in members if len(members) > 1 else ():
                others = [one for one in members if one != group]
                length[groups, group] = (legs[group, others] + length[groups ^ 1 << group, others]).min()
        n_users = ((np.arange(1 << n)[:, None] >> np.arange(n) & 1) * self._sizes).sum(axis=-1)
        value = self._per_user * n_users[:, None] - self._per_step * length
        in_time = length[..., None] <= np.arange(-1, self._n_steps + 1)
        tours = np.where(in_time, value[..., None], -np.inf)
        for group in range(n):  # the best of all subsets
            halves = tours.reshape(-1, 2, 1 << group, *tours.shape[1:])
            np.maximum(halves[:, 1], halves[:, 0], out=halves[:, 1])
        return tours


def groups_of_users(scenario: Scenario, users_m: Array, n_max: int) -> Array:
    """Group of each user, integers `[U]` from 0: its cluster; with more than `n_max`, users that are close.

    The users are at `users_m` `[U, 2]`, metres.
    """
    if scenario.n_clusters <= n_max:
        return scenario.user_cluster
    # Farthest first: the next group begins with the user farthest from all others' first users.
    nearest = np.full(len(users_m), np.inf)
    group, first = np.zeros(len(users_m), np.int64), 0
    for i in range(n_max):
        distance = ((users_m - users_m[first]) ** 2).sum(axis=-1)
        group = np.where(distance < nearest, i, group)
        nearest = np.minimum(nearest, distance)
        first = int(nearest.argmax())
    return np.unique(group, return_inverse=True)[1]
