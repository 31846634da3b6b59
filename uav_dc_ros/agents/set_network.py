"""The Q-network for observations `entities`: two networks for sets, of the value and of the advantages.

Each of them has layers shared by all clusters, pooled:

    h_i = relu(x_i W_x + g W_g)                    each cluster i beside the mission's numbers g
    k_i = relu(h_i W_h + mean(h) W_m + max(h) W_n) each cluster among the others (Zaheer et al., "Deep Sets",
                                                   NeurIPS 2017)
    z   = relu(LN([mean(k), max(k), g] W))         and further layers

The duel (eq. 30 of the paper) is between them:

    V   = z w_v / 10
    A_a = z w_a                                    in steps: `price` is what a step costs in J
    Q_a = V + price (A_a - mean(A))

V and A share no layer: errors of V, which are many times what a step costs, would change decisions. The plan
of the observation (see `core.entities.encoding`) enters as its numbers, since a network that adds to the plan
learns less. A decision weighs half of what the plan loses with an action beside A, see `preferences`.

LN is layer normalisation without parameters (Ba et al., 2016). Clusters that pad a batch have zeros only and
count nowhere. As functions over a dict of arrays it runs on numpy and on torch, as `network` does.
"""

import math
from collections.abc import Callable
from itertools import pairwise

import msgspec
import numpy as np

from uav_dc_ros.agents.network import Parameters, Width
from uav_dc_ros.core.arrays import Array, array_namespace
from uav_dc_ros.core.entities.encoding import CLUSTER, GLOBAL, LOSS, PRICE

_EPSILON = 1e-5  # of the variance
PLAN_SHARE = 0.5  # of what an action loses of the plan, in a decision
VALUE_SCALE = 10.0  # V lies in [-1, 1], and its errors of a tenth of that are large


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
    layers: dict[str, tuple[int, ...]] = {}
    for stream, n in (("value", 1), ("advantage", architecture.n_actions)):
        own: dict[str, tuple[int, ...]] = {
            "cluster.weight": (architecture.n_cluster, width),
            "mission.weight": (n_global, width),
            "cluster.bias": (width,),
            "own.weight": (width, width),
            "mean.weight": (width, width),
            "max.weight": (width, width),
            "own.bias": (width,),
        }
        for i, (n_in, n_out) in enumerate(pairwise(sizes)):
            own |= {f"hidden_{i}.weight": (n_in, n_out), f"hidden_{i}.bias": (n_out,)}
        own |= {"head.weight": (sizes[-1], n), "head.bias": (n,)}
        layers |= {f"{stream}.{name}": shape for name, shape in own.items()}
    return layers


def initial(architecture: SetArchitecture, rng: np.random.Generator) -> Parameters:
    """Random parameters, float32: uniform within `1 / sqrt(fan in)`, biases and heads zero."""
    return {
        name: np.zeros(shape, np.float32)
        if len(shape) == 1 or ".head." in name
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
    """Q(s, a) of every action in J, `[B, A]`, for observations `[B, D]` of any number of clusters.

    The parameters are named as by `shapes`, and have the observation's dtype. `active` is a faster
    `activation`.
    """
    advantage = advantages(architecture, parameters, observation, active)
    advantage = advantage - advantage.sum(axis=-1, keepdims=True) / architecture.n_actions
    value = values(architecture, parameters, observation, active)
    return value[:, None] + observation[:, PRICE, None] * advantage


def values(
    architecture: SetArchitecture,
    parameters: Parameters,
    observation: Array,
    active: Callable[[Array], Array] = activation,
) -> Array:
    """V(s) in J, `[B]`; arguments as of `q_values`."""
    return stream("value", architecture, parameters, observation, active)[:, 0] / VALUE_SCALE


def advantages(
    architecture: SetArchitecture,
    parameters: Parameters,
    observation: Array,
    active: Callable[[Array], Array] = activation,
) -> Array:
    """A(s, a) of every action in steps, plus a number of the state, `[B, A]`; arguments as of `q_values`."""
    return stream("advantage", architecture, parameters, observation, active)


def preferences(
    architecture: SetArchitecture,
    parameters: Parameters,
    observation: Array,
    active: Callable[[Array], Array] = activation,
) -> Array:
    """What decides, `[B, A]` in steps: A less a share of what the plan loses; arguments as of `q_values`.

    In a field unlike those of the training A may prefer to go to and fro, and the plan then decides.
    """
    lost = observation[:, LOSS : LOSS + architecture.n_actions] / observation[:, PRICE, None]
    return advantages(architecture, parameters, observation, active) - PLAN_SHARE * lost


def stream(
    name: str,
    architecture: SetArchitecture,
    parameters: Parameters,
    observation: Array,
    active: Callable[[Array], Array],
) -> Array:
    """Outputs of the network "value", `[B, 1]`, or "advantage", `[B, A]`; arguments as of `q_values`."""
    xp = array_namespace(observation)
    mission = observation[:, : architecture.n_global]
    clusters = observation[:, architecture.n_global :].reshape((len(mission), -1, architecture.n_cluster))
    present = clusters[..., :1]  # its first number: 1, or 0 of padding
    share = present / present.sum(axis=1, keepdims=True)

    def weight(layer: str) -> Array:
        return parameters[f"{name}.{layer}.weight"]

    def dense(layer: str, inputs: Array) -> Array:
        return inputs @ weight(layer) + parameters[f"{name}.{layer}.bias"]

    def positive(numbers: Array) -> Array:
        return numbers.clip(0.0)  # ReLU

    def pooled(numbers: Array) -> tuple[Array, Array]:
        # Outputs of ReLU are not negative: zeros of padding are no maximum.
        return (numbers * share).sum(axis=1), xp.max(numbers * present, axis=1)

    features = positive(dense("cluster", clusters) + (mission @ weight("mission"))[:, None])
    mean, largest = pooled(features)
    among = mean @ weight("mean") + largest @ weight("max")
    mean, largest = pooled(positive(dense("own", features) + among[:, None]))
    features = xp.concat([mean, largest, mission], axis=-1)
    for i in range(len(architecture.hidden)):
        features = active(dense(f"hidden_{i}", features))
    return dense("head", features)
