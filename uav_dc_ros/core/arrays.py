"""The array type, and the namespace of the library that an array belongs to.

Code calls methods such as `values.sum(axis=-1)`, which numpy and torch share: on the fifty users of a node
they take half the time of numpy's functions. A mean is a sum divided by a number, with the same result on a
CPU.
"""

import importlib
from functools import lru_cache
from typing import Any, TypeAlias

import array_api_compat
import numpy as np

# numpy.ndarray or torch.Tensor. The array API standard has no type for both.
Array: TypeAlias = Any

# numpy 2 follows the standard itself. The wrapper for numpy 1 imports f2py: a tenth of a node's start.
_STANDARD: Any = np
if np.lib.NumpyVersion(np.__version__) < "2.0.0":
    _STANDARD = importlib.import_module("array_api_compat.numpy")


class _Numpy:
    """numpy's namespace, with methods of arrays in place of functions that call them in the end.

    On the arrays of a node such a function takes longer than what it calls.
    """

    def __getattr__(self, name: str) -> Any:
        found = getattr(_STANDARD, name)
        setattr(self, name, found)  # so that this is called once for each name
        return found

    @staticmethod
    def take(values: Array, indices: Array, axis: int) -> Array:
        return values.take(indices, axis)

    @staticmethod
    def astype(values: Array, dtype: Any) -> Array:
        return values.astype(dtype)

    @staticmethod
    def max(values: Array, axis: int, keepdims: bool = False) -> Array:
        return values.max(axis=axis, keepdims=keepdims)

    @staticmethod
    def min(values: Array, axis: int, keepdims: bool = False) -> Array:
        return values.min(axis=axis, keepdims=keepdims)

    @staticmethod
    def any(values: Array, axis: int, keepdims: bool = False) -> Array:
        return values.any(axis=axis, keepdims=keepdims)

    @staticmethod
    def argmax(values: Array, axis: int) -> Array:
        return values.argmax(axis=axis)

    @staticmethod
    def round(values: Array) -> Array:
        return values.round()

    @staticmethod
    def sort(values: Array, axis: int) -> Array:
        found = values.copy()
        found.sort(axis=axis)
        return found

    @staticmethod
    def full_like(values: Array, number: float) -> Array:
        found = np.empty(values.shape, values.dtype)
        found.fill(number)
        return found

    @staticmethod
    def zeros_like(values: Array) -> Array:
        return np.zeros(values.shape, values.dtype)

    @staticmethod
    def ones_like(values: Array) -> Array:
        return np.ones(values.shape, values.dtype)


_NUMPY = _Numpy()


def array_namespace(*arrays: Array) -> Any:
    """The array-API namespace of arrays of one library."""
    for array in arrays:  # a node calls this some twenty times a step: numpy's path is short
        if type(array) is not np.ndarray and not isinstance(array, np.generic):
            return array_api_compat.array_namespace(*arrays)
    return _NUMPY


class Numbers(tuple[Any, ...]):
    """Fixed numbers that are found by their identity: `constant` need not hash each of them."""

    __slots__ = ()
    __hash__ = object.__hash__
    __eq__ = object.__eq__


def constant(values: tuple[Any, ...] | range, like: Array) -> Array:
    """Fixed numbers as a read-only array with the library, device and dtype of `like`."""
    device = getattr(like, "device", None)  # which arrays of numpy 1 do not have
    return _constant(values, array_namespace(like), device, like.dtype)


@lru_cache(maxsize=256)
def _constant(values: tuple[Any, ...], xp: Any, device: Any, dtype: Any) -> Array:
    # Cached: a copy from the host at every step blocks a GPU.
    return xp.asarray(values, dtype=dtype, device=device)
