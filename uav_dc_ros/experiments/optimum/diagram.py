"""Proofs that no mission collects so many users and arrives so early: a relaxed decision diagram.

A layer holds the partial missions after a step, each as its cell and the share of r_min that each user has
delivered. Two kinds of them are dropped:

- one that cannot end as required, by the bounds below;
- one in the cell of another that has at least as much from every user.

If more than `width` are left, similar ones in one cell are merged, each user's share being the greatest: what
was possible before remains possible. So if no partial mission is left, there is no such mission. Without a
merge, what is left at the end is such a mission.

Bergman, Cire, van Hoeve, Hooker, "Discrete Optimization with Decision Diagrams", INFORMS Journal on Computing
28(1), 2016. The bounds are Lagrangian: users have prices; a mission earns the price of each share delivered,
and must earn the sum of the cheapest n users, among those of the groups that it came into reach of. The most
that can be earned is a recursion over steps, cells and sets of groups. With the price of one user only, it is
whether this user can be collected at all.
"""

import time
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.experiments.optimum.problem import ClairvoyantProblem

# `excluded`: there is no such mission. `found`: there may be one, see `Verdict.actions`. `stopped`: no time.
Outcome: TypeAlias = Literal["excluded", "found", "stopped"]

_ROUNDING = 1e-9  # of shares: r_min is reached from 1 less this
_BOUND_ROUNDING = 1e-4  # of what is earned, in single precision
_ALONE_ROUNDING = 1e-5  # of what a user can still deliver, likewise
_DOMINATING = 12  # missions in each cell that others are compared with
_LEVELS = (16, 8, 4, 2, 1)  # of each user's share, by which missions are merged
_GROUP_LEVELS = (20, 14, 10, 7, 5, 4, 3, 2, 1)  # then of each group's mean share


@dataclass(frozen=True)
class Verdict:
    """What is known of missions that collect n users and arrive by a step."""

    outcome: Outcome
    actions: Array  # of a mission that is left, integers `[T]`; it may fall short, if any were merged


@dataclass(frozen=True)
class _Layer:
    """Partial missions after a step."""

    cell: Array  # `[B]`
    share: Array  # of each user, 0 to 1, `[B, U]`
    parent: Array  # in the layer before, `[B]`
    action: Array  # `[B]`

    def take(self, where: Array) -> "_Layer":
        return _Layer(**{name: getattr(self, name)[where] for name in self.__dataclass_fields__})


