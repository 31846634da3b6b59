"""What a channel draws: shadowing, fading and line of sight. docs/channels.md writes the models out.

A mission has one field of shadowing, from a seed that its first draws give. Each step has a seed of its own,
from the draws of that step, for the line of sight and the fading of every user. The seeds travel in `users`,
so that a node that measures the channel needs no state. The draws of a mission are not more than without a
random channel: its users are at the same positions.
"""

import math
from typing import Annotated, NamedTuple, TypeAlias

import msgspec
import numpy as np
from msgspec import Meta

from uav_dc_ros.core.arrays import Array, array_namespace
from uav_dc_ros.core.propagation import counter_random

# Waves of a field. The excess kurtosis of its values is -1.5 / WAVES; a normal distribution has 0.
WAVES = 64
_BLOCK = 2**16  # users times waves of the worlds that numpy computes at once: what a cache holds
_WAVES_STREAM, _SIGHT_STREAM, _FADING_STREAM = range(3)


class Shadowing(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Log-normal shadowing, constant over a mission, correlated in space; see `shadowing`."""

    # Standard deviation, dB. Without it that of Table B-3, in `tr_36_777` only
    sigma_db: Annotated[float, Meta(ge=0, le=30)] | None = None
    # Distance that the UAV or a user moves until the correlation is 1/e, metres
    correlation_m: Annotated[float, Meta(gt=0)]


class Rayleigh(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="model", tag="rayleigh"):
    """Fading without a dominant path: an exponentially distributed power gain with mean 1."""


class Rician(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="model", tag="rician"
):
    """Fading with a dominant path."""

    k_db: Annotated[float, Meta(ge=-50, le=60)]  # power of the dominant path over that of the others, dB

    @property
    def k(self) -> float:
        """The same, linear."""
        return 10.0 ** (self.k_db / 10.0)


Fading: TypeAlias = Rayleigh | Rician


class Seeds(NamedTuple):
    """The seeds of a mission's channel in one step; see `counter_random.seed_of`."""

    shadowing: int  # of the mission, from its first draws
    link: int  # of the step, from the draws of the step


class Realization(NamedTuple):
    """What the channel has drawn in one step."""

    waves: Array  # of the mission's shadowing, see `waves`; not used in a scenario without
    link_seed: Array  # of the step, integers `[...]`


def waves(settings: Shadowing, seed: Array, like: Array) -> Array:
    """A mission's field of shadowing as plane waves, `[..., 6, W]`, from its seed, integers `[...]`.

    Rows: two wave numbers over the user's position and three over the UAV's, turns per metre; and the phase,
    turns. The waves have the spectral density of exp(-d / correlation_m) in the plane and in space:
    multivariate Cauchy distributions. `like` gives the dtype.
    """
    xp = array_namespace(seed)
    first, second = counter_random.uniforms(seed, 4 * WAVES, _WAVES_STREAM, like)

    def block(i: int) -> tuple[Array, Array]:
        return first[..., i * WAVES : (i + 1) * WAVES], second[..., i * WAVES : (i + 1) * WAVES]

    (radius, turn), (phase, _) = block(0), block(1)
    radius, angle = xp.sqrt(1.0 / (radius * radius) - 1.0), (2.0 * math.pi) * turn
    (x, y), (z, divisor) = counter_random.normals(*block(2)), counter_random.normals(*block(3))
    user = [radius * xp.cos(angle), radius * xp.sin(angle)]
    uav = [one / xp.abs(divisor) for one in (x, y, z)]
    rows = [one / (2.0 * math.pi * settings.correlation_m) for one in (*user, *uav)]
    return xp.stack([*rows, phase], axis=-2)


def shadowing(waves: Array, uav_m: Array, users_m: Array) -> Array:
    """Shadowing of each user, `[..., U]`, relative to its standard deviation.

    A sum of cosines over the positions of the UAV `[..., 3]` and of the users `[..., U, 2]`, metres. Over all
    seeds its mean is 0, its variance 1, and the correlation of two links exp(-(d_uav + d_user) / d_corr):
    Gudmundson, "Correlation model for shadow fading in mobile radio systems", Electronics Letters 27(23),
    1991, for either end, and for both their product.
    """
    xp, n = array_namespace(waves), max(1, _BLOCK // (WAVES * users_m.shape[-2]))
    if type(waves) is np.ndarray and waves.ndim == users_m.ndim > 2 and len(waves) > n:
        blocks = [slice(i, i + n) for i in range(0, len(waves), n)]
        return np.concatenate([shadowing(waves[i], uav_m[i], users_m[i]) for i in blocks])
    phase = waves[..., 5, :]
    for i in range(3):
        phase = phase + waves[..., 2 + i, :] * uav_m[..., i : i + 1]
    turns = phase[..., None, :] + waves[..., None, 0, :] * users_m[..., 0:1]
    turns += waves[..., None, 1, :] * users_m[..., 1:2]
    turns -= xp.round(turns)  # the cosine of a large angle takes ten times as long
    turns *= 2.0 * math.pi
    return math.sqrt(2.0 / WAVES) * xp.cos(turns).sum(axis=-1)


def has_line_of_sight(probability: Array, link_seed: Array) -> Array:
    """A draw for each user, bool `[..., U]`, with a probability `[..., U]`, from the step's seed `[...]`."""
    draw, _ = counter_random.uniforms(link_seed, probability.shape[-1], _SIGHT_STREAM, like=probability)
    return draw < probability


def fading(settings: Fading, link_seed: Array, like: Array, line_of_sight: Array | None = None) -> Array:
    """Power gain of the fading of each user, linear, `[..., U]` as `like`, with mean 1; see `Rician`.

    `link_seed` is that of the step, `[...]`. Users without `line_of_sight`, bool `[..., U]` where it was
    drawn, have no dominant path: their fading is Rayleigh's.
    """
    xp = array_namespace(like)
    k = settings.k if isinstance(settings, Rician) else 0.0
    in_phase, quadrature = counter_random.normals(
        *counter_random.uniforms(link_seed, like.shape[-1], _FADING_STREAM, like)
    )
    direct, scattered = math.sqrt(k / (k + 1.0)), math.sqrt(0.5 / (k + 1.0))
    if line_of_sight is not None and k > 0.0:
        ones = xp.ones_like(like)
        direct = xp.where(line_of_sight, direct * ones, 0.0 * ones)
        scattered = xp.where(line_of_sight, scattered * ones, math.sqrt(0.5) * ones)
    in_phase, quadrature = direct + scattered * in_phase, scattered * quadrature
    return in_phase * in_phase + quadrature * quadrature
