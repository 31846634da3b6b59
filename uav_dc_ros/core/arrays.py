"""The array type, and the one place that asks which library an array belongs to.

A node works on one world: fifty users, for which the call costs more than the numbers. So sums and the
like are asked of the array, `values.sum(axis=-1)`, which numpy and torch spell alike and which takes half
the time of numpy's function. A mean is a sum divided by a number, which on a CPU is what both compute.
"""

import importlib
from functools import lru_cache
from typing import Any, TypeAlias

import array_api_compat
import numpy as np

# numpy 2 speaks the standard itself. The wrapper for numpy 1 brings f2py along, a tenth of a node's start.
_NUMPY: Any = np
if np.lib.NumpyVersion(np.__version__) < "2.0.0":
    _NUMPY = importlib.import_module("array_api_compat.numpy")

# numpy.ndarray or torch.Tensor. The array API standard has no type to name them both.
Array: TypeAlias = Any


def array_namespace(*arrays: Array) -> Any:
    """The array-API namespace of some arrays of one library."""
    # A node asks some twenty times a step: the likeliest answer is worth a short way.
    for array in arrays:
        if type(array) is not np.ndarray:
            return array_api_compat.array_namespace(*arrays)
    return _NUMPY


def constant(values: tuple[Any, ...] | range, like: Array, dtype: Any = None) -> Array:
    """Fixed `values` as an array of the library and on the device of `like`; not to be written to.

    Args:
        values: numbers, or tuples of them, of equal lengths.
        like: an array whose library and device the result takes.
        dtype: type of the result; that of `like` unless told.
    """
    device = getattr(like, "device", None)  # which arrays of numpy 1 do not have
    return _constant(values, array_namespace(like), device, like.dtype if dtype is None else dtype)


@lru_cache(maxsize=256)
def _constant(values: tuple[Any, ...], xp: Any, device: Any, dtype: Any) -> Array:
    # Kept, since a copy from the host at every step would make a GPU wait for it.
    return xp.asarray(values, dtype=dtype, device=device)
