import math

import pytest

from tfbus import LATEST, FutureExtrapolationError, LookupTimeoutError, RemoteLookupError, Transform, TransformStamped
from tfbus.links._remote_lookup import (
    MAX_BYTES,
    Cancellation,
    RemoteQuestion,
    as_timeout,
    read_answer,
    read_question,
    write_answer,
    write_question,
)

SHORT = FutureExtrapolationError(child="base", stamp=9, oldest=1, newest=5, authority="odometry")


@pytest.mark.parametrize(
    "message",
    [
        RemoteQuestion("me", 1, "map", "base", LATEST),
        RemoteQuestion("me", 2, "map", "base", 7, 0.5, 1.0, LATEST, "odom", math.inf, 0.2, 0.1),
        Cancellation("me", 2),
    ],
)
def test_a_question_and_its_cancellation_are_read_as_they_were_written(message: RemoteQuestion | Cancellation) -> None:
    assert read_question(write_question(message)) == message


def test_so_large_a_message_is_read_and_no_larger_one() -> None:
    largest = write_question(Cancellation("me", 2)).ljust(MAX_BYTES)
    assert read_question(largest) == Cancellation("me", 2)
    with pytest.raises(ValueError, match=f"{MAX_BYTES + 1} bytes, more than {MAX_BYTES}"):
        read_question(largest + b" ")


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xff",
        b"[]",
        b"{}",
        b'{"type": "Cancellation", "asker": "me"}',
        b'{"type": "Cancellation", "asker": "me", "number": "1"}',
        b"[" * 30_000,
        write_question(Cancellation("m" * MAX_BYTES, 1)),
    ],
)
def test_other_bytes_are_no_question_and_no_answer(data: bytes) -> None:
    with pytest.raises(ValueError, match=r"."):
        read_question(data)
    error = read_answer(data, "tf", "r1")
    assert isinstance(error, RemoteLookupError)
    assert (error.domain, error.robot, error.reason) == ("tf", "r1", "malformed")


def test_an_answer_and_each_kind_of_error_come_back_with_their_facts() -> None:
    answer = TransformStamped("map", "base", 7, Transform((0.1, 0.2, 1 / 3)))
    assert read_answer(write_answer(answer), "tf", None) == answer
    late = LookupTimeoutError(target="map", source="base", timeout=0.5, missing=SHORT)
    late.__cause__ = SHORT
    back = read_answer(write_answer(late), "tf", None)
    assert isinstance(back, LookupTimeoutError)
    assert isinstance(back.__cause__, FutureExtrapolationError)
    assert (str(back), back.__cause__.newest, back.__cause__.authority) == (str(late), 5, "odometry")
    for error in (TypeError("a float"), ValueError("too long")):
        again = read_answer(write_answer(error), "tf", None)
        assert (type(again), str(again)) == (type(error), str(error))


def test_the_server_waits_no_longer_than_its_own_limit() -> None:
    assert [as_timeout(timeout, 10.0) for timeout in (None, math.nan, math.inf, 20.0, 3.0)] == [10.0] * 4 + [3.0]
