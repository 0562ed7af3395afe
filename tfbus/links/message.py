"""The messages between links of tfbus, as bytes.

A message says what ROS's TFMessage cannot: the origin, number and authority of its samples, removals, and what the
sender holds. The samples themselves are a TFMessage behind that. Little endian::

    version u8, kind u8, flags u8, reach u8, origins u16, authorities u16, entries u32, number u64, bus 16 bytes
    since u64, sequence u64, digest u64: a `Claim`
    time         i64, the time of the sender's clock in ns, if the flags say so
    reach        origin 16 bytes, length u8, and so many buses on the way there, 16 bytes each
    origins      16 bytes each, and the base of the clock of its batches in ns, i64; the least one if it is unknown
    authorities  length u16, UTF-8
    entries      kind u8, origin u16, samples u16, sequence u64, and then
        batch    for each sample: twice the place of its authority, and one more for a static one, u16
        batch with covariances, the same, and then for each sample: u8, zero if it has none, or one more than the place
                 of its kind in `tfbus.geometry.covariance.KINDS`, and the upper half of its covariance, 21 f64
        removal  the length of the name in place of samples, UTF-8
    samples      a TFMessage with the samples of all batches, in their order
    clocks       the section of `tfbus.links.clocks`, if the flags say so

The kinds are those of `tfbus.links.replica`, and those of the past and of lookups. Questions are JSON behind version
and kind: the fields of `ChangesQuestion`, `PastQuestion` or `RemoteQuestion`. A question of a lookup and its answer
have a number of 8 bytes before the JSON, by which an answer finds its question; a number alone cancels the question.
Reading a message costs time in proportion to its bytes; handling an entry may cost more, so both have a limit.

An error of a lookup travels with its facts, see `tfbus.errors.TransformError.to_dict`. `read_question` and
`read_answer` are the door for the data of strangers. They check what Python would trip over later: integers that are
no stamps, values inside values, names of any length, errors that no lookup raises, and answers to another question.
For bytes with any of these, they raise one kind of error each.
"""

import enum
import json
import struct
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from sys import intern
from typing import Any, NamedTuple, TypeVar

import numpy as np

from tfbus.errors import (
    BusClosedError,
    ClockResetError,
    InvalidTransformError,
    RemoteLookupError,
    TransformError,
    TransformLookupError,
)
from tfbus.geometry.covariance import KINDS, Covariance
from tfbus.geometry.stamped import TransformStamped
from tfbus.geometry.uncertain import Belief, UncertainSample, are_uncertain
from tfbus.links.clocks import split_section
from tfbus.links.replica import (
    Claim,
    Entry,
    FromLink,
    OutgoingBatch,
    ReceivedBatch,
    ReceivedTransform,
    ReceivedUncertain,
    RemovedFrame,
)
from tfbus.plain import PlainData
from tfbus.stamps import SECOND, STAMP_MAX, STAMP_MIN, Latest
from tfbus.tf_message import MAX_NAME, Decoded, MalformedMessageError, decode, decode_in_parts, encode, refusal
from tfbus.uncertainty.answers import UncertainTransform

VERSION = 8
MAX_BYTES = 2**22
"""The largest message with samples that is sent or read."""
MAX_HEAD = 2**20
"""The largest part of a message before its samples."""
MAX_TEXT = 2**17
"""The most bytes of JSON in one message."""
MAX_DEPTH = 16
"""The deepest nesting of values; an error with its cause takes two levels."""
MAX_ENTRIES = 10_000
MAX_SAMPLES = 10_000
"""The largest batch that is sent or accepted: a bus publishes it in one turn of the loop, all or nothing."""
LONGEST_WAY = 8
"""The most buses on the way to a bus."""
_PART = 200
"""The samples or entries of a large message that are handled before other tasks may have their turn."""
_PART_OF_HEAD = 1_000
_BELIEFS_AT_ONCE = 50
_LONGEST_AUTHORITY = 65_535
FIRST_STAMP, END_OF_STAMPS = -(2**31) * SECOND, 2**31 * SECOND
_MOST_DIGITS = 20
NUMBER = 8
"""Bytes of the number before the question or answer of a lookup."""
_SHOWN = 200

