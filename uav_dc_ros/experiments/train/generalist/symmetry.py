"""The eight symmetries of the grid, of the observation `entities` and of the actions. Needs no torch.

A field that is mirrored, or turned by a right angle, is as good a field to learn from. A policy that has seen
one has then seen eight.
"""

from typing import NamedTuple

import numpy as np

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.entities.encoding import CLUSTER, CLUSTERS, GLOBAL, GLOBALS, N_ACTIONS
from uav_dc_ros.core.grid import Action

N = 8


class Symmetry(NamedTuple):
    """Where the numbers of a turned observation come from: its number i is `sign[i] x[place[i]]`."""

    mission: Array  # places, integers `[GLOBAL]`
    mission_sign: Array  # float32 `[GLOBAL]`
    cluster: Array  # integers `[CLUSTER]`
    cluster_sign: Array  # float32 `[CLUSTER]`
    action: Array  # integers `[7]`

    def of_observation(self, observation: Array) -> Array:
        """Of observations `[B, D]`, numpy."""
        n_rows = len(observation)
        mission = observation[:, :GLOBAL][:, self.mission] * self.mission_sign
        clusters = observation[:, GLOBAL:].reshape((n_rows, -1, CLUSTER))[..., self.cluster]
        return np.concatenate([mission, (clusters * self.cluster_sign).reshape((n_rows, -1))], axis=-1)

    def of_actions(self, values: Array) -> Array:
        """Of numbers of the actions, `[B, 7]`."""
        return values[:, self.action]


def symmetry(number: int) -> Symmetry:
    """Bit 0 exchanges east and north, then bit 1 mirrors east and west, bit 2 north and south."""
    swap, mirror_x, mirror_y = (bool(number >> bit & 1) for bit in range(3))
    action = np.arange(N_ACTIONS)
    east, west, north, south = Action.RIGHT, Action.LEFT, Action.FORWARD, Action.BACKWARD
    if swap:
        action[[east, north, west, south]] = north, east, south, west
    if mirror_x:
        action[[east, west]] = action[[west, east]]
    if mirror_y:
        action[[north, south]] = action[[south, north]]

    def places(names: tuple[str, ...]) -> tuple[Array, Array]:
        found, signs = [], []
        for name in names:
            source = name
            if (base := name.rstrip("0123456789")).endswith("_a"):
                source = f"{base}{action[int(name.removeprefix(base))]}"
            words = name.split("_")
            mirrored = (mirror_x and "east" in words) or (mirror_y and "north" in words)
            if swap:
                turned = {"east": "north", "north": "east"}
                source = "_".join(turned.get(word, word) for word in source.split("_"))
            found.append(names.index(source))
            signs.append(-1.0 if mirrored else 1.0)
        return np.asarray(found), np.asarray(signs, np.float32)

    return Symmetry(*places(GLOBALS), *places(CLUSTERS), action)
