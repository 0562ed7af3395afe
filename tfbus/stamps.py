"""Stamps in nanoseconds and durations in seconds.

A stamp is an ``int`` of nanoseconds, because it is a key: 99.6 % of today's stamps change in a round trip through a
float. A duration is a ``float`` of seconds, because it is easier to write and read.
"""

import math
import operator
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from enum import Enum
from numbers import Real
from typing import Any, Final, SupportsIndex, TypeAlias, cast, overload

import numpy as np
import numpy.typing as npt

SECOND: Final = 1_000_000_000
"""Nanoseconds in a second."""

STAMP_MIN: Final = -(2**63)
STAMP_MAX: Final = 2**63 - 1

StampLike: TypeAlias = SupportsIndex | np.datetime64 | datetime
"""The types that `as_stamp` accepts; a ``pandas.Timestamp`` is a ``datetime``."""

StampsLike: TypeAlias = npt.ArrayLike | Sequence[StampLike]
"""The types that `as_stamps` accepts."""

Stamps = npt.NDArray[np.int64]
"""An array of stamps in ns, shape (n,)."""

Place = tuple[int, int, Any]
"""The place of a parked lookup in a sorted list: -stamp, -order, and the lookup."""

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_DAY = 86_400 * SECOND
_YEAR = 365 * _DAY
_UNITS = {
    "Y": _YEAR,
    "M": 28 * _DAY,
    "W": 7 * _DAY,
    "D": _DAY,
    "h": 3_600 * SECOND,
    "m": 60 * SECOND,
    "s": SECOND,
    "ms": 1_000_000,
    "us": 1_000,
}
"""The units of datetime64 of more than a nanosecond, in ns; years and months at their shortest."""
_PARTS = {"ps": 1_000, "fs": 1_000_000, "as": SECOND}
"""The number of the finer units in a nanosecond."""


class Latest(Enum):
    """The type of `LATEST`.

    Examples
    --------
    >>> tree = TransformTree()
    >>> _ = tree.insert(TransformStamped("map", "cart", 10, Transform()))
    >>> tree.lookup("map", "cart", LATEST).stamp
    10
    """

    LATEST = "LATEST"

    def __repr__(self) -> str:
        return "LATEST"


LATEST: Final = Latest.LATEST
"""In place of a stamp: the newest stamp that every moving edge on the path can answer."""


AtLike: TypeAlias = StampLike | Latest
"""The types of an instant in a question: the types that `as_stamp` accepts, and `LATEST`."""


def from_seconds(seconds: float, nanoseconds: SupportsIndex = 0) -> int:
    """Nanoseconds in a number of seconds, rounded to the nearest.

    Parameters
    ----------
    seconds : float
        An ``int`` is converted exactly, a ``float`` to the nanosecond nearest to its exact value.
    nanoseconds : int
        Added to the result, so that ``from_seconds(stamp.sec, stamp.nanosec)`` is exactly the stamp of a ROS message.

    Raises
    ------
    TypeError
        If `seconds` is not a number, or `nanoseconds` not an integer.
    ValueError
        If `seconds` is not finite, or the result does not fit a signed 64-bit integer.

    Examples
    --------
    >>> from_seconds(1.5)
    1500000000
    >>> from_seconds(1396293888, 53123456)
    1396293888053123456
    """
    if not is_real(seconds):
        raise TypeError(f"seconds must be a number, not {seconds!r}")
    if not -math.inf < seconds < math.inf:
        raise ValueError(f"seconds must be finite, not {seconds!r}")
    try:
        rest = operator.index(nanoseconds)
    except TypeError:
        raise TypeError(f"nanoseconds must be an int, not {nanoseconds!r}") from None
    whole = math.floor(seconds)
    stamp = whole * SECOND + round((seconds - whole) * SECOND) + rest
    if not STAMP_MIN <= stamp <= STAMP_MAX:
        raise ValueError(f"{seconds!r} s does not fit a stamp of 64-bit nanoseconds")
    return stamp


def to_seconds(stamp: int) -> float:
    """Seconds in a number of nanoseconds, as the nearest float (not exact for today's stamps).

    Examples
    --------
    >>> to_seconds(12_500_000_000)
    12.5
    """
    return stamp / SECOND


def as_stamp(value: object) -> int:
    """Convert `value` to a stamp, a plain ``int`` of nanoseconds.

    Parameters
    ----------
    value : int, datetime64, Timestamp of pandas, or datetime with a time zone
        A ``datetime64``, as well as a ``Timestamp`` without a time zone, is in UTC. A part of a nanosecond is cut off.

    Raises
    ------
    TypeError
        If `value` is of another type. The usual mistake is a float of seconds: convert it with `from_seconds`.
    ValueError
        If it does not fit a signed 64-bit integer, is not a time (NaT), or is a ``datetime`` without a time zone.
    """
    if type(value) is int and STAMP_MIN <= value <= STAMP_MAX:
        return value
    if isinstance(value, (datetime, np.datetime64)):
        return _from_date(value)
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