_ARGUMENT_ERRORS: dict[str, type[Exception]] = {"TypeError": TypeError, "ValueError": ValueError}
_LOOKUP_ERRORS = TransformLookupError, InvalidTransformError, ClockResetError, BusClosedError
"""The errors of tfbus that a lookup raises."""

_HEADER = struct.Struct("<BBBBHHIQ16sQQQ")
_ENTRY = struct.Struct("<BHHQ")
_LENGTH = struct.Struct("<H")
_TIME = struct.Struct("<q")
_ORIGIN = struct.Struct("<16sq")
_BATCH, _REMOVAL, _UNCERTAIN = 0, 1, 2
_COVARIANCE = struct.Struct("<21d")
_UPPER = np.triu_indices(6)
_FINAL, _HAS_TIME, _SERVES, _HAS_CLOCKS = 1, 2, 4, 8
_NO_CLOCK = -(2**63)
_BUS = 16

QuestionT = TypeVar("QuestionT", bound=PlainData)
NOTHING = Claim(0, 0, 0)
Way = tuple[bytes, tuple[bytes, ...]]
"""A bus that is reached, and the buses on the way there."""


class Kind(enum.IntEnum):
    """The purpose of a message."""

    LIVE = 1
    SIGN = 2
    MEETING = 3
    QUESTION = 4
    ANSWER = 5
    PAST_QUESTION = 6
    PAST = 7
    LOOKUP = 8
    LOOKUP_ANSWER = 9


_KINDS = {kind.value: kind for kind in Kind}
TEXTS = frozenset({Kind.QUESTION, Kind.PAST_QUESTION, Kind.LOOKUP, Kind.LOOKUP_ANSWER})


@dataclass(slots=True)
class Outgoing:
    """The rest of a message, beside its entries.

    Attributes
    ----------
    kind : Kind
    bus : bytes
        The sender's own bus.
    number : int
        The number of a live message on its channel, or of the newest live message before a sign; 0 for others.
    claim : Claim
    time : int or None
    reach : sequence of Way
    serves : bool
        Whether the sender answers lookups.
    clocks : bytes
        The section of `tfbus.links.clocks` at the end of a sign or a meeting; `split_clocks` takes it off.
    """

    kind: Kind
    bus: bytes
    number: int = 0
    claim: Claim = NOTHING
    time: int | None = None
    reach: Sequence[Way] = ()
    serves: bool = False
    clocks: bytes = b""


@dataclass(slots=True)
class Heard(Outgoing):
    """A message, or a part of one, as it came.

    Attributes
    ----------
    entries : list of ReceivedBatch or RemovedFrame
        In the order in which it happened.
    errors : list of InvalidTransformError
        One for each sample that was refused; `entries` have the others.
    continues : bool
        Whether it is a later part of a message.
    goes_on : bool
        Whether a later part follows; only after the last one the claim holds.
    """

    entries: list[ReceivedBatch | RemovedFrame] = field(default_factory=list)
    errors: list[InvalidTransformError] = field(default_factory=list)
    continues: bool = False
    goes_on: bool = False


class Text(NamedTuple):
    """A message of JSON, as it came; `data` is its body."""

    kind: Kind
    data: bytes


# Writing


def write_message(out: Outgoing, entries: Sequence[Entry] = ()) -> bytes:
    """The bytes of a message.

    Raises
    ------
    ValueError
        If one message cannot hold all entries: there are too many of anything, a name or an authority is too long or
        cannot be written in UTF-8, or all together are too large.
    """
    samples: list[TransformStamped] = []
    for entry in entries:
        if isinstance(entry, OutgoingBatch):
            samples += entry.uncorrected()
    if len(samples) > MAX_SAMPLES:
        raise ValueError(f"a message of {len(samples)} samples, more than {MAX_SAMPLES}")
    try:
        message = _head(out, entries) + (encode(samples) if samples else b"") + out.clocks
    except struct.error as error:
        raise ValueError(f"too much for one message: {error}") from None
    if len(message) > MAX_BYTES:
        raise ValueError(f"a message of {len(samples)} samples has {len(message)} bytes, more than {MAX_BYTES}")
    return message


