"""Stamps, durations, dates and their texts."""

import copy
import math
import pickle
from array import array
from collections.abc import Callable
from datetime import UTC, datetime, timedelta, timezone
from decimal import Decimal
from fractions import Fraction
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.strategies import TODAY, stamps

from tfbus import LATEST, SECOND, from_seconds, to_seconds
from tfbus.stamps import (
    STAMP_MAX,
    STAMP_MIN,
    as_at,
    as_duration,
    as_stamp,
    as_stamps,
    format_age,
    format_duration,
    format_stamp,
    likely_cause,
    time_between,
)

HUGE = pytest.param(10**400, id="huge")
UNITS = {"ns": 1, "us": 10**3, "ms": 10**6, "s": SECOND}
DAY = 86_400 * SECOND
LONG_UNITS = {"m": 60 * SECOND, "h": 3_600 * SECOND, "D": DAY, "W": 7 * DAY}


@given(st.floats(-9e9, 9e9))
def test_a_float_of_seconds_becomes_the_nearest_nanosecond(seconds: float) -> None:
    exact = Fraction(seconds) * SECOND
    assert abs(from_seconds(seconds) - exact) <= Fraction(1, 2) + Fraction(1, 10**6)


@given(st.integers(-(4 * 10**15), 4 * 10**15))
def test_stamps_of_the_first_46_days_survive_a_round_trip_through_seconds(stamp: int) -> None:
    assert from_seconds(to_seconds(stamp)) == stamp


def test_a_stamp_of_today_does_not_survive_a_float() -> None:
    assert from_seconds(to_seconds(TODAY + 1)) == TODAY


@given(stamps())
def test_to_seconds_gives_the_nearest_float(stamp: int) -> None:
    seconds = to_seconds(stamp)
    exact = Fraction(stamp, SECOND)
    error = abs(Fraction(seconds) - exact)
    assert error <= abs(Fraction(math.nextafter(seconds, math.inf)) - exact)
    assert error <= abs(Fraction(math.nextafter(seconds, -math.inf)) - exact)


@pytest.mark.parametrize("seconds", [math.nan, math.inf, -math.inf, 9.3e9, -9.3e9, 1e300, HUGE])
def test_seconds_that_no_stamp_can_hold_are_a_value_error(seconds: float) -> None:
    with pytest.raises(ValueError, match=r"finite|64-bit"):
        from_seconds(seconds)


@given(st.integers(-(2**31), 2**31 - 1), st.integers(0, 2**32 - 1))
def test_seconds_and_nanoseconds_of_a_message_are_converted_exactly(seconds: int, nanoseconds: int) -> None:
    assert from_seconds(seconds, nanoseconds) == seconds * SECOND + nanoseconds


@pytest.mark.parametrize("seconds", [0.5, -0.5, 12.25])
def test_nanoseconds_are_added_to_the_rounded_seconds(seconds: float) -> None:
    assert from_seconds(seconds, 7) == round(seconds * SECOND) + 7


@pytest.mark.parametrize(
    ("seconds", "nanoseconds", "beyond"), [(9_223_372_036, 854_775_807, 1), (-9_223_372_036, -854_775_808, -1)]
)
def test_nanoseconds_may_not_leave_64_bits(seconds: int, nanoseconds: int, beyond: int) -> None:
    assert from_seconds(seconds, nanoseconds) in (STAMP_MIN, STAMP_MAX)
    with pytest.raises(ValueError, match="64-bit"):
        from_seconds(seconds, nanoseconds + beyond)


@pytest.mark.parametrize(
    "value",
    [0, -1, STAMP_MIN, STAMP_MAX, np.int64(7), np.uint8(7), np.array(7), np.int64(STAMP_MIN), np.uint64(STAMP_MAX)],
)
def test_any_integer_is_a_stamp_and_becomes_a_plain_int(value: Any) -> None:
    stamp = as_stamp(value)
    assert type(stamp) is int
    assert stamp == int(value)


def test_an_instant_that_is_asked_for_may_be_latest_or_none() -> None:
    assert (as_at(LATEST), as_at(None), as_at(7)) == (LATEST, None, 7)
    assert (type(as_at(np.int64(7))), as_at(np.datetime64(7, "s"))) == (int, 7 * SECOND)
    with pytest.raises(TypeError, match="from_seconds"):
        as_at(1.5)  # type: ignore[call-overload]


