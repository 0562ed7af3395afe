"""The fields of messages, whatever holds them: attributes or keys."""

from array import array
from collections.abc import Iterable, Mapping
from copy import copy
from typing import Any

import numpy as np

_MISSING = object()


def has(message: object, name: str) -> bool:
    """Whether a message has a field."""
    return name in message if isinstance(message, Mapping) else hasattr(message, name)


def get(message: object, *names: str) -> Any:
    """The field of a message, of that field, and so on.

    Raises
    ------
    TypeError
        If there is no such field.
    """
    value: Any = message
    for name in names:
        found = value.get(name, _MISSING) if isinstance(value, Mapping) else getattr(value, name, _MISSING)
        if found is _MISSING:
            raise TypeError(f"a {type(message).__name__} has no field {'.'.join(names)!r}")
        value = found
    return value


def numbers(message: object, names: Iterable[str]) -> tuple[float, ...]:
    """Some fields as floats."""
    return tuple(float(get(message, name)) for name in names)


def filled(like: Any, values: Mapping[str, Any]) -> Any:
    """A copy of a message with other values in some fields; fields that are mappings in `values` are copied likewise.

    Arrays and sequences become what is there: an ``array``, an array of numpy, bytes or a list.
    """
    result = copy(like)
    for name, value in values.items():
        old = get(like, name)
        new = filled(old, value) if isinstance(value, Mapping) else _as_kind(value, old)
        if isinstance(result, dict):
            result[name] = new
        else:
            setattr(result, name, new)
    return result


def _as_kind(value: Any, old: Any) -> Any:
    if isinstance(value, (bytes, np.ndarray)):
        if isinstance(old, array):
            return array(old.typecode, value if isinstance(value, bytes) else value.ravel().tolist())
        if isinstance(old, np.ndarray):
            found = np.frombuffer(value, np.uint8) if isinstance(value, bytes) else value.ravel()
            return found.astype(old.dtype)
        if isinstance(value, np.ndarray):
            return value.ravel().tolist()
    return value
