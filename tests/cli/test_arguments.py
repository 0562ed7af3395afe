"""The types of arguments."""

from collections.abc import Callable
from typing import Any

import pytest
from cyclopts import App, CycloptsError
from hypothesis import given
from hypothesis import strategies as st

from tfbus.cli.arguments import (
    Backend,
    Duration,
    Flag,
    Instant,
    JsonFlag,
    Rate,
    Speed,
    Step,
    Time,
    UsageError,
    parse_seconds,
    parse_time,
)
from tfbus.cli.recordings import TopicOptions
from tfbus.stamps import format_seconds

LIMIT = 9_223_372_036 * 1_000_000_000


@pytest.mark.parametrize(
    ("text", "nanoseconds"),
    [
        ("0", 0),
        ("1.5", 1_500_000_000),
        ("-0.000000001", -1),
        ("1700000000.123456789", 1_700_000_000_123_456_789),
        ("1e3", 1_000_000_000_000),
        (" 2 ", 2_000_000_000),
        ("1.0000000000", 1_000_000_000),
    ],
)
def test_seconds_are_parsed_exactly(text: str, nanoseconds: int) -> None:
    assert parse_seconds(text) == nanoseconds


@pytest.mark.parametrize(
    ("parse_text", "text", "why"),
    [
        (parse_seconds, "noon", "expected seconds"),
        (parse_seconds, "", "expected seconds"),
        (parse_seconds, "nan", "expected seconds"),
        (parse_seconds, "inf", "does not fit"),
        (parse_seconds, "9223372036", "does not fit"),
        (parse_seconds, "-9223372036", "does not fit"),
        (parse_seconds, "1e999999999", "does not fit"),
        (parse_seconds, "0.0000000001", "more than nine decimals"),
        (parse_seconds, "1e-999999999", "more than nine decimals"),
        (parse_time, "-1", "from the beginning on"),
        (parse_time, "2014-13-31", "or a date such as"),
        (parse_time, "2014-03-31Tnoon", "or a date such as"),
        (parse_time, "2014-03-31T19:24:50.1234567891", "more than nine decimals"),
        (parse_time, "9999-01-01", "does not fit"),
    ],
)
def test_a_text_that_is_no_time_is_an_error(parse_text: Callable[[str], object], text: str, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        parse_text(text)


@given(nanoseconds=st.integers(1 - LIMIT, LIMIT - 1))
def test_seconds_that_were_printed_can_be_typed(nanoseconds: int) -> None:
    assert parse_seconds(format_seconds(nanoseconds)) == nanoseconds


def parse(kind: Any, *arguments: str) -> object:
    """The value of the option ``--option`` of a type."""
    app = App()

    def command(*, option: object = None) -> object:
        return option

    command.__annotations__["option"] = kind
    app.default(command)
    call: Callable[..., object] = app
    return call(arguments, exit_on_error=False, print_error=False, result_action="return_value")


@pytest.mark.parametrize(
    ("kind", "argument", "value"),
    [
        (Rate, "--option=0.5", 0.5),
        (Speed, "--option=inf", float("inf")),
        (Duration, "--option=0", 0.0),
        (Duration, "--option=inf", float("inf")),
        (Instant, "--option=1.5", Time(1_500_000_000, False)),
        (Instant, "--option=2014-03-31T19:24:50", Time(1_396_293_890_000_000_000, True)),
        (Step, "--option=0.000000001", 1),
        (Backend, "--option=trio", "trio"),
        (Flag, "--option", True),
        (JsonFlag, "--json", True),
    ],
)
def test_an_argument_is_converted_to_its_type(kind: Any, argument: str, value: object) -> None:
    assert parse(kind, argument) == value


@pytest.mark.parametrize(
    ("kind", "wrong"),
    [
        (Rate, "--option=0 --option=inf --option=nan"),
        (Speed, "--option=0 --option=nan"),
        (Duration, "--option=-1 --option=nan"),
        (Instant, "--option=noon --option=-1"),
        (Step, "--option=0 --option=-1"),
        (Backend, "--option=curio"),
        (Flag, "--no-option"),
        (JsonFlag, "--no-json"),
    ],
)
def test_an_argument_that_its_type_does_not_allow_is_an_error(kind: Any, wrong: str) -> None:
    for argument in wrong.split():
        with pytest.raises(CycloptsError):
            parse(kind, argument)


@pytest.mark.parametrize(
    ("text", "time"),
    [
        ("0", Time(0, absolute=False)),
        ("12.5", Time(12_500_000_000, absolute=False)),
        ("99999999.999999999", Time(99_999_999_999_999_999, absolute=False)),
        ("100000000", Time(100_000_000_000_000_000, absolute=True)),
        ("1396293888.05", Time(1_396_293_888_050_000_000, absolute=True)),
        ("2014-03-31T19:24:50.123456789", Time(1_396_293_890_123_456_789, absolute=True)),
        ("2014-03-31T21:24:50+02:00", Time(1_396_293_890_000_000_000, absolute=True)),
        ("2014-03-31 19:24:50Z", Time(1_396_293_890_000_000_000, absolute=True)),
        (" 2014-03-31", Time(1_396_224_000_000_000_000, absolute=True)),
    ],
)
def test_a_time_is_an_offset_a_stamp_or_a_date(text: str, time: Time) -> None:
    assert parse_time(text) == time
    assert time.stamp(1_000) == time.nanoseconds + (0 if time.absolute else 1_000)
    assert time.stamp(None) == time.nanoseconds


def test_topics_have_prefixes_and_contradictions_are_refused() -> None:
    options = TopicOptions(("/robot1/tf=robot1/", "/tf"), prefix="x/")
    assert options.arguments() == {"topics": {"/robot1/tf": "robot1/", "/tf": ""}, "prefix": "x/", "namespaces": False}
    assert TopicOptions().arguments() == {"topics": None, "prefix": "", "namespaces": False}
    for wrong in (TopicOptions(("/tf",), namespaces=True), TopicOptions(prefix="/x"), TopicOptions(("/tf=/x",))):
        with pytest.raises(UsageError):
            wrong.arguments()
