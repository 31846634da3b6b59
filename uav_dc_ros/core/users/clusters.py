"""Means over the users of each cluster."""

from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from uav_dc_ros.core.arrays import Array, array_namespace, constant

if TYPE_CHECKING:
    from uav_dc_ros.core.scenario import Scenario


def cluster_means(scenario: "Scenario", per_user: Array) -> Array:
    """Mean over the users of each cluster: `[..., U]` to `[..., M]`."""
    sizes, leading = scenario.users.sizes, per_user.shape[:-1]
    if len(set(sizes)) == 1:
        return per_user.reshape((*leading, len(sizes), sizes[0])).sum(axis=-1) / sizes[0]
    xp, means = array_namespace(per_user), []
    whole = xp.astype(per_user.reshape((-1,))[:1], xp.int64)
    users_by_size, order = _by_size(sizes)
    for size, users in users_by_size:
        of_size = xp.take(per_user, constant(users, whole), axis=-1)
        means.append(of_size.reshape((*leading, -1, size)).sum(axis=-1) / size)
    return xp.take(xp.concat(means, axis=-1), constant(order, whole), axis=-1)


@cache
def _by_size(sizes: tuple[int, ...]) -> tuple[tuple[tuple[int, tuple[int, ...]], ...], tuple[int, ...]]:
    """The users of all clusters of each size, and the place of each cluster among these clusters."""
    starts = np.cumsum([0, *sizes])
    clusters = {size: [i for i, n in enumerate(sizes) if n == size] for size in dict.fromkeys(sizes)}
    users = tuple(
        (size, tuple(int(starts[i]) + k for i in of_size for k in range(size)))
        for size, of_size in clusters.items()
    )
    return users, tuple(np.argsort([i for of_size in clusters.values() for i in of_size]).tolist())