NO_INTEGER = "int of nanoseconds"
NO_STAMPS = [
    *[pytest.param(value, TypeError, "from_seconds") for value in (1.5, math.nan, np.float64(1.5))],
    *[pytest.param(value, TypeError, NO_INTEGER) for value in (None, "1", True, np.True_, Fraction(1), LATEST, [1])],
    *[pytest.param(value, TypeError, NO_INTEGER) for value in (Decimal(1), np.float32(1))],
    *[pytest.param(value, ValueError, "64-bit") for value in (-(2**63) - 1, 2**63, 10**30, np.uint64(2**63))],
]


@pytest.mark.parametrize(("value", "error", "problem"), NO_STAMPS)
def test_a_value_that_is_no_integer_of_64_bits_is_an_error_alone_and_among_others(
    value: Any, error: type[Exception], problem: str
) -> None:
    with pytest.raises(error, match=problem):
        as_stamp(value)
    for values in ([value, 5], [5, value], (5, value, 6)):
        with pytest.raises(error, match=r"int of nanoseconds|64-bit"):
            as_stamps(values)


@pytest.mark.parametrize(
    ("values", "error", "problem"),
    [
        *[(np.array([1, 0]).astype(kind), TypeError, NO_INTEGER) for kind in ("f8", "f4", "?", "c16", "m8[s]", "U3")],
        (np.array([0, 2**63], np.uint64), ValueError, "64-bit"),
        *[
            (values, ValueError, r"shape \(n,\), got \(")
            for values in (5, [[5], [6]], np.zeros((2, 0), int), np.array(5))
        ],
    ],
)
def test_an_array_of_another_type_or_shape_is_an_error(values: Any, error: type[Exception], problem: str) -> None:
    with pytest.raises(error, match=problem):
        as_stamps(values)


@pytest.mark.parametrize("value", [0, 0.0, 1, 2.5, math.inf])
def test_a_duration_is_a_float_that_may_be_infinite(value: float) -> None:
    assert (type(as_duration(value, "timeout")), as_duration(value, "timeout")) == (float, value)


@pytest.mark.parametrize("value", [-1e-9, -1, -math.inf, math.nan])
def test_a_negative_duration_is_a_value_error_that_names_the_argument(value: float) -> None:
    with pytest.raises(ValueError, match=rf"keep .*{value!r}"):
        as_duration(value, "keep")


@pytest.mark.parametrize("value", [None, "1", True, LATEST, [1.0], 1j])
def test_seconds_that_are_no_number_are_a_type_error(value: Any) -> None:
    with pytest.raises(TypeError, match="keep must be a number of seconds"):
        as_duration(value, "keep")
    for arguments in ((value,), (1, "1"), (1, 0.5)):
        with pytest.raises(TypeError, match="seconds must be a"):
            from_seconds(*arguments)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (format_stamp, {12_500_000_000: "12.500 s", 0: "0.000 s", -1: "-0.000000001 s", 1_000_100_000: "1.0001 s"}),
        (format_duration, {0: "0 ns", 999: "999 ns", 1_500: "1.5 us", 999_999: "1000 us", -410_000_000: "-410 ms"}),
        (format_duration, {3_600 * SECOND: "3600 s", 2 * DAY - 1: "172800 s", 2 * DAY: "2 days"}),
        (lambda age: format_age(100, 100 + age), {-2_500_000_000: "2.5 s ahead", -1: "1 ns ahead", 0: "age 0 ns"}),
    ],
)
def test_texts_of_stamps_durations_and_ages(text: Callable[[int], str], expected: dict[int, str]) -> None:
    assert {number: text(number) for number in expected} == expected


# 2020-02-29 12:00:00 UTC is 18,321.5 days after the epoch.
NOON = 1_582_977_600 * SECOND
DATES = [
    pytest.param(np.datetime64("2020-02-29T12"), NOON, id="h"),
    pytest.param(np.datetime64("2020-02-29T12:00"), NOON, id="m"),
    pytest.param(np.datetime64("2020-02-29T12:00:00"), NOON, id="s"),
    pytest.param(np.datetime64("2020-02-29T12:00:00.001"), NOON + 1_000_000, id="ms"),
    pytest.param(np.datetime64("2020-02-29T12:00:00.000001"), NOON + 1_000, id="us"),
    pytest.param(np.datetime64("2020-02-29T12:00:00.000000001"), NOON + 1, id="ns"),
    pytest.param(np.datetime64("2020-02-29"), NOON - SECOND * 43_200, id="D"),
    pytest.param(np.datetime64("2020-02"), NOON - SECOND * (43_200 + 28 * 86_400), id="M"),
    pytest.param(np.datetime64("2020"), NOON - SECOND * (43_200 + 59 * 86_400), id="Y"),
    pytest.param(np.datetime64(2617, "W"), SECOND * 2617 * 7 * 86_400, id="W"),
    pytest.param(np.datetime64(-1, (b"s", 25)), -25 * SECOND, id="25 s"),
    pytest.param(np.datetime64(-1, "ps"), -1, id="ps"),
    pytest.param(np.datetime64(1_999_999, "fs"), 1, id="fs"),
    pytest.param(np.datetime64(2 * SECOND, "as"), 2, id="as"),
    pytest.param(np.datetime64("2262-04"), 9_222_422_400 * SECOND, id="last month"),
    pytest.param(np.datetime64("1677-10"), -106_742 * DAY, id="first month"),
    # 1972 to 2260 are 73 leap years but for 2100 and 2200; 1680 to 1968 but for 1700, 1800 and 1900.
    pytest.param(np.datetime64("2262"), (292 * 365 + 71) * DAY, id="last year"),
    pytest.param(np.datetime64("1678"), -(292 * 365 + 70) * DAY, id="first year"),
    pytest.param(datetime(2020, 2, 29, 12, microsecond=1, tzinfo=UTC), NOON + 1_000, id="datetime"),
    pytest.param(datetime(2020, 2, 29, 13, tzinfo=timezone(timedelta(hours=1))), NOON, id="east of UTC"),
]


