"""Random numbers that are a function of a seed and of counters, the same in numpy and torch on any device.

Threefry-2x32 with 20 rounds: Salmon, Moraes, Dror, Shaw, "Parallel random numbers: as easy as 1, 2, 3", SC11.
There is no state: a node that was restarted, an environment and a verifier compute the same numbers.
"""

import math

from uav_dc_ros.core.arrays import Array, array_namespace, constant

_ROUNDS = 20
_ROTATIONS = (13, 15, 26, 6, 17, 29, 16, 24)
_PARITY = 0x1BD11BDA
_WORD = 0xFFFFFFFF


def seed_of(draws: Array) -> Array:
    """A seed, an integer `[...]`, from uniform draws `[..., U, 2]`: the leading 24 bits of the first two.

    These are all bits of a float32, so that a mission has one seed in both precisions.
    """
    xp = array_namespace(draws)
    bits = xp.astype(draws[..., 0, :2] * 2.0**24, xp.int64)
    return (bits[..., 0] << 24) + bits[..., 1]


def words(seed: Array, counter: Array, stream: int) -> tuple[Array, Array]:
    """Two random words of 32 bits for each counter, integers `[..., C]` each.

    `seed` is `[...]`, `counter` `[C]`; `stream` separates purposes. These are words, too: seeds of 64 bits.
    """
    # Words are in int64, which every library has: sums stay below 2**38, and shifts below 2**62.
    low, high = seed[..., None] & _WORD, (seed[..., None] >> 32) & _WORD
    keys = (low, high, low ^ high ^ _PARITY)
    a, b = counter + low, (high + stream) & _WORD
    for i in range(_ROUNDS):
        a = a + b
        turn = _ROTATIONS[i % 8]
        b = (((b << turn) | (b >> (32 - turn))) ^ a) & _WORD
        if i % 4 == 3:
            n = i // 4 + 1
            a, b = a + keys[n % 3], (b + (keys[(n + 1) % 3] + n)) & _WORD
    return a & _WORD, b


def uniforms(seed: Array, n: int, stream: int, like: Array) -> tuple[Array, Array]:
    """Two uniform numbers in (0, 1) for each of `n` counters, `[..., n]` each, with the dtype of `like`.

    They are the odd multiples of 2**-24, so that they are the same in float32 and float64.
    """
    xp = array_namespace(seed)
    counter = constant(range(n), seed)
    first, second = (
        xp.astype((word >> 9) * 2 + 1, like.dtype) * 2.0**-24 for word in words(seed, counter, stream)
    )
    return first, second


def normals(first: Array, second: Array) -> tuple[Array, Array]:
    """Two standard normal numbers from two uniform ones, all `[...]` (Box and Muller)."""
    xp = array_namespace(first)
    radius, angle = xp.sqrt(-2.0 * xp.log(first)), (2.0 * math.pi) * second
    return radius * xp.cos(angle), radius * xp.sin(angle)
