"""The messages of remote lookups: a question about a buffer in another process, its answer, and its cancellation.

Each is a JSON object. An error travels with its facts; see `tfbus.errors.TransformError.to_dict`.

The two functions that read them are the door for the data of strangers. They check what Python would trip over later:
integers that are no stamps, values inside values, names of any length, errors that no lookup raises, and answers to
another question. Nothing but a `ValueError` leaves them.
"""

import json
import math
from dataclasses import dataclass
from typing import Any

from tfbus.errors import (
    BusClosedError,
    ClockResetError,
    InvalidTransformError,
    RemoteLookupError,
    TransformError,
    TransformLookupError,
)
from tfbus.geometry.stamped import TransformStamped
from tfbus.plain import PlainData
from tfbus.stamps import STAMP_MAX, STAMP_MIN, Latest
from tfbus.tf_message import MAX_NAME

MAX_BYTES = 2**16
"""The largest message that is read."""
MAX_DEPTH = 16
"""So deep may values stand inside of values; an error with its cause takes two levels."""
_MOST_DIGITS = 20
_SHOWN = 200

_ARGUMENT_ERRORS: dict[str, type[Exception]] = {"TypeError": TypeError, "ValueError": ValueError}
_LOOKUP_ERRORS = TransformLookupError, InvalidTransformError, ClockResetError, BusClosedError
"""The errors of tfbus that a lookup raises."""


@dataclass(frozen=True, slots=True)
class RemoteQuestion(PlainData):
    """One lookup of an asker; all but the first two fields are the arguments of `tfbus.Buffer.lookup`.

    Attributes
    ----------
    asker : str
        The id of the asker.
    number : int
        The asker's number of this question.
    hold : float or None
        The `max_age` of a `tfbus.Hold`, in s.
    """

    asker: str
    number: int
    target: str
    source: str
    at: int | Latest
    timeout: float | None = None
    max_age: float | None = None
    source_at: int | Latest | None = None
    fixed: str | None = None
    tolerance: float = 0.0
    max_gap: float | None = None
    hold: float | None = None


@dataclass(frozen=True, slots=True)
class Cancellation(PlainData):
    """The end of a question that the asker does not wait for any more."""

    asker: str
    number: int


def write_question(
    question: RemoteQuestion | Cancellation, number: int | None = None, timeout: float | None = None
) -> bytes:
    """The bytes of a question or of its cancellation; with another number and timeout, if a number is given."""
    fields = question.to_dict()
    if number is not None:
        fields |= {"number": number, "timeout": timeout}
    return json.dumps(fields).encode()


def read_question(data: bytes) -> RemoteQuestion | Cancellation:
    """The question or cancellation in some bytes.

    Raises
    ------
    ValueError
        If they are no such message, or it has an integer of more than 64 bits or a name of more than `MAX_NAME` bytes.
    """
    fields = _read(data)
    for name, value in fields.items():
        if isinstance(value, str) and len(value.encode()) > MAX_NAME:
            raise ValueError(f"its field {_shown(name)} has more than {MAX_NAME} bytes")
    try:
        return (Cancellation if fields.get("type") == "Cancellation" else RemoteQuestion).from_dict(fields)
    except ValueError as error:
        raise ValueError(str(error)[:_SHOWN]) from None


def write_answer(answer: TransformStamped | Exception) -> bytes:
    """The bytes of an answer, or of the error of a lookup."""
    if isinstance(answer, (TransformStamped, TransformError)):
        return json.dumps(answer.to_dict()).encode()
    kind = next((name for name, kind in _ARGUMENT_ERRORS.items() if isinstance(answer, kind)), "Exception")
    return json.dumps({"type": kind, "message": str(answer)}).encode()


def read_answer(
    data: bytes, domain: str, robot: str | None, question: RemoteQuestion | None = None
) -> TransformStamped | Exception:
    """The answer in some bytes, or the error to raise; a `RemoteLookupError` if the bytes are neither.

    With a question, an answer about other frames or another stamp is none.
    """
    try:
        answer = _answer_of(_read(data))
        if question is not None and isinstance(answer, TransformStamped):
            _check_answers(answer, question)
    except Exception as error:  # noqa: BLE001 - whatever a server sends, the asker hears of one error
        detail = f"not an answer: {str(error)[:_SHOWN]}"
        return RemoteLookupError(domain=domain, robot=robot, reason="malformed", detail=detail)
    return answer


def _answer_of(fields: dict[str, Any]) -> TransformStamped | Exception:
    kind = fields.get("type")
    if kind == "TransformStamped":
        return TransformStamped.from_dict(fields)
    message = fields.get("message")
    if isinstance(kind, str) and kind in _ARGUMENT_ERRORS and isinstance(message, str):
        return _ARGUMENT_ERRORS[kind](message)
    error = TransformError.from_dict(fields)
    if not isinstance(error, _LOOKUP_ERRORS):
        raise ValueError(f"no lookup raises {kind}")  # noqa: TRY004 - the data are wrong
    return error


def _check_answers(answer: TransformStamped, question: RemoteQuestion) -> None:
    if (answer.parent, answer.child) != (question.target, question.source):
        raise ValueError(f"it is about {_shown(answer.parent)} and {_shown(answer.child)}")
    if not (answer.static or isinstance(question.at, Latest) or answer.stamp == question.at):
        raise ValueError(f"it is of the stamp {answer.stamp}, not of {question.at}")


def as_timeout(timeout: float | None, longest: float) -> float:
    """The timeout of a question at the server, which waits for so long at most."""
    return longest if timeout is None or math.isnan(timeout) else min(timeout, longest)


def _read(data: bytes) -> dict[str, Any]:
    """The JSON object in some bytes; raises `ValueError` if they are none, or beyond a bound."""
    if len(data) > MAX_BYTES:
        raise ValueError(f"{len(data)} bytes, more than {MAX_BYTES}")
    try:
        fields = json.loads(data, parse_int=_integer)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    if not isinstance(fields, dict):
        raise ValueError("not a JSON object")  # noqa: TRY004 - the data are wrong
    level: list[Any] = [fields]
    for _ in range(MAX_DEPTH):
        level = [part for value in level for part in (value.values() if isinstance(value, dict) else value)]
        level = [value for value in level if isinstance(value, (dict, list))]
        if not level:
            return fields
    raise ValueError(f"it is nested more than {MAX_DEPTH} levels deep")


def _integer(digits: str) -> int:
    number = int(digits) if len(digits) <= _MOST_DIGITS else STAMP_MAX + 1
    if not STAMP_MIN <= number <= STAMP_MAX:
        raise ValueError(f"an integer of {len(digits)} digits does not fit 64 bits")
    return number


def _shown(name: str) -> str:
    return repr(name[: _SHOWN // 4])