@pytest.mark.parametrize(("date", "stamp"), DATES)
def test_a_date_is_a_stamp_and_becomes_a_plain_int(date: datetime | np.datetime64, stamp: int) -> None:
    assert type(as_stamp(date)) is int
    assert as_stamp(date) == stamp
    for dates in ([date, date], np.array([date, date])):
        stamps = as_stamps(dates)
        assert stamps.dtype == np.int64
        assert stamps.tolist() == [stamp, stamp]


@pytest.mark.parametrize(("unit", "size"), [*UNITS.items(), *LONG_UNITS.items()])
def test_the_last_date_of_each_unit_is_a_stamp_and_the_next_is_beyond_64_bits(unit: Any, size: int) -> None:
    last = STAMP_MAX // size
    for ticks in (-last, last):
        assert as_stamp(np.datetime64(ticks, unit)) == ticks * size
    for ticks in (-last - 1, last + 1) if size > 1 else ():
        with pytest.raises(ValueError, match="64-bit"):
            as_stamp(np.datetime64(ticks, unit))


@pytest.mark.parametrize(
    "convert", [as_stamp, lambda date: as_stamps([date]), lambda date: as_stamps(np.array([date]))]
)
@pytest.mark.parametrize(
    ("date", "problem"),
    [
        (datetime(2020, 1, 1), r"no time zone: use .replace\(tzinfo=datetime.UTC\) .* or .astimezone\(\)"),
        (datetime.max.replace(tzinfo=UTC), "64-bit"),
        (np.datetime64("NaT", "ns"), "not NaT"),
        (np.datetime64("2262-05"), "64-bit"),
        (np.datetime64("1677-09-21T00:12:43"), "64-bit"),
        (np.datetime64("9999-01"), r"'9999-01'.* 64-bit"),
        (np.datetime64(2**62, "Y"), "64-bit"),
        (np.datetime64(1, (b"W", 2**31 - 1)), "64-bit"),
    ],
)
def test_a_date_that_is_no_stamp_is_a_value_error(convert: Any, date: datetime | np.datetime64, problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        convert(date)


def test_a_timestamp_of_pandas_keeps_its_nanoseconds() -> None:
    pandas = pytest.importorskip("pandas")
    index = pandas.DatetimeIndex(np.array([NOON, NOON + 1], "M8[ns]"))
    for dates in (
        index,
        index.tz_localize("UTC"),
        index.tz_localize("UTC").tz_convert("Asia/Tokyo"),
        index.to_series(),
    ):
        assert as_stamps(dates).tolist() == [NOON, NOON + 1]
        assert [as_stamp(date) for date in dates] == [NOON, NOON + 1]
    with pytest.raises(ValueError, match="not NaT"):
        as_stamp(pandas.NaT)


@given(stamps())
def test_the_text_of_a_stamp_is_exact(stamp: int) -> None:
    number, unit = format_stamp(stamp).split(" ")
    assert unit == "s"
    assert Fraction(number) * SECOND == stamp


@given(st.integers(-(2**64), 2**64))
def test_the_text_of_a_duration_has_three_correct_digits(nanoseconds: int) -> None:
    number, unit = format_duration(nanoseconds).split(" ")
    size = {**UNITS, "days": DAY, "years": 365 * DAY}[unit]
    assert abs(Fraction(number) * size - nanoseconds) <= abs(Fraction(nanoseconds)) * Fraction(5, 1000)


WALL = 1_795_560_204 * SECOND
SIMULATED = 3_617 * SECOND


def test_the_text_of_an_age_of_years_names_the_likely_cause() -> None:
    assert format_age(WALL // SECOND, WALL) == "age 56.9 years, seconds passed as nanoseconds?"
    assert format_age(WALL, SIMULATED).startswith("56.9 years ahead, these look like two clocks (")


@pytest.mark.parametrize(
    ("stamp", "now", "words"),
    [
        (WALL // SECOND - 60, WALL, "seconds passed as nanoseconds?"),
        (WALL // 10**6, WALL + 3_600 * SECOND, "milliseconds passed as nanoseconds?"),
        (WALL // 1_000 + 5, WALL, "microseconds passed as nanoseconds?"),
        (100, 104 * SECOND, "seconds passed as nanoseconds?"),
        (100_000, 104 * SECOND, "milliseconds passed as nanoseconds?"),
        (SIMULATED, WALL, "two clocks (simulated time and wall time?)"),
        (WALL - 12 * 365 * DAY, WALL, "two clocks (simulated time and wall time?)"),
        (0, WALL, "a stamp that was never set?"),
    ],
)
def test_the_likely_cause_is_named_whichever_of_two_stamps_is_the_wrong_one(stamp: int, now: int, words: str) -> None:
    assert words in likely_cause(stamp, now)
    assert likely_cause(now, stamp) == likely_cause(stamp, now)


@pytest.mark.parametrize(
    ("stamp", "now"),
    [
        (WALL - 180 * SECOND, WALL),
        (WALL - 30 * DAY, WALL),
        (0, SIMULATED),
        (SECOND // 10, 100 * SECOND),
        (SECOND, 1_000 * SECOND),
        (-5, 5),
        (0, 0),
        (5, 5),
    ],
)
def test_no_cause_is_named_of_late_data_and_of_two_stamps_of_one_simulation(stamp: int, now: int) -> None:
    assert likely_cause(stamp, now) == likely_cause(now, stamp) == ""


def test_latest_pickles_and_copies_as_itself() -> None:
    assert pickle.loads(pickle.dumps(LATEST)) is LATEST
    assert copy.deepcopy(LATEST) is LATEST
    assert repr(LATEST) == "LATEST"


# Many


@pytest.mark.parametrize(
    "values",
    [
        [5, -1, 5],
        (5, -1, 5),
        range(5, 8),
        [np.int8(5), 7],
        np.array([5, -1], np.int16),
        np.array([5, 200], np.uint8),
        np.array([5, 2**62], np.uint64),
        np.array([5, -1], ">i8"),
        np.array([5, -1], object),
        np.arange(10)[::-3],
        array("q", [5, -1]),
        [],
        np.array([]),
        [STAMP_MIN, STAMP_MAX],
    ],
)
def test_any_integers_become_an_array_of_stamps(values: Any) -> None:
    found = as_stamps(values)
    assert (found.dtype, found.shape) == (np.dtype(np.int64), (len(values),))
    assert found.tolist() == [int(value) for value in values]


@pytest.mark.parametrize("unit", ["ns", "s", "ms"])
def test_a_timedelta64_is_no_stamp_and_no_number_of_seconds(unit: Any) -> None:
    converts: tuple[Callable[[Any], object], ...] = (as_stamp, from_seconds, lambda value: as_duration(value, "keep"))
    for convert in converts:
        with pytest.raises(TypeError):
            convert(np.timedelta64(5, unit))
    forms: tuple[Any, ...] = [np.timedelta64(5, unit)], np.array([5], f"m8[{unit}]")
    for values in forms:
        with pytest.raises(TypeError, match="a stamp is an int of nanoseconds, not"):
            as_stamps(values)


def test_stamps_with_a_mask_are_refused_if_one_is_masked() -> None:
    values = np.ma.array([1, 2, 3], mask=[False, True, True])
    with pytest.raises(ValueError, match="stamps must have no masked values, got 2"):
        as_stamps(values)
    with pytest.raises(ValueError, match="stamps must have no masked values, got 1"):
        as_stamps(cast(Any, [1, np.ma.masked]))
    assert as_stamps(values[:1]).tolist() == [1]
    assert as_stamps(values.compressed()).tolist() == [1]


@given(st.lists(st.tuples(stamps(), stamps()), min_size=1))
def test_the_time_between_two_stamps_is_exact_as_long_as_it_fits_64_bits(pairs: list[tuple[int, int]]) -> None:
    earlier, later = np.array(pairs, np.int64).T
    exact = [max(-STAMP_MAX, min(end - begin, STAMP_MAX)) for begin, end in pairs]
    assert time_between(earlier, later).tolist() == exact
