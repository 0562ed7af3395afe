"""Checks of the frame, the stamp and the values of stamped data."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from tfbus.data.dispatch import Stamped
from tfbus.frames import check_frame
from tfbus.geometry.rows import Vector
from tfbus.geometry.transform import Transform
from tfbus.stamps import LATEST, as_stamp


def construct(data: Any, *values: object) -> None:
    """Set the fields of a frozen dataclass, and check them: what its own ``__init__`` does.

    A class writes its ``__init__`` for the types of its arguments, which are wider than those of its fields.
    """
    # The fields of a subclass begin with those of its base.
    for name, value in zip(data.__match_args__, values, strict=False):
        object.__setattr__(data, name, value)
    data.__post_init__()


def check_header(data: Stamped) -> None:
    """Check the frame and the stamp of a frozen dataclass under construction; the stamp becomes a plain ``int``.

    Raises
    ------
    InvalidTransformError
        If the frame is empty or starts with ``/``.
    TypeError, ValueError
        If the stamp is neither `LATEST` nor an integer of 64 bits.
    """
    check_frame(data.frame)
    if data.stamp is not LATEST:
        object.__setattr__(data, "stamp", as_stamp(data.stamp))


def check_pose(pose: object) -> None:
    """Raise `TypeError` unless `pose` is a `Transform`."""
    if not isinstance(pose, Transform):
        raise TypeError(f"pose must be a Transform, not {pose!r}")


def as_triple(value: Any, name: str) -> Vector:
    """Three numbers as a tuple of floats; NaN and infinity are allowed, since sensors send them.

    Raises
    ------
    ValueError
        If there are not three. The message has the shape.
    TypeError
        If they are not numbers in a sequence or an array.
    """
    if isinstance(value, (str, bytes)) or not isinstance(value, (Sequence, np.ndarray)):
        raise TypeError(f"{name} must be three numbers, not {value!r}")
    shape = getattr(value, "shape", (len(value),))
    if shape != (3,):
        raise ValueError(f"{name} must be three numbers, got shape {shape}")
    try:
        for part in value:
            # `float` would read digits in a string.
            math.isnan(part)
    except TypeError:
        raise TypeError(f"{name} must be three numbers, not {value!r}") from None
    x, y, z = value
    return float(x), float(y), float(z)