class Prover:
    """Decides for one mission's walks whether n users can be collected with an arrival by a step."""

    def __init__(self, problem: ClairvoyantProblem) -> None:
        self._problem = problem
        in_group = np.arange(problem.n_groups)[:, None] == problem.group
        self._in_group = in_group.astype(np.float64)  # `[G, U]`
        self._prices = np.vstack([self._in_group, np.ones(problem.n_users)])  # `[P, U]`
        self._hash = np.random.default_rng(0).integers(0, 2**64, problem.n_users, np.uint64)
        self._bounds: tuple[tuple[int, int], tuple[Array, Array]] | None = None  # of the latest question

    def decide(self, n_users: int, arrival_step: int, width: int, until_s: float = np.inf) -> Verdict:
        """Whether a mission collects at least `n_users` and arrives by `arrival_step`.

        `until_s` is the time of `time.monotonic()` at which the search stops.
        """
        problem, nothing = self._problem, np.zeros(0, np.int64)
        earns, alone = self._bounds_of(n_users, arrival_step)
        zero = np.zeros(1, np.int64)
        layer = _Layer(zero + problem.start_cell, np.zeros((1, problem.n_users)), zero, zero)
        history: list[_Layer] = []
        for step in range(problem.n_steps):
            if time.monotonic() > until_s:
                return Verdict("stopped", nothing)
            layer = self._extend(layer, step)
            possible = layer.share + alone[step + 1][layer.cell] >= 1.0 - _ALONE_ROUNDING
            layer = layer.take(possible.sum(axis=-1) >= n_users)
            earned = layer.share @ self._prices.T
            # Groups that need not be in reach again: all their users are collected, or may be left out.
            missing = (layer.share < 1.0) @ self._in_group.T
            done = (missing <= problem.n_users - n_users) @ (1 << np.arange(problem.n_groups))
            enough = np.ones(layer.cell.shape, bool)
            for i, most in enumerate(earns):
                enough &= earned[:, i] + most[step + 1][layer.cell, done] >= -_BOUND_ROUNDING
            layer = self._undominated(layer.take(enough))
            if not len(layer.cell):
                return Verdict("excluded", nothing)
            if len(layer.cell) > width:
                layer = self._merged(layer, width)
            history.append(layer)
            if problem.ends_on_arrival and (docked := problem.model.docked[layer.cell]).any():
                return Verdict("found", _actions(history, int(docked.argmax())))
        return Verdict("found", _actions(history, int(layer.share.sum(axis=-1).argmax())))

    def _extend(self, layer: _Layer, step: int) -> _Layer:
        problem = self._problem
        parent, action = np.nonzero(problem.model.has_effect[layer.cell])
        cell = problem.model.after[layer.cell[parent], action]
        share = np.minimum(layer.share[parent] + problem.share[step][cell], 1.0)
        share[share > 1.0 - _ROUNDING] = 1.0
        return _Layer(cell, share, parent, action)

    @staticmethod
    def _undominated(layer: _Layer) -> _Layer:
        """Without missions that have no more from any user than one of the best in their cell."""
        order = np.lexsort((-layer.share.sum(axis=-1), layer.cell))
        layer = layer.take(order)
        first = np.flatnonzero(np.diff(layer.cell, prepend=-1))
        size = np.diff(first, append=len(order))
        first = np.repeat(first, size)
        rank, kept = np.arange(len(order)) - first, np.ones(len(order), bool)
        for i in range(_DOMINATING):
            below = np.flatnonzero((rank > i) & kept)
            if not below.size:
                break
            kept[below[(layer.share[first[below] + i] >= layer.share[below]).all(axis=-1)]] = False
        return layer.take(kept)

    def _merged(self, layer: _Layer, width: int) -> _Layer:
        """With similar missions of each cell merged, to at most about `width`."""
        by_group = layer.share @ (self._in_group / self._in_group.sum(axis=-1, keepdims=True)).T
        levels = [(layer.share, n) for n in _LEVELS] + [(by_group, n) for n in _GROUP_LEVELS]
        for share, n in levels:
            rounded = (share * n + _ROUNDING).astype(np.uint64)  # down: who is collected has a level alone
            alike = (rounded * self._hash[: share.shape[-1]]).sum(axis=-1, dtype=np.uint64)
            order = np.lexsort((alike, layer.cell))
            new = np.ones(len(order), bool)
            new[1:] = (np.diff(layer.cell[order]) != 0) | (alike[order[1:]] != alike[order[:-1]])
            first = np.flatnonzero(new)
            if len(first) <= width:
                break
        merged = layer.take(order[first])
        return replace(merged, share=np.maximum.reduceat(layer.share[order], first))

    def _bounds_of(self, n_users: int, arrival_step: int) -> tuple[Array, Array]:
        """What missions after each step can still earn, less what they must, `[P, T + 1, C, 2^G]`.

        And the share that each user can still deliver, if the mission is for it alone, `[T + 1, C, U]`.
        """
        if self._bounds is None or self._bounds[0] != (n_users, arrival_step):
            problem = self._problem
            ordered = np.sort(np.where(problem.members, self._prices[:, None], np.inf), axis=-1)
            needed = ordered[..., :n_users].sum(axis=-1)  # infinite for sets with too few users
            earns = np.stack(
                [
                    self._most(problem.share @ prices, -must, arrival_step, problem.in_reach)
                    for prices, must in zip(self._prices, needed, strict=True)
                ]
            )
            alone = self._most(problem.share, np.zeros(problem.n_users), arrival_step, None)
            self._bounds = (n_users, arrival_step), (earns, alone)
        return self._bounds[1]

    def _most(self, gain: Array, final: Array, arrival_step: int, in_reach: Array | None) -> Array:
        """The most that can be added up after each step by moves that arrive in time, `[T + 1, C, N]`.

        `gain` is that of a step, `[T, C]` or `[T, C, N]`, and `final` `[N]` is added at the end. With
        `in_reach`, N counts the sets of groups that were in reach before.
        """
        problem, model = self._problem, self._problem.model
        n_cells = len(model.cells)
        most = np.full((problem.n_steps + 1, n_cells, len(final)), -np.inf, np.float32)
        elsewhere = ~model.docked
        sets = np.arange(len(final))
        for t in range(problem.n_steps, -1, -1):
            if t == problem.n_steps:
                most[t] = final
            else:
                after = most[t + 1]
                if in_reach is not None:
                    after = np.take_along_axis(after, sets | in_reach[t][:, None], axis=-1)
                after = after + (gain[t] if gain.ndim == 3 else gain[t][:, None]).astype(np.float32)
                best = after[model.after[:, 0]]
                for action in range(1, model.after.shape[1]):
                    np.maximum(best, after[model.after[:, action]], out=best)
                most[t] = best
                if problem.ends_on_arrival and t > 0:
                    most[t, model.docked] = final
            if t >= arrival_step:
                most[t, elsewhere] = -np.inf
            if problem.ends_on_arrival and t > arrival_step:
                most[t] = -np.inf
        return most


def _actions(history: list[_Layer], entry: int) -> Array:
    actions = []
    for layer in reversed(history):
        actions.append(layer.action[entry])
        entry = layer.parent[entry]
    return np.asarray(actions[::-1], np.int64)
