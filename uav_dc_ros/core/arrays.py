"""The array type, and the one place that asks which library an array belongs to."""

from typing import Any, TypeAlias

from array_api_compat import array_namespace, device

# numpy.ndarray or torch.Tensor. The array API standard has no type to name them both.
Array: TypeAlias = Any

__all__ = ["Array", "array_namespace", "constant"]


def constant(values: Any, like: Array) -> Array:
    """`values` as an array of the library and on the device of `like`."""
    return array_namespace(like).asarray(values, device=device(like))
