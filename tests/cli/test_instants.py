import pytest
from hypothesis import given
from hypothesis import strategies as st

from tfbus.cli.instants import nanoseconds, seconds

LIMIT = 9_223_372_036 * 1_000_000_000


@pytest.mark.parametrize(
    ("text", "stamp"),
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
def test_seconds_are_taken_exactly(text: str, stamp: int) -> None:
    assert nanoseconds(text) == stamp


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("noon", "expected seconds"),
        ("", "expected seconds"),
        ("nan", "expected seconds"),
        ("inf", "does not fit"),
        ("1e10", "does not fit"),
        ("-1e10", "does not fit"),
        ("1e999999999", "does not fit"),
        ("0.0000000001", "more than nine decimals"),
        ("1e-999999999", "more than nine decimals"),
    ],
)
def test_what_is_no_instant_says_why(text: str, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        nanoseconds(text)


@given(stamp=st.integers(1 - LIMIT, LIMIT - 1))
def test_what_is_printed_can_be_typed(stamp: int) -> None:
    assert nanoseconds(seconds(stamp)) == stamp


@pytest.mark.parametrize(
    ("stamp", "text"), [(0, "0.000000000"), (1, "0.000000001"), (-1, "-0.000000001"), (-1_500_000_000, "-1.500000000")]
)
def test_all_nine_decimals_are_printed(stamp: int, text: str) -> None:
    assert seconds(stamp) == text