@overload
def as_at(value: AtLike) -> int | Latest: ...
@overload
def as_at(value: AtLike | None) -> int | Latest | None: ...
def as_at(value: AtLike | None) -> int | Latest | None:
    """As `as_stamp`, for an instant in a question: `LATEST` and None stay."""
    return value if type(value) is int or value is None or isinstance(value, Latest) else as_stamp(value)


def as_stamps(values: StampsLike) -> Stamps:
    """Convert all values to stamps, an int64 array of shape (n,), in ns.

    An int64 array is returned without a copy.

    Parameters
    ----------
    values : sequence or array of shape (n,)
        Integers, or anything else that `as_stamp` converts; a ``DatetimeIndex`` of pandas too.

    Raises
    ------
    TypeError
        If a value has another type. The usual mistake is a float of seconds: convert it with `from_seconds`.
    ValueError
        If the shape is not (n,), a value is masked, or `as_stamp` refuses it.
    """
    if isinstance(values, (list, tuple)):
        if set(map(type, values)) == {int}:
            try:
                return np.array(values, np.int64)
            except OverflowError:
                pass
        # numpy would convert a bool beside an int to an int, and all integers beside a float to floats.
        array = as_array(values, "stamps", object)
    elif getattr(getattr(values, "dtype", None), "tz", None) is not None:
        # Dates of pandas with a time zone; `numpy.asarray` would make an object of each.
        array = cast(Any, values).to_numpy("M8[ns]")
    else:
        array = as_array(values, "stamps")
    if array.ndim != 1:
        raise ValueError(f"stamps must have shape (n,), got {array.shape}")
    if array.dtype.kind == "M":
        return _from_dates(array)
    if array.dtype.kind == "m":
        raise TypeError(
            "a stamp is an int of nanoseconds, not a timedelta64: add it to the instant that it counts from"
        )
    if array.dtype.kind not in "iu" or array.dtype == np.uint64:
        return np.array([as_stamp(value) for value in array.tolist()], np.int64)
    return array.astype(np.int64, copy=False)


def as_array(values: object, name: str, dtype: npt.DTypeLike | None = None) -> npt.NDArray[Any]:
    """The array that `numpy.asarray` makes of values; masked values are refused, because it would drop their mask.

    Raises
    ------
    ValueError
        If a value is masked. The message has `name`.
    """
    if type(values) is not np.ndarray:
        parts = values if isinstance(values, (list, tuple)) else (values,)
        masks = (np.ma.getmaskarray(part) for part in parts if isinstance(part, np.ma.MaskedArray))
        masked = sum(int(mask.sum()) for mask in masks)
        if masked:
            raise ValueError(
                f"{name} must have no masked values, got {masked}: leave these out, or use .filled(numpy.nan) where a "
                "missing number is NaN"
            )
    return np.asarray(cast(Any, values), dtype)


def time_between(earlier: Stamps, later: Stamps) -> Stamps:
    """The time from one stamp to another, elementwise, in ns; a time beyond 64 bits becomes the longest within.

    It is negative where `later` is before `earlier`. The limit is 292 years.
    """
    time: Stamps = later - earlier
    # The difference of two stamps has overflowed if its sign contradicts their order.
    wrong = (time < 0) != (later < earlier)
    if wrong.any():
        time = np.where(wrong, np.where(later < earlier, -STAMP_MAX, STAMP_MAX), time)
    return time.clip(-STAMP_MAX)


