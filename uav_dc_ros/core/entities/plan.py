"""The plan of the observation `entities`: what a mission can still be worth, after each action.

A plan takes the shortest way past some stops to the dock, and hovers at each stop until those of its users
are collected that are worth waiting for. Of all sets of stops the one counts that is worth most of the
objective in the time that is left. A stop is a cluster; where there are many, those near one another share
one.

The plan does not know where users are. It expects each to deliver what users of its cluster deliver on
average. What a user delivered in the last step corrects that: a user that walked out of reach is not waited
for.
"""

from typing import Any, NamedTuple

from uav_dc_ros.core.arrays import Array, array_namespace, constant
from uav_dc_ros.core.entities.numbers import in_sets, picked, rows
from uav_dc_ros.core.entities.tables import FAR, EntityTables
from uav_dc_ros.core.grid import Action

_NONE = -10.0  # worth of a plan that there is not
_DONE = 1e-4  # share of its data that a user may lack
_PARTS = 1024.0  # of a step: sums of such parts are exact, in any order and with any number of missions
_LEFT = 0.7  # share of a cluster's users after which, away from it, the others are expected out of reach
_SLOW, _FAST = 0.05, 2.0  # least and most that a user delivers, as a share of what is expected
_ANSWERS = 0.5  # least of one that delivers at all: its rate grows once others are collected


class BestPlan(NamedTuple):
    """The best plan after each action, and of these the best."""

    worth: Array  # J from now on of the best plan, `[N]`
    loss: Array  # J by which that of each action is less, 0 to 1; 1 if the UAV cannot land after it; `[N, 7]`
    steps: Array  # of the best plan, hovers included, `[N]`
    clusters: Array  # 1 for those in it, else 0, `[N, M]`


def best_plan(
    tables: EntityTables,
    *,
    rows_after: Array,
    after: Array,
    left: Array,
    allowed: Array,
    data: Array,
    collected: Array,
    delivered: Array,
    done: Array,
    begins: Array,
    per_user: Array,
    price: Array,
) -> BestPlan:
    """The best plans of N missions.

    Args:
        tables: of the scenario, in the library of the other arrays.
        rows_after: rows in the tables of the cells after each action, `[N, 7]`.
        after: `EntityTables.of_cell` there.
        left: steps that are left, `[N]`.
        allowed: actions after which the UAV can land, bool `[N, 7]`.
        data: share of what it must deliver that each user has delivered, `[N, U]`.
        collected: users that are collected, bool `[N, U]`.
        delivered: as `data`, in the last step.
        done: share of each cluster's users that are collected, `[N, M]`.
        begins: whether no step is flown, bool `[N]`.
        per_user: what a user is worth in J, `[N]`.
        price: what a step costs in J, `[N]`.
    """
    xp, n_clusters = array_namespace(after), len(tables.sizes)
    ways, home = after[..., :n_clusters], after[..., n_clusters]
    progress = after[..., n_clusters + 1 : 2 * n_clusters + 1]
    over = rows(xp, tables.over, rows_after[:, Action.HOVER]) & ~begins[:, None]
    pace = _pace(xp, tables, progress[:, Action.HOVER], over, delivered, done)
    # What each user still needs after each action, as a share of its data, `[N, 7, U]`.
    data = data[:, None] + pace[:, None] * xp.take(progress, tables.cluster_of, axis=-1)
    missing = (1.0 - data).clip(0.0, 1.0) * ~collected[:, None]
    is_open = missing > _DONE
    n_new = xp.astype(~collected[:, None] & ~is_open, xp.float32).sum(axis=-1)
    # Steps over its cluster of those that wait, in the order of collection, `[N, 7, M, largest size]`.
    needs = missing / (pace * tables.rate_of_user)[:, None]
    needs = xp.round(xp.where(is_open, needs, constant((FAR,), needs)) * _PARTS) / _PARTS
    needs = xp.sort(in_sets(xp, needs, tables.users, FAR), axis=-1)
    # A plan waits for as many of them as are worth it.
    counts = constant(range(1, needs.shape[-1] + 1), needs)
    gain = per_user[:, None, None, None] * counts - price[:, None, None, None] * needs
    last = xp.argmax(gain, axis=-1)
    zero = constant((0.0,), needs)
    waits = xp.max(gain, axis=-1) > 0.0  # `[N, 7, M]`
    n_open = xp.where(waits, xp.astype(last + 1, xp.float32), zero)
    needs = xp.where(waits, picked(xp, needs, last), zero)
    if tables.rounds is not None:
        rounds = rows(xp, tables.rounds, rows_after)  # `[N, 7, 2^S]`
    else:
        chain = xp.where(waits & (tables.apart > 0.5), needs + tables.apart, zero) @ tables.members
        needs = xp.maximum(chain, xp.max(in_sets(xp, needs, tables.of_stop, 0.0), axis=-1))
        ways = xp.where(waits, ways, constant((FAR,), ways))
        nearest = xp.min(in_sets(xp, ways, tables.of_stop, FAR), axis=-1)
        rounds = home[..., None] + tables.none
        for stop in range(tables.members.shape[1]):
            rounds = xp.minimum(rounds, nearest[..., stop, None] + tables.tours[:, stop])
        n_open = n_open @ tables.members
    left, per_user, price = (values[:, None, None] for values in (left, per_user, price))
    moves, hovers = 1.0 + rounds, needs @ tables.sets  # `[N, 7, 2^S]`
    steps = xp.minimum(moves + hovers, left)
    # Where the time is too short, most users of a cluster would be collected with the last steps.
    part = ((left - moves) / hovers.clip(1e-3)).clip(0.0, 1.0)
    n_users = n_new[..., None] + part * part * (n_open @ tables.sets)
    worth = per_user * n_users - price * steps
    in_time = (moves <= left) | (tables.none < 0.5)
    worth = xp.where(in_time & allowed[..., None], worth, constant((_NONE,), worth))
    by_action = xp.max(worth, axis=-1)
    best = xp.max(by_action, axis=-1)
    flat = worth.reshape((len(worth), -1))
    place = xp.argmax(flat, axis=-1)
    return BestPlan(
        worth=best,
        loss=(best[:, None] - by_action).clip(0.0, 1.0),
        steps=picked(xp, steps.reshape(flat.shape), place),
        clusters=rows(xp, tables.clusters, place % tables.sets.shape[1]),
    )


def _pace(xp: Any, tables: EntityTables, here: Array, over: Array, delivered: Array, done: Array) -> Array:
    """What each user delivers over its cluster, as a share of what is expected, `[N, U]`.

    Over its cluster the last step has shown that. Elsewhere those that are left of a cluster are expected out
    of reach. `here` is the progress of each cluster in the UAV's cell, `[N, M]`, and `over` is bool `[N, M]`.
    """
    of_users = tables.cluster_of
    shown = (delivered / xp.take(here.clip(1e-2), of_users, axis=-1)).clip(_ANSWERS, _FAST)
    shown = xp.where(delivered > 0.0, shown, constant((_SLOW,), shown))
    left_behind = xp.take(done >= _LEFT, of_users, axis=-1)
    expected = xp.where(left_behind, constant((_SLOW,), shown), constant((1.0,), shown))
    return xp.where(xp.take(over, of_users, axis=-1), shown, expected)