def write_body(kind: Kind, body: bytes) -> bytes:
    """The bytes of a message with this body."""
    return bytes((VERSION, kind)) + body


def sendable(entry: Entry, refuse: Callable[[str, Exception], object]) -> Entry | None:
    """The part of an entry that a message can hold, None for nothing; the rest is refused with its reason and error."""
    if isinstance(entry, RemovedFrame):
        try:
            write_message(Outgoing(Kind.LIVE, b""), [entry])
        except ValueError as error:
            refuse("frame name", error)
            return None
        return entry
    if all(map(can_hold, entry.samples)):
        return entry
    kept: list[TransformStamped] = []
    for sample in entry.samples:
        refused = reason_not_to_send(sample)
        if refused is None:
            kept.append(sample)
        else:
            refuse(refused.reason, refused)
    return replace(entry, samples=kept) if kept else None


def can_hold(sample: TransformStamped) -> bool:
    """Whether a message can hold a sample."""
    parent, child, stamp, _, authority, _ = sample._fields
    names = parent + child + authority
    # The usual case, in which a letter is a byte.
    if len(names) <= MAX_NAME and names.isascii():
        return FIRST_STAMP <= stamp < END_OF_STAMPS
    return reason_not_to_send(sample) is None


def reason_not_to_send(sample: TransformStamped) -> InvalidTransformError | None:
    """The reason that keeps a sample out of a message; None if there is none."""
    try:
        size = len(sample.authority.encode())
    except UnicodeEncodeError:
        why = "cannot be written in UTF-8"
    else:
        if size <= _LONGEST_AUTHORITY:
            return refusal(sample)
        why = f"has {size} bytes, more than {_LONGEST_AUTHORITY}"
    return InvalidTransformError(
        f"an authority {why}", reason="authority", parent=sample.parent, child=sample.child, authority=sample.authority
    )


def _head(out: Outgoing, entries: Sequence[Entry]) -> bytes:
    if len(entries) > MAX_ENTRIES:
        raise ValueError(f"too much for one message: {len(entries)} entries, more than {MAX_ENTRIES}")
    origins: dict[tuple[bytes, int], int] = {}
    authorities: dict[str, int] = {}
    body = bytearray()
    for entry in entries:
        clock = _NO_CLOCK if isinstance(entry, RemovedFrame) or entry.clock is None else entry.clock
        origin = origins.setdefault((entry.origin, clock), len(origins))
        if isinstance(entry, RemovedFrame):
            name = entry.frame.encode()
            if len(name) > MAX_NAME:
                raise ValueError(f"too much for one message: a frame name of {len(name)} bytes")
            body += _ENTRY.pack(_REMOVAL, origin, len(name), entry.sequence) + name
            continue
        tags = [
            2 * authorities.setdefault(sample.authority, len(authorities)) + sample.static for sample in entry.samples
        ]
        kind = _UNCERTAIN if are_uncertain(entry.samples) else _BATCH
        body += _ENTRY.pack(kind, origin, len(tags), entry.sequence) + struct.pack(f"<{len(tags)}H", *tags)
        if kind == _UNCERTAIN:
            body += b"".join(map(_write_belief, entry.samples))
    claim = out.claim
    flags = _FINAL * claim.final | _HAS_TIME * (out.time is not None) | _SERVES * out.serves
    flags |= _HAS_CLOCKS * bool(out.clocks)
    counts = len(out.reach), len(origins), len(authorities), len(entries)
    held = claim.since, claim.sequence, claim.digest
    head = bytearray(_HEADER.pack(VERSION, out.kind, flags, *counts, out.number, out.bus, *held))
    if out.time is not None:
        head += _TIME.pack(out.time)
    for bus, path in out.reach:
        head += bus + bytes((len(path),)) + b"".join(path)
    for named in origins:
        head += _ORIGIN.pack(*named)
    for authority in authorities:
        text = authority.encode()
        head += _LENGTH.pack(len(text)) + text
    if len(head) + len(body) > MAX_HEAD:
        raise ValueError(f"too much for one message: {len(head) + len(body)} bytes before the samples")
    return bytes(head + body)


