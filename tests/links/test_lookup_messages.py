import json
import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tfbus import (
    LATEST,
    Covariance,
    FutureExtrapolationError,
    LookupTimeoutError,
    RecordingError,
    RemoteLookupError,
    Transform,
    TransformStamped,
    TransformTree,
    UncertainSample,
    UncertainTransform,
)
from tfbus.links.message import (
    MAX_TEXT,
    Kind,
    RemoteQuestion,
    Text,
    read_answer,
    read_message,
    read_question,
    write_answer,
    write_body,
    write_question,
)
from tfbus.tf_message import MalformedMessageError

SHORT = FutureExtrapolationError(child="base", stamp=9, oldest=1, newest=5, authority="odometry")


def outcome(data: bytes, domain: str, robot: str | None, question: RemoteQuestion | None = None) -> Any:
    """The answer in some bytes, or the error that its reader raises."""
    try:
        return read_answer(data, domain, robot, question)
    except Exception as error:  # noqa: BLE001 - it is judged
        return error


@pytest.mark.parametrize(
    "message",
    [
        RemoteQuestion("map", "base", LATEST),
        RemoteQuestion("map", "base", 7, 0.5, 1.0, LATEST, "odom", math.inf, 0.2, 0.1, covariance=True),
    ],
)
def test_a_question_is_read_as_it_was_written(message: RemoteQuestion) -> None:
    assert read_question(RemoteQuestion, write_question(message)) == message


def test_so_large_a_message_is_read_and_no_larger_one() -> None:
    largest = bytes(8) + write_question(QUESTION).ljust(MAX_TEXT)
    (text,) = read_message(write_body(Kind.LOOKUP, largest))
    assert isinstance(text, Text)
    assert read_question(RemoteQuestion, text.data[8:]) == QUESTION
    with pytest.raises(MalformedMessageError) as refused:
        list(read_message(write_body(Kind.LOOKUP, largest + b" ")))
    assert refused.value.reason == "oversized"


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xff",
        b"[]",
        b"{}",
        b'{"type": "RemoteQuestion", "target": "map"}',
        b'{"type": "RemoteQuestion", "target": "map", "source": 1, "at": 1}',
        b"[" * 30_000,
        b'{"type": %b, "message": "m", "cause": null}' % (b"[" * 300 + b"]" * 300),
        b'{"type": "ValueError", "message": ["m"]}',
        b'{"type": {}, "message": "m"}',
        write_question(RemoteQuestion("m" * MAX_TEXT, "base", 1)),
    ],
)
def test_other_bytes_are_no_question_and_no_answer(data: bytes) -> None:
    with pytest.raises(ValueError, match=r"."):
        read_question(RemoteQuestion, data)
    error = outcome(data, "tf", "r1")
    assert isinstance(error, RemoteLookupError)
    assert (error.domain, error.robot, error.reason) == ("tf", "r1", "malformed")


QUESTION = RemoteQuestion("map", "base", 7, 0.5, 1.0, LATEST, "odom", 0.3, 0.2, 0.1)
FOUND = TransformStamped("map", "base", 7, Transform((0.1, 0.2, 1 / 3)))
LATE = LookupTimeoutError(target="map", source="base", timeout=0.5, missing=SHORT)
LATE.__cause__ = SHORT


def fields_of(data: bytes, **changes: Any) -> bytes:
    return json.dumps(json.loads(data) | changes).encode()


@pytest.mark.parametrize("name", ["at", "timeout", "max_age", "source_at", "tolerance", "max_gap", "hold"])
@pytest.mark.parametrize("digits", [20, 401, 5_000])
def test_a_question_with_an_integer_of_more_than_64_bits_is_refused(name: str, digits: int) -> None:
    data = fields_of(write_question(QUESTION), **{name: None}).replace(b"null", b"9" * digits)
    with pytest.raises(ValueError, match=f"{digits} digits does not fit 64 bits"):
        read_question(RemoteQuestion, data)


@pytest.mark.parametrize("name", ["target", "source", "fixed"])
def test_a_question_with_a_longer_name_than_a_message_of_samples_may_have_is_refused(name: str) -> None:
    read_question(RemoteQuestion, fields_of(write_question(QUESTION), **{name: "x" * 1_024}))
    with pytest.raises(ValueError, match="more than 1024 bytes"):
        read_question(RemoteQuestion, fields_of(write_question(QUESTION), **{name: "\u20ac" * 342}))


def nested(depth: int) -> bytes:
    cause: dict[str, Any] | None = None
    for _ in range(depth):
        cause = LATE.to_dict() | {"cause": cause}
    return json.dumps(cause).encode()


@pytest.mark.parametrize("depth", [17, 100, 240])
def test_causes_of_causes_are_read_to_a_bound(depth: int) -> None:
    assert isinstance(outcome(nested(8), "tf", None), LookupTimeoutError)
    error = outcome(nested(depth), "tf", None)
    assert isinstance(error, RemoteLookupError)
    assert error.detail == "not an answer: it is nested more than 16 levels deep"


