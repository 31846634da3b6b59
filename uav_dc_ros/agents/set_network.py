"""The Q-network for observations `entities`: layers shared by all clusters, pooled, and dueling heads.

    h_i = relu(x_i W_x + g W_g)                    each cluster i beside the mission's numbers g
    k_i = relu(h_i W_h + mean(h) W_m + max(h) W_n) each cluster among the others (Zaheer et al., "Deep Sets",
                                                   NeurIPS 2017)
    z   = relu(LN([mean(k), max(k), g] W))         and further layers
    Q   = V(z) + A(z) - mean(A(z))                 eq. 30 of the paper

LN is layer normalisation without parameters (Ba et al., 2016): it keeps Q-learning without a target network
stable (Gallici et al., "Simplifying Deep Temporal Difference Learning", ICLR 2025). Clusters that pad a batch
have zeros only and count nowhere. As functions over a dict of arrays it runs on numpy and on torch, as
`network` does.
"""

import math
from collections.abc import Callable
from itertools import pairwise

import msgspec
import numpy as np

from uav_dc_ros.agents.network import Parameters, Width
from uav_dc_ros.core.arrays import Array, array_namespace
from uav_dc_ros.core.entities.encoding import CLUSTER, GLOBAL

_EPSILON = 1e-5  # of the variance


class SetArchitecture(msgspec.Struct, frozen=True, kw_only=True):
    """Sizes of a Q-network for sets."""

    n_global: int = GLOBAL  # numbers of the mission
    n_cluster: int = CLUSTER  # numbers of a cluster
    width: Width  # units of both layers of a cluster
    hidden: tuple[Width, ...]  # units of each layer behind the pooling
    n_actions: int


def shapes(architecture: SetArchitecture) -> dict[str, tuple[int, ...]]:
    """Name and shape of every parameter."""
    width, n_global = architecture.width, architecture.n_global
    sizes = (2 * width + n_global, *architecture.hidden)
    layers = {
        "cluster.weight": (architecture.n_cluster, width),
        "mission.weight": (n_global, width),
        "cluster.bias": (width,),
        "own.weight": (width, width),
        "mean.weight": (width, width),
        "max.weight": (width, width),
        "own.bias": (width,),
    }
    for i, (n_in, n_out) in enumerate(pairwise(sizes)):
        layers |= {f"hidden_{i}.weight": (n_in, n_out), f"hidden_{i}.bias": (n_out,)}
    for head, n in (("value", 1), ("advantage", architecture.n_actions)):
        layers |= {f"{head}.weight": (sizes[-1], n), f"{head}.bias": (n,)}
    return layers


def initial(architecture: SetArchitecture, rng: np.random.Generator) -> Parameters:
    """Random parameters, float32: uniform within `1 / sqrt(fan in)`, biases zero."""
    return {
        name: np.zeros(shape, np.float32)
        if len(shape) == 1
        else (rng.uniform(-1.0, 1.0, shape) / math.sqrt(shape[0])).astype(np.float32)
        for name, shape in shapes(architecture).items()
    }


def activation(values: Array) -> Array:
    """ReLU after layer normalisation, in every array library."""
    n = values.shape[-1]
    centred = values - values.sum(axis=-1, keepdims=True) / n
    variance = (centred * centred).sum(axis=-1, keepdims=True) / n
    scaled = centred / (variance + _EPSILON) ** 0.5
    return scaled * (scaled > 0)


def q_values(
    architecture: SetArchitecture,
    parameters: Parameters,
    observation: Array,
    active: Callable[[Array], Array] = activation,
) -> Array:
    """Q(s, a) of every action, `[B, A]`, for observations `[B, D]` of any number of clusters.

    The parameters are named as by `shapes`, and have the observation's dtype. `active` is a faster
    `activation`.
    """
    xp = array_namespace(observation)
    mission = observation[:, : architecture.n_global]
    clusters = observation[:, architecture.n_global :].reshape((len(mission), -1, architecture.n_cluster))
    present = clusters[..., :1]  # its first number: 1, or 0 of padding
    share = present / present.sum(axis=1, keepdims=True)

    def layer(name: str, inputs: Array) -> Array:
        return inputs @ parameters[name + ".weight"] + parameters[name + ".bias"]

    def positive(values: Array) -> Array:
        return values.clip(0.0)  # ReLU

    def pooled(values: Array) -> tuple[Array, Array]:
        # Outputs of ReLU are not negative: zeros of padding are no maximum.
        return (values * share).sum(axis=1), xp.max(values * present, axis=1)

    beside = mission @ parameters["mission.weight"]
    features = positive(layer("cluster", clusters) + beside[:, None])
    mean, largest = pooled(features)
    among = mean @ parameters["mean.weight"] + largest @ parameters["max.weight"]
    mean, largest = pooled(positive(layer("own", features) + among[:, None]))
    features = xp.concat([mean, largest, mission], axis=-1)
    for i in range(len(architecture.hidden)):
        features = active(layer(f"hidden_{i}", features))
    advantage = layer("advantage", features)
    mean_advantage = advantage.sum(axis=-1, keepdims=True) / architecture.n_actions
    return layer("value", features) + (advantage - mean_advantage)