def _from_date(date: datetime | np.datetime64) -> int:
    # A Timestamp of pandas has nanoseconds, which its methods as a datetime cut off.
    exact = getattr(date, "to_datetime64", None)
    if isinstance(date, datetime) and exact is None:
        if date.tzinfo is None:
            raise ValueError(
                f"{date!r} has no time zone: use .replace(tzinfo=datetime.UTC) if it is in UTC, or .astimezone() if it "
                "is in local time"
            )
        return as_stamp((date - _EPOCH) // timedelta(microseconds=1) * 1_000)
    return int(_from_dates(np.array([date if exact is None else exact()], "M8"))[0])


def _from_dates(dates: npt.NDArray[Any]) -> Stamps:
    """The stamps of an array of datetime64 of any unit."""
    if np.isnat(dates).any():
        raise ValueError("a stamp is a time, not NaT")
    unit, count = np.datetime_data(dates.dtype)
    ticks = dates.astype(np.int64)
    if unit in _PARTS:
        return np.array([tick * count // _PARTS[unit] for tick in ticks.tolist()], np.int64)
    size = _UNITS.get(unit, 1) * count
    beyond = np.abs(ticks) > STAMP_MAX // size
    if beyond.any():
        raise ValueError(f"{dates[beyond][0]!r} does not fit a stamp of 64-bit nanoseconds")
    # Months and years have no fixed length.
    return _from_dates(dates.astype("M8[D]")) if unit in ("Y", "M") else ticks * min(size, STAMP_MAX)


def as_duration(seconds: float, name: str) -> float:
    """Check that `seconds` is a duration, and return it as a ``float``; infinity is allowed.

    Raises
    ------
    TypeError
        If it is not a real number. The message has `name`, the name of the argument, and the value.
    ValueError
        If it is negative or NaN, or an integer beyond all floats.
    """
    if type(seconds) is float and seconds >= 0.0:
        return seconds
    if not is_real(seconds):
        raise TypeError(f"{name} must be a number of seconds, not {seconds!r}")
    if not seconds >= 0:
        raise ValueError(f"{name} must not be negative, got {seconds!r}")
    try:
        return float(seconds)
    except OverflowError:
        raise ValueError(f"{name} must be a number of seconds that a float can hold") from None


_LARGEST_OFFSET = 1e9


def as_offset(seconds: float) -> int:
    """Nanoseconds that are added to the stamps of a source.

    Raises
    ------
    TypeError
        If it is not a real number.
    ValueError
        If it is not finite, or beyond a thousand million s.
    """
    if not is_real(seconds):
        raise TypeError(f"offset must be a number of seconds, not {seconds!r}")
    if not abs(seconds) <= _LARGEST_OFFSET:
        raise ValueError(f"offset must be {_LARGEST_OFFSET:g} s at most, ahead or behind, got {seconds!r}")
    return from_seconds(seconds)


def is_real(value: object) -> bool:
    """Whether `value` is a real number of any type, also of numpy; ``bool`` and ``timedelta64`` do not count."""
    kind = type(value)
    # The usual types first: the check of the abstract class takes ten times as long.
    return kind is float or kind is int or (isinstance(value, Real) and not isinstance(value, (bool, np.timedelta64)))


def format_seconds(nanoseconds: int) -> str:
    """Nanoseconds as seconds with all nine decimals."""
    whole, rest = divmod(abs(nanoseconds), SECOND)
    return f"{'-' if nanoseconds < 0 else ''}{whole}.{rest:09d}"


def format_stamp(stamp: int) -> str:
    """The exact text of a stamp, in seconds: ``12.500 s``, ``12.500000001 s``.

    Examples
    --------
    >>> format_stamp(from_seconds(12.5))
    '12.500 s'
    """
    sign = "-" if stamp < 0 else ""
    whole, rest = divmod(abs(stamp), SECOND)
    digits = f"{rest:09d}"
    return f"{sign}{whole}.{digits[:3]}{digits[3:].rstrip('0')} s"


def format_duration(nanoseconds: int) -> str:
    """The text of a duration with about three digits: ``410 ms``, ``1 ns``, ``2.5 s``, ``56.9 years``."""
    size = abs(nanoseconds)
    for unit, name in ((_YEAR, "years"), (_DAY, "days")):
        if size >= 2 * unit:
            return f"{nanoseconds / unit:.3g} {name}"
    for unit, name in ((SECOND, "s"), (1_000_000, "ms"), (1_000, "us")):
        if size >= unit:
            digits = f"{nanoseconds / unit:.0f}" if size >= 100 * unit else f"{nanoseconds / unit:.3g}"
            return f"{digits} {name}"
    return f"{nanoseconds} ns"


def format_age(stamp: int, now: int) -> str:
    """The text of the age of a stamp at `now`, with the likely cause if it is far off; both are in ns.

    It is ``age 410 ms``, or ``2.5 s ahead`` if the stamp is ahead, or ``age 56.9 years, seconds passed as
    nanoseconds?``.
    """
    age = f"{format_duration(stamp - now)} ahead" if stamp > now else f"age {format_duration(now - stamp)}"
    cause = likely_cause(stamp, now)
    return f"{age}, {cause}" if cause else age


def likely_cause(stamp: int, other: int) -> str:
    """The likely cause, in words, if two stamps (ns) that should be near each other are far apart; else empty.

    Examples
    --------
    >>> likely_cause(1_700_000_000, 1_700_000_000_000_000_000)
    'seconds passed as nanoseconds?'
    >>> likely_cause(3_617 * SECOND, 1_700_000_000 * SECOND)
    'these look like two clocks (simulated time and wall time?)'
    """
    small, large = sorted((stamp, other), key=abs)
    is_far = abs(large - small) > _YEAR
    # A stamp of simulated time may well be a thousandth of another stamp, unless it is so early.
    if small != 0 and (is_far or abs(small) < 1_000_000):
        for name, unit in (("seconds", SECOND), ("milliseconds", 1_000_000), ("microseconds", 1_000)):
            if abs(large - small * unit) <= min(_DAY, abs(large) // 10):
                return f"{name} passed as nanoseconds?"
    if not is_far:
        return ""
    return "these look like two clocks (simulated time and wall time?)" if small else "a stamp that was never set?"