def _write_belief(sample: TransformStamped) -> bytes:
    if not isinstance(sample, UncertainSample):
        return b"\0"
    return bytes((1 + KINDS.index(sample.kind),)) + _COVARIANCE.pack(*sample.covariance.matrix[_UPPER].tolist())


# Reading


_Told = tuple[ReceivedBatch | RemovedFrame, int]
"""An entry whose samples are not there yet, and their number."""


def kind_of(data: bytes) -> Kind | None:
    """The kind of a message; None if it is of no known kind or version."""
    return _KINDS.get(data[1]) if len(data) >= 2 and data[0] == VERSION else None


def split_clocks(data: bytes) -> tuple[bytes, bytes]:
    """A message without the section of clocks at its end, and the section; empty if it has none."""
    return split_section(data) if len(data) > _HEADER.size and data[2] & _HAS_CLOCKS else (data, b"")


def read_message(data: bytes) -> Iterator[Heard | Text | None]:
    """A message, in parts if it is large, with each batch whole; None where other tasks may have their turn.

    Nothing of a malformed message is a part: all of it is decoded before the first one.

    Raises
    ------
    MalformedMessageError
        If the data are no message of this version.
    """
    kind = kind_of(data)
    if kind is None:
        raise MalformedMessageError("version", f"expected a message of version {VERSION}, got {data[:2]!r}")
    if kind in TEXTS:
        # Version and kind, and the number of a lookup, are before the JSON.
        if len(data) > MAX_TEXT + 2 + NUMBER:
            raise MalformedMessageError("oversized", f"a text of {len(data)} bytes, more than {MAX_TEXT}")
        yield Text(kind, data[2:])
        return
    if len(data) > MAX_BYTES:
        raise MalformedMessageError("oversized", f"{len(data)} bytes, more than {MAX_BYTES}")
    try:
        heard, end, told, tags, beliefs = yield from _read_head(kind, data)
    except (struct.error, IndexError):
        detail = f"the head of a message of {len(data)} bytes is cut off or inconsistent"
        raise MalformedMessageError("head", detail) from None
    except UnicodeDecodeError:
        raise MalformedMessageError("head", "a name in a message is no UTF-8") from None
    samples: list[FromLink | None] = []
    if tags or end < len(data):
        payload = data[end:]
        parts: Iterable[Decoded[ReceivedTransform]]
        if len(tags) <= _PART:
            parts = [decode(payload, tags, ReceivedTransform)]
        else:
            parts = decode_in_parts(payload, _PART, ReceivedTransform, tags=tags)
        for decoded in parts:
            if samples:
                yield None
            samples += decoded.samples
            heard.errors += decoded.errors
    for place, belief in beliefs.items():
        sample = samples[place]
        samples[place] = None if sample is None else _with_belief(sample, belief)
    place = size = 0
    for entry, count in told:
        if size >= _PART:
            heard.goes_on = True
            yield heard
            size, heard = 0, replace(heard, time=None, entries=[], errors=[], continues=True, goes_on=False)
        if isinstance(entry, ReceivedBatch):
            entry.samples = [*filter(None, samples[place : place + count])]
            place += count
        size += 1 + count
        heard.entries.append(entry)
    yield heard