@pytest.mark.parametrize(
    "answer",
    [
        TransformStamped("map", "arm", 7, Transform()),
        TransformStamped("odom", "base", 7, Transform()),
        TransformStamped("base", "map", 7, Transform()),
        TransformStamped("map", "base", 8, Transform()),
    ],
)
def test_an_answer_to_another_question_is_none(answer: TransformStamped) -> None:
    assert outcome(write_answer(FOUND), "tf", None, QUESTION) == FOUND
    static = TransformStamped("map", "base", 0, Transform(), static=True)
    assert outcome(write_answer(static), "tf", None, QUESTION) == static
    error = outcome(write_answer(answer), "tf", None, QUESTION)
    assert isinstance(error, RemoteLookupError)
    assert error.reason == "malformed"


def answer_with_errors(edges: int = 2) -> UncertainTransform:
    """At a stamp between two samples of each edge, whose covariance is full."""
    root, tree = Covariance.of(xyz=0.1, rpy=0.2).matrix + 0.005, TransformTree()
    for i in range(edges):
        for stamp in (0, 10):
            place, error = Transform((1.0, 0.1 * stamp, 0.0)), Covariance((1.0 + stamp) * root)
            tree.insert(UncertainSample(str(i), str(i + 1), stamp, place, covariance=error, kind="drift"))
    return tree.lookup("0", str(edges), 7, covariance=True)


SURE = answer_with_errors()


def read_with(**changes: Any) -> Any:
    """An answer with covariances as it is read with some fields of its second edge, its error or a sample changed."""
    fields = json.loads(write_answer(SURE))
    edge = fields["edges"][1]
    for part in (edge, edge["error"], edge["error"]["parts"][0]):
        part |= {name: value for name, value in changes.items() if name in part}
    return outcome(json.dumps(fields).encode(), "tf", None)


def test_an_answer_with_covariances_is_read_as_it_was_written() -> None:
    found = read_with()
    assert isinstance(found, UncertainTransform)
    assert (found, found.links[0].climbs) == (SURE, False)
    assert found.covariance == SURE.covariance
    assert isinstance(read_with(error=None), UncertainTransform)


@pytest.mark.parametrize(
    "changes",
    [
        {"covariance": [0.0] * 35},
        {"covariance": [0.0, 1.0, *[0.0] * 34]},
        {"covariance": [-1.0, *[0.0] * 35]},
        {"covariance": ["NaN", *[0.0] * 35]},
        {"covariance": None},
        {"kind": "guess"},
        {"weight": 0.7},
        {"weight": -0.3},
        {"weight": "NaN"},
        {"stamp": 0.5},
        {"parts": []},
        {"parts": [{"stamp": 0, "weight": 1 / 3, "covariance": [0.0] * 36}] * 3},
        {"parent": "elsewhere"},
        {"climbs": True},
        {"error": []},
        {"transform": {"translation": ["Infinity", 0.0, 0.0], "rotation": [0.0, 0.0, 0.0, 1.0]}},
    ],
    ids=str,
)
def test_a_covariance_that_is_none_is_refused(changes: dict[str, Any]) -> None:
    error = read_with(**changes)
    assert isinstance(error, RemoteLookupError)
    assert error.reason == "malformed"


def test_an_answer_whose_edges_do_not_fit_a_message_is_an_error_that_says_so() -> None:
    assert isinstance(outcome(write_answer(answer_with_errors(55)), "tf", None), UncertainTransform)
    error = outcome(write_answer(answer_with_errors(200)), "tf", None)
    assert isinstance(error, ValueError)
    assert str(error) == (
        "the way from '0' to '200' has 200 edges, more than an answer with covariances can tell in 131072 bytes"
    )


def test_an_error_that_no_lookup_raises_is_no_answer() -> None:
    error = outcome(write_answer(RecordingError("it is cut off", path="/etc/passwd", reason="damaged")), "tf", None)
    assert isinstance(error, RemoteLookupError)
    assert "no lookup raises RecordingError" in error.detail


PLAIN: st.SearchStrategy[Any] = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.sampled_from([10**400, -(2**63), 2**63, 10**25])
    | st.floats()
    | st.text(max_size=8)
    | st.sampled_from(["LATEST", "NaN", "Infinity", "ValueError", "UnknownFrameError", "\ud800", "x" * 2_000]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)
MESSAGES = [write_question(QUESTION)]
MESSAGES += [write_answer(answer) for answer in (FOUND, SURE, SHORT, LATE, ValueError("too long"))]


@given(st.sampled_from(MESSAGES), st.data())
def test_one_wrong_field_or_byte_raises_nothing_but_a_value_error(message: bytes, data: st.DataObject) -> None:
    if data.draw(st.booleans()):
        name = data.draw(st.sampled_from([*json.loads(message), "more"]))
        bad = fields_of(message, **{name: data.draw(PLAIN)})
    else:
        place = data.draw(st.integers(0, len(message) - 1))
        bad = message[:place] + data.draw(st.binary(max_size=3)) + message[place + data.draw(st.integers(0, 9)) :]
    try:
        read_question(RemoteQuestion, bad)
    except ValueError as error:
        assert len(str(error)) < 1_000
    answer = outcome(bad, "tf", None, QUESTION)
    # It can be worded, too.
    assert str(answer)
    if isinstance(answer, TransformStamped):
        assert (answer.parent, answer.child) == ("map", "base")
