"""The Q-network: one definition, as functions over a dict of arrays.

It runs on numpy (a node in flight) and on torch (training, with gradients). Parameters may have leading run
dimensions: `[N, in, out]` are N independent networks for observations `[N, B, D]`; `[in, out]` is one network
for `[B, D]`.
"""

import math
from typing import Annotated, Literal, TypeAlias

import msgspec
import numpy as np

from uav_dc_ros.core.arrays import Array, array_namespace

Aggregation: TypeAlias = Literal["mean", "max"]
Parameters: TypeAlias = dict[str, Array]
Width: TypeAlias = Annotated[int, msgspec.Meta(ge=1, le=4096)]


class Architecture(msgspec.Struct, frozen=True, kw_only=True):
    """Sizes of a Q-network."""

    n_inputs: int  # length D of the observation
    hidden: tuple[Width, ...]  # units of each hidden layer
    n_actions: int
    # Subtracted from the advantage: its `mean` (eq. 30) or its `max` (eq. 29); None for the plain network of
    # the paper's first algorithm.
    dueling: Aggregation | None


def shapes(architecture: Architecture) -> dict[str, tuple[int, ...]]:
    """Name and shape of every parameter of one network."""
    heads = {"value": 1, "advantage": architecture.n_actions}
    if architecture.dueling is None:
        heads = {"q": architecture.n_actions}
    sizes = (architecture.n_inputs, *architecture.hidden)
    layers = {f"hidden_{i}": (sizes[i], sizes[i + 1]) for i in range(len(architecture.hidden))}
    layers |= {head: (sizes[-1], n) for head, n in heads.items()}
    return {
        f"{layer}.{part}": shape
        for layer, (n_in, n_out) in layers.items()
        for part, shape in (("weight", (n_in, n_out)), ("bias", (n_out,)))
    }


def initial(architecture: Architecture, rng: np.random.Generator) -> Parameters:
    """Random parameters of one network, float32: uniform within `1 / sqrt(fan in)`, biases zero."""
    return {
        name: np.zeros(shape, np.float32)
        if len(shape) == 1
        else (rng.uniform(-1.0, 1.0, shape) / math.sqrt(shape[0])).astype(np.float32)
        for name, shape in shapes(architecture).items()
    }


def q_values(architecture: Architecture, parameters: Parameters, observation: Array) -> Array:
    """Q(s, a) of every action, `[..., B, A]`, for observations `[..., B, D]`.

    The parameters are named as by `shapes`, with equal leading dimensions, and have the observation's dtype.
    """

    def layer(name: str, inputs: Array) -> Array:
        return inputs @ parameters[name + ".weight"] + parameters[name + ".bias"][..., None, :]

    features = observation
    for i in range(len(architecture.hidden)):
        before = layer(f"hidden_{i}", features)
        features = before * (before > 0)  # ReLU in every array library
    if architecture.dueling is None:
        return layer("q", features)
    advantage = layer("advantage", features)
    if architecture.dueling == "mean":
        subtracted = advantage.sum(axis=-1, keepdims=True) / architecture.n_actions
    else:
        subtracted = array_namespace(advantage).max(advantage, axis=-1, keepdims=True)
    return layer("value", features) + (advantage - subtracted)