def _read_head(
    kind: Kind, data: bytes
) -> Generator[None, None, tuple[Heard, int, list[_Told], list[tuple[str, bool]], dict[int, Belief]]]:
    """The part of a message before its samples.

    It ends with the message, which has no entries yet; the place of the samples; the entries, each with the number of
    its samples; the authority of each sample, and whether it is static; and the covariances, by the places of their
    samples.
    """
    _, _, flags, ways, origin_count, authority_count, entry_count, number, bus, *claimed = _HEADER.unpack_from(data)
    if entry_count > MAX_ENTRIES:
        raise MalformedMessageError("oversized", f"a message of {entry_count} entries, more than {MAX_ENTRIES}")
    since, sequence, digest = claimed
    if since > sequence or origin_count > entry_count or authority_count > MAX_SAMPLES:
        raise IndexError
    at, time = _HEADER.size, None
    if flags & _HAS_TIME:
        (time,) = _TIME.unpack_from(data, at)
        at += _TIME.size
    reach: list[Way] = []
    for _ in range(ways):
        length = data[at + _BUS]
        if length > LONGEST_WAY:
            raise IndexError
        path = [data[at + 1 + _BUS * (k + 1) : at + 1 + _BUS * (k + 2)] for k in range(length)]
        reach.append((data[at : at + _BUS], tuple(path)))
        at += _BUS * (length + 1) + 1
    origins = [_ORIGIN.unpack_from(data, at + _ORIGIN.size * k) for k in range(origin_count)]
    at += _ORIGIN.size * origin_count
    # The tags by the numbers that samples have for them.
    named: list[tuple[str, bool]] = []
    for _ in range(authority_count):
        (length,) = _LENGTH.unpack_from(data, at)
        at += _LENGTH.size
        # All messages share one string for each authority: it may be long, and each sample keeps it.
        authority = intern(data[at : at + length].decode())
        named += (authority, False), (authority, True)
        at += length
    told: list[_Told] = []
    tags: list[tuple[str, bool]] = []
    beliefs: dict[int, Belief] = {}
    # Each entry takes some bytes, so a false count ends the loop with an error before the list grows long.
    for index in range(entry_count):
        if index % _PART_OF_HEAD == _PART_OF_HEAD - 1:
            yield None
        entry_kind, origin, size, entry_number = _ENTRY.unpack_from(data, at)
        at += _ENTRY.size
        if entry_kind == _REMOVAL and size <= MAX_NAME:
            told.append((RemovedFrame(origins[origin][0], entry_number, data[at : at + size].decode()), 0))
            at += size
        elif entry_kind in (_BATCH, _UNCERTAIN):
            first = len(tags)
            if first + size > MAX_SAMPLES:
                raise MalformedMessageError("oversized", f"a message of more than {MAX_SAMPLES} samples")
            tags += map(named.__getitem__, struct.unpack_from(f"<{size}H", data, at))
            at += 2 * size
            for place in range(first, first + size) if entry_kind == _UNCERTAIN else ():
                belief, at = _read_belief(data, at)
                if belief is not None:
                    beliefs[place] = belief
                if len(beliefs) % _BELIEFS_AT_ONCE == _BELIEFS_AT_ONCE - 1:
                    yield None
            named_origin, clock = origins[origin]
            batch = ReceivedBatch(named_origin, entry_number, [], None if clock == _NO_CLOCK else clock)
            told.append((batch, size))
        else:
            raise IndexError
    # Slicing past the end raises nothing, so the end is checked.
    if at > len(data) or at > MAX_HEAD:
        raise IndexError
    claim = Claim(since, sequence, digest, bool(flags & _FINAL))
    heard = Heard(kind, bus, number, claim, time, reach, bool(flags & _SERVES))
    return heard, at, told, tags, beliefs


def _read_belief(data: bytes, at: int) -> tuple[Belief | None, int]:
    """The covariance and kind at a place of a head, if there is one, and the place behind it."""
    if not data[at]:
        return None, at + 1
    matrix = np.zeros((6, 6))
    matrix[_UPPER] = _COVARIANCE.unpack_from(data, at + 1)
    matrix.T[_UPPER] = matrix[_UPPER]
    try:
        belief = Belief(Covariance(matrix), KINDS[data[at] - 1])
    except ValueError as error:
        raise MalformedMessageError("head", f"a covariance of a message is none: {error}") from None
    return belief, at + 1 + _COVARIANCE.size


def _with_belief(sample: FromLink, belief: Belief) -> FromLink:
    found = ReceivedUncertain.__new__(ReceivedUncertain)
    found._fields, found.belief = sample._fields, belief
    return found


# Questions


