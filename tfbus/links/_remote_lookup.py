"""The messages of remote lookups: a question about a buffer in another process, its answer, and its cancellation.

Each is a JSON object. An error travels with its facts; see `tfbus.errors.TransformError.to_dict`.
"""

import json
import math
from dataclasses import dataclass
from typing import Any

from tfbus.errors import RemoteLookupError, TransformError
from tfbus.geometry.stamped import TransformStamped
from tfbus.plain import PlainData
from tfbus.stamps import Latest

MAX_BYTES = 2**16
"""The largest message that is read."""

_ARGUMENT_ERRORS: dict[str, type[Exception]] = {"TypeError": TypeError, "ValueError": ValueError}


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
        If they are no such message.
    """
    fields = _read(data)
    return (Cancellation if fields.get("type") == "Cancellation" else RemoteQuestion).from_dict(fields)


def write_answer(answer: TransformStamped | Exception) -> bytes:
    """The bytes of an answer, or of the error of a lookup."""
    if isinstance(answer, (TransformStamped, TransformError)):
        return json.dumps(answer.to_dict()).encode()
    kind = next((name for name, kind in _ARGUMENT_ERRORS.items() if isinstance(answer, kind)), "Exception")
    return json.dumps({"type": kind, "message": str(answer)}).encode()


def read_answer(data: bytes, domain: str, robot: str | None) -> TransformStamped | Exception:
    """The answer in some bytes, or the error to raise; a `RemoteLookupError` if the bytes are neither."""
    try:
        fields = _read(data)
        kind = fields.get("type")
        if kind == "TransformStamped":
            return TransformStamped.from_dict(fields)
        if kind in _ARGUMENT_ERRORS:
            return _ARGUMENT_ERRORS[kind](fields.get("message"))
        return TransformError.from_dict(fields)
    except ValueError as error:
        return RemoteLookupError(domain=domain, robot=robot, reason="malformed", detail=f"not an answer: {error}")


def as_timeout(timeout: float | None, longest: float) -> float:
    """The timeout of a question at the server, which waits for so long at most."""
    return longest if timeout is None or math.isnan(timeout) else min(timeout, longest)


def _read(data: bytes) -> dict[str, Any]:
    if len(data) > MAX_BYTES:
        raise ValueError(f"{len(data)} bytes, more than {MAX_BYTES}")
    try:
        fields = json.loads(data)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    if not isinstance(fields, dict):
        raise ValueError("not a JSON object")  # noqa: TRY004 - the data are wrong
    return fields
