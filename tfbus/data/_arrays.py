"""Checks and pickling of the arrays in stamped data."""

from collections.abc import Callable
from dataclasses import fields
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from tfbus.stamps import as_array


def as_floats(value: npt.ArrayLike, name: str) -> npt.NDArray[Any]:
    """An array of floats: an array of floats is not copied, integers become float64.

    Raises
    ------
    TypeError
        If they are not numbers. The message names `name` and the dtype.
    ValueError
        If one is masked.
    """
    array = as_array(value, name)
    if array.dtype.kind in "iu":
        return array.astype(np.float64)
    if array.dtype.kind != "f":
        raise TypeError(f"{name} must be numbers, not of dtype {array.dtype}")
    return array


def as_points(value: npt.ArrayLike) -> npt.NDArray[Any]:
    """Points as an array of shape (n, 3) of floats, converted by `as_floats`.

    Raises
    ------
    ValueError
        If the shape is another. The message has the shape.
    TypeError
        If they are not numbers.
    """
    array = as_floats(value, "points")
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(f"points must have shape (n, 3), got {array.shape}")
    return array


class CopiedByFields:
    """A base of dataclasses: copies and unpickled objects are built from the fields, so that arrays are read-only."""

    __slots__ = ()

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        values = {field.name: getattr(self, field.name) for field in fields(self)}  # type: ignore[arg-type]
        for name, value in values.items():
            if isinstance(value, MappingProxyType):
                values[name] = dict(value)
        return _build, (type(self), values)


def _build(kind: type, values: dict[str, Any]) -> Any:
    return kind(**values)
