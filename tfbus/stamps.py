"""Stamps in nanoseconds and durations in seconds.

A stamp is an ``int`` of nanoseconds, because it is a key: 99.6 % of today's stamps change in a round trip through a
float. A duration is a ``float`` of seconds, because it is easier to write and read.
"""

import math
import operator
from enum import Enum
from numbers import Real
from typing import Final

import numpy as np
import numpy.typing as npt

SECOND: Final = 1_000_000_000
"""Nanoseconds in a second."""

STAMP_MIN: Final = -(2**63)
STAMP_MAX: Final = 2**63 - 1

Stamps = npt.NDArray[np.int64]
"""An array of stamps in ns, shape (n,)."""


class Latest(Enum):
    """The type of `LATEST`."""

    LATEST = "LATEST"

    def __repr__(self) -> str:
        return "LATEST"


LATEST: Final = Latest.LATEST
"""In place of a stamp: the newest stamp that every moving edge on the path can answer."""


def from_seconds(seconds: float) -> int:
    """Nanoseconds in a number of seconds, rounded to the nearest.

    Parameters
    ----------
    seconds : float
        An ``int`` is converted exactly, a ``float`` to the nanosecond nearest to its exact value.

    Raises
    ------
    ValueError
        If `seconds` is not finite, or the result does not fit a signed 64-bit integer.
    """
    if not -math.inf < seconds < math.inf:
        raise ValueError(f"seconds must be finite, not {seconds!r}")
    whole = math.floor(seconds)
    stamp = whole * SECOND + round((seconds - whole) * SECOND)
    if not STAMP_MIN <= stamp <= STAMP_MAX:
        raise ValueError(f"{seconds!r} s does not fit a stamp of 64-bit nanoseconds")
    return stamp


def to_seconds(stamp: int) -> float:
    """Seconds in a number of nanoseconds, as the nearest float (not exact for today's stamps)."""
    return stamp / SECOND


def as_stamp(value: object) -> int:
    """Check that `value` is a stamp, and return it as a plain ``int``.

    Raises
    ------
    TypeError
        If `value` is not an integer. The usual mistake is a float of seconds: convert it with `from_seconds`.
    ValueError
        If it does not fit a signed 64-bit integer.
    """
    if type(value) is int and STAMP_MIN <= value <= STAMP_MAX:
        return value
    if isinstance(value, float):
        raise TypeError(f"a stamp is an int of nanoseconds, not the float {value!r}: use from_seconds({value!r})")
    if isinstance(value, bool):
        raise TypeError(f"a stamp is an int of nanoseconds, not {value!r}")
    try:
        stamp = operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        raise TypeError(f"a stamp is an int of nanoseconds, not {value!r} ({type(value).__name__})") from None
    if not STAMP_MIN <= stamp <= STAMP_MAX:
        raise ValueError(f"stamp {stamp} does not fit 64-bit nanoseconds")
    return stamp


def as_stamps(values: npt.ArrayLike) -> npt.NDArray[np.int64]:
    """Check that all values are stamps, and return them as an int64 array of shape (n,), in ns.

    An int64 array is returned without a copy.

    Raises
    ------
    TypeError
        If a value is not an integer. The usual mistake is a float of seconds: convert it with `from_seconds`.
    ValueError
        If the shape is not (n,), or a value does not fit a signed 64-bit integer.
    """
    if isinstance(values, (list, tuple)):
        if set(map(type, values)) == {int}:
            try:
                return np.array(values, np.int64)
            except OverflowError:
                pass
        # numpy would convert a bool beside an int to an int, and all integers beside a float to floats.
        array = np.asarray(values, object)
    else:
        array = np.asarray(values)
    if array.ndim != 1:
        raise ValueError(f"stamps must have shape (n,), got {array.shape}")
    if array.dtype.kind not in "iu" or array.dtype == np.uint64:
        return np.array([as_stamp(value) for value in array.tolist()], np.int64)
    return array.astype(np.int64, copy=False)


def as_duration(seconds: float, name: str) -> float:
    """Check that `seconds` is a duration, and return it as a ``float``; infinity is allowed.

    Raises
    ------
    TypeError
        If it is not a real number. The message has `name`, the name of the argument, and the value.
    ValueError
        If it is negative or NaN.
    """
    if not is_real(seconds):
        raise TypeError(f"{name} must be a number of seconds, not {seconds!r}")
    if not seconds >= 0:
        raise ValueError(f"{name} must not be negative, got {seconds!r}")
    return float(seconds)


def is_real(value: object) -> bool:
    """Whether `value` is a real number of any type, including those of numpy, and not a ``bool``."""
    kind = type(value)
    # Nearly always one of these; the check of the abstract class takes ten times as long.
    return kind is float or kind is int or (isinstance(value, Real) and not isinstance(value, bool))


def format_stamp(stamp: int) -> str:
    """The exact text of a stamp, in seconds: ``12.500 s``, ``12.500000001 s``."""
    sign = "-" if stamp < 0 else ""
    whole, rest = divmod(abs(stamp), SECOND)
    digits = f"{rest:09d}"
    return f"{sign}{whole}.{digits[:3]}{digits[3:].rstrip('0')} s"


def format_duration(nanoseconds: int) -> str:
    """The text of a duration with about three digits: ``410 ms``, ``1 ns``, ``2.5 s``."""
    size = abs(nanoseconds)
    for unit, name in ((SECOND, "s"), (1_000_000, "ms"), (1_000, "us")):
        if size >= unit:
            digits = f"{nanoseconds / unit:.0f}" if size >= 100 * unit else f"{nanoseconds / unit:.3g}"
            return f"{digits} {name}"
    return f"{nanoseconds} ns"


def format_age(nanoseconds: int) -> str:
    """The text of an age: ``age 410 ms``; or ``2.5 s ahead``, if it is negative."""
    if nanoseconds < 0:
        return f"{format_duration(-nanoseconds)} ahead"
    return f"age {format_duration(nanoseconds)}"
