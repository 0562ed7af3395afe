import logging
from typing import Any

import pytest

from tfbus import (
    BusClosedError,
    ClockResetError,
    FutureExtrapolationError,
    GapError,
    LookupTimeoutError,
    PastExtrapolationError,
    TransformError,
    UnknownFrameError,
)
from tfbus.message_filter.message_filter import DroppedMessages, DropReason, reason_of

FUTURE = FutureExtrapolationError(child="laser", stamp=5, oldest=1, newest=2)
UNKNOWN = UnknownFrameError(frame="laser")


def timeout(cause: Any) -> LookupTimeoutError:
    error = LookupTimeoutError(target="map", source="laser", timeout=1.0, missing=cause)
    error.__cause__ = cause
    return error


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (PastExtrapolationError(child="laser", stamp=0, oldest=1, newest=2), "too old"),
        (GapError(before=1, after=9, max_gap=2, child="laser", stamp=5, oldest=1, newest=9), "too old"),
        (timeout(FUTURE), "timed out"),
        (timeout(UNKNOWN), "unknown frame"),
        (UNKNOWN, "unknown frame"),
        (ClockResetError(before=2, after=1), "clock reset"),
        (BusClosedError(), "closed"),
    ],
)
def test_each_error_that_ends_a_wait_has_its_reason(error: TransformError, reason: DropReason) -> None:
    assert reason_of(error) == reason


def test_dropped_messages_are_counted_by_reason_and_reported() -> None:
    told: list[tuple[str, DropReason, TransformError | None]] = []
    drops: DroppedMessages[str] = DroppedMessages(lambda *drop: told.append(drop))
    drops.drop("first", "timed out", FUTURE)
    drops.drop("second", "queue full", None)
    drops.drop("third", "timed out", None)
    assert drops.counts == {"timed out": 2, "queue full": 1}
    assert told == [("first", "timed out", FUTURE), ("second", "queue full", None), ("third", "timed out", None)]


def test_an_exception_of_the_callback_is_counted_and_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    def clumsy(_message: str, _reason: DropReason, _error: TransformError | None) -> None:
        raise ValueError("spilt the coffee")

    drops: DroppedMessages[str] = DroppedMessages(clumsy)
    for _ in range(3):
        drops.drop("message", "closed", None)
    assert (drops.counts, drops.callbacks_failed) == ({"closed": 3}, 3)
    (record,) = caplog.records
    assert (record.name, record.levelno) == ("tfbus", logging.WARNING)
    assert record.exc_info is not None
    assert str(record.exc_info[1]) == "spilt the coffee"


@pytest.mark.parametrize("callback", ["print", 10])
def test_a_callback_that_is_not_callable_is_a_type_error(callback: Any) -> None:
    with pytest.raises(TypeError, match="on_drop must be callable"):
        DroppedMessages(callback)


def test_a_base_exception_of_the_callback_is_raised() -> None:
    def impatient(_message: str, _reason: DropReason, _error: TransformError | None) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        DroppedMessages(impatient).drop("message", "closed", None)
