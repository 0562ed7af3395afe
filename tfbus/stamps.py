"""Instants and durations.

An instant is an ``int`` of nanoseconds, because a stamp is a key: 99.6 % of today's nanosecond stamps do not survive a
round trip through a float. A duration is a ``float`` of seconds, because nobody wants to type nine zeros.
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
"""Many stamps in ns."""


class Latest(Enum):
    """The type of `LATEST`."""

    LATEST = "LATEST"

    def __repr__(self) -> str:
        return "LATEST"


LATEST: Final = Latest.LATEST
"""Ask for the newest stamp that every moving edge on the path can answer."""


def from_seconds(seconds: float) -> int:
    """Nanoseconds in a number of seconds, rounded to the nearest.

    Parameters
    ----------
    seconds : float
        Seconds; an ``int`` is taken exactly, a ``float`` is converted without any error beyond its own.

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
    """The stamp that `value` is, as a plain ``int``.

    Raises
    ------
    TypeError
        If `value` is not an integer. A float is the usual mistake: convert it with `from_seconds`.
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
    """Many stamps as an array of shape (n,), in ns; an array that is one already is not copied.

    Raises
    ------
    TypeError
        If one is not an integer. Floats are the usual mistake: convert each with `from_seconds`.
    ValueError
        If the shape is not (n,), or one does not fit a signed 64-bit integer.
    """
    if isinstance(values, (list, tuple)):
        if set(map(type, values)) == {int}:
            try:
                return np.array(values, np.int64)
            except OverflowError:
                pass
        # In any other list, numpy would turn what stands beside an integer into one too, or all into floats.
        array = np.asarray(values, object)
    else:
        array = np.asarray(values)
    if array.ndim != 1:
        raise ValueError(f"stamps must have shape (n,), got {array.shape}")
    if array.dtype.kind not in "iu" or array.dtype == np.uint64:
        return np.array([as_stamp(value) for value in array.tolist()], np.int64)
    return array.astype(np.int64, copy=False)


def as_duration(seconds: float, name: str) -> float:
    """A duration in seconds that is neither negative nor NaN; infinity is allowed.

    Raises
    ------
    TypeError, ValueError
        If it is not a number, or negative or NaN. The message names `name` and the value.
    """
    if not is_real(seconds):
        raise TypeError(f"{name} must be a number of seconds, not {seconds!r}")
    if not seconds >= 0:
        raise ValueError(f"{name} must not be negative, got {seconds!r}")
    return float(seconds)


def is_real(value: object) -> bool:
    """Whether `value` is a real number of any type, numpy's included; a ``bool`` is none."""
    kind = type(value)
    # Nearly always one of these, and asking the abstract class takes ten times as long.
    return kind is float or kind is int or (isinstance(value, Real) and not isinstance(value, bool))


def format_stamp(stamp: int) -> str:
    """A stamp for people, exact: ``12.500 s``, ``12.500000001 s``."""
    sign = "-" if stamp < 0 else ""
    whole, rest = divmod(abs(stamp), SECOND)
    digits = f"{rest:09d}"
    return f"{sign}{whole}.{digits[:3]}{digits[3:].rstrip('0')} s"


def format_duration(nanoseconds: int) -> str:
    """A duration for people, three digits or so: ``410 ms``, ``1 ns``, ``2.5 s``."""
    size = abs(nanoseconds)
    for unit, name in ((SECOND, "s"), (1_000_000, "ms"), (1_000, "us")):
        if size >= unit:
            digits = f"{nanoseconds / unit:.0f}" if size >= 100 * unit else f"{nanoseconds / unit:.3g}"
            return f"{digits} {name}"
    return f"{nanoseconds} ns"