@dataclass(slots=True)
class ChangesQuestion(PlainData):
    """A question for the changes of a copy.

    Attributes
    ----------
    since : int
        The asker knows the changes up to this sequence.
    frames : tuple of str or None
        The frames that the asker wants; None for all.
    """

    since: int
    frames: tuple[str, ...] | None

    def __post_init__(self) -> None:
        if self.since < 0:
            raise ValueError(f"a sequence is not negative, got {self.since}")


@dataclass(slots=True)
class PastQuestion(PlainData):
    """A question for the samples of the last `seconds`, of the frames whose names come after `after`."""

    seconds: float
    after: str


@dataclass(slots=True)
class RemoteQuestion(PlainData):
    """A lookup for the buffer of another process; the fields are the arguments of `tfbus.Buffer.lookup`.

    Attributes
    ----------
    hold : float or None
        The `max_age` of a `tfbus.Hold`, in s.
    """

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
    covariance: bool = False


def write_question(question: PlainData) -> bytes:
    """The bytes of a question."""
    # Without escapes: all names that `frames=` may have fit, in any script.
    text = json.dumps(question.to_dict(), ensure_ascii=False, separators=(",", ":"))
    return text.encode("utf-8", "surrogatepass")


def read_question(kind: type[QuestionT], data: bytes) -> QuestionT:
    """The question in some bytes.

    Raises
    ------
    MalformedMessageError
        If they are no such question, or it has an integer of more than 64 bits or a name of more than `MAX_NAME` bytes.
    """
    try:
        fields = _read(data)
        for name, value in fields.items():
            if isinstance(value, str) and len(value.encode()) > MAX_NAME:
                raise ValueError(f"its field {_shown(name)} has more than {MAX_NAME} bytes")
        return kind.from_dict(fields)
    except ValueError as error:
        raise MalformedMessageError("text", str(error)[:_SHOWN]) from None


# Answers of lookups


def write_answer(answer: TransformStamped | Exception) -> bytes:
    """The bytes of an answer, or of the error of a lookup: of another one if the answer is too large."""
    if isinstance(answer, (TransformStamped, TransformError)):
        data = json.dumps(answer.to_dict()).encode()
        if len(data) <= MAX_TEXT or not isinstance(answer, UncertainTransform):
            return data
        way = f"the way from {_shown(answer.parent)} to {_shown(answer.child)} has {len(answer.links)} edges"
        answer = ValueError(f"{way}, more than an answer with covariances can tell in {MAX_TEXT} bytes")
    kind = "TypeError" if isinstance(answer, TypeError) else "ValueError"
    return json.dumps({"type": kind, "message": str(answer)}).encode()


def read_answer(
    data: bytes, domain: str, robot: str | None, question: RemoteQuestion | None = None
) -> TransformStamped:
    """The answer in some bytes; with a question, an answer about other frames or another stamp is none.

    Raises
    ------
    TransformError, TypeError, ValueError
        The error in the bytes, if the lookup has failed.
    RemoteLookupError
        If the bytes are neither an answer nor such an error.
    """
    try:
        answer = _answer_of(_read(data))
        if question is not None and isinstance(answer, TransformStamped):
            _check_answers(answer, question)
    except Exception as error:  # noqa: BLE001 - the asker gets one kind of error for all bad answers
        detail = f"not an answer: {str(error)[:_SHOWN]}"
        raise RemoteLookupError(domain=domain, robot=robot, reason="malformed", detail=detail) from None
    if isinstance(answer, Exception):
        raise answer
    return answer


def _answer_of(fields: dict[str, Any]) -> TransformStamped | Exception:
    kind = fields.get("type")
    if kind == "TransformStamped":
        return (UncertainTransform if "edges" in fields else TransformStamped).from_dict(fields)
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
    if question.covariance and not isinstance(answer, UncertainTransform):
        raise ValueError("it has no covariance")


def _read(data: bytes) -> dict[str, Any]:
    """The JSON object in some bytes; raises `ValueError` if they are none, or beyond a bound."""
    try:
        fields = _decoder.decode(data.decode("utf-8", "surrogatepass"))
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


# `json.loads` would make one for each text.
_decoder = json.JSONDecoder(parse_int=_integer)


def _shown(name: str) -> str:
    return repr(name[: _SHOWN // 4])
