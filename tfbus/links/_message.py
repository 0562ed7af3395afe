"""The message that links of tfbus send each other: a TFMessage with its attachment.

Carriers between tfbus and tfbus share it; a carrier to another world has messages of that world.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

from tfbus.errors import InvalidTransformError
from tfbus.geometry.stamped import TransformStamped
from tfbus.links._attachment import Attachment, PublishedBatch, pack, unpack
from tfbus.links._carrier import SendReport
from tfbus.links._entries import MovingFrame, OutgoingBatch, RemovedFrame
from tfbus.links._inbox import ReceivedBatch, ReceivedMessage
from tfbus.links._provenance import ReceivedTransform
from tfbus.links._state import StateStep
from tfbus.tf_message import MIN_SIZE, MalformedMessageError, decode, decode_in_parts, encode, refusal

FULL_MESSAGE = 5_000
"""A message with so many samples and removals is full; the batch that fills it is still whole."""
MAX_BYTES = 2**22
"""The largest message that is sent or accepted."""
MAX_SAMPLES = 10_000
"""The largest batch that is sent or accepted: a bus publishes it in one turn of the loop, all or nothing."""
MOST_AT_ONCE = 5_000
"""So many samples of an answer are decoded in one turn."""
_LARGE_PAYLOAD, _LARGE_ATTACHMENT = 2**15, 2**12
"""Bytes; a message beyond one of them is read in parts."""
_PART = 200
"""So many samples, or entries, of a large message are decoded, or handled, before other tasks may have their turn."""
_LONGEST_AUTHORITY = 65_535

_Entry = OutgoingBatch | RemovedFrame | MovingFrame


@dataclass(frozen=True, slots=True)
class Message:
    """One message as it goes out: a TFMessage, its attachment, the number of its samples, and its own if it is live."""

    payload: bytes
    attachment: bytes
    samples: int
    number: int = 0


class MessageWriter:
    """Writes the live messages of one link, numbered 1, 2, 3.

    Parameters
    ----------
    report : SendReport
        Is told of what cannot be in a message.
    """

    def __init__(self, report: SendReport) -> None:
        self._report = report
        self._number = 0
        self._time: int | None = None

    def write(self, entries: Sequence[_Entry], step: StateStep | None = None, time: int | None = None) -> list[Message]:
        """The messages that hold all entries in order, and the step that they are; batches stay whole.

        A time of the clock, in ns, is in these messages and in all later ones, until there is another one.
        """
        if time is not None:
            self._time = time
        if step is None:
            return self._write(entries)
        if sum(map(_size, entries)) < FULL_MESSAGE:
            try:
                message = _message(entries, self._number + 1, step._replace(message=self._number + 1), self._time)
            except ValueError:
                # Written below once more, without what cannot be sent.
                pass
            else:
                self._number += 1
                return [message]
        return [*self._write(entries), self.claim(step)]

    def skip(self, time: int | None = None) -> None:
        """Write nothing of a turn, because nobody hears it; whoever has heard the last message will see the gap."""
        self._number += 1
        if time is not None:
            self._time = time

    def claim(self, step: StateStep) -> Message:
        """A message without a number and without entries, which claims a state."""
        return _message([], 0, step._replace(message=self._number), self._time)

    def _write(self, entries: Sequence[_Entry]) -> list[Message]:
        messages: list[Message] = []
        gathered: list[_Entry] = []
        size = 0
        for entry in entries:
            gathered.append(entry)
            size += _size(entry)
            if size >= FULL_MESSAGE:
                messages += self._messages(gathered)
                gathered, size = [], 0
        return messages + self._messages(gathered) if gathered else messages

    def _messages(self, entries: list[_Entry]) -> list[Message]:
        """One message of all entries if possible, else several; what cannot be sent is left out and reported."""
        try:
            message = _message(entries, self._number + 1, time=self._time)
        except ValueError as error:
            failure: Exception = error
        else:
            self._number += 1
            return [message]
        sendable = [kept for kept in map(self._sendable, entries) if kept is not None]
        if sendable != entries:
            return self._messages(sendable) if sendable else []
        if len(entries) > 1:
            middle = len(entries) // 2
            return self._messages(entries[:middle]) + self._messages(entries[middle:])
        self._report.refused("oversized", failure, _size(entries[0]))
        return []

    def _sendable(self, entry: _Entry) -> _Entry | None:
        """The part of an entry that a message can hold: the entry itself if that is all, None if it is nothing."""
        if not isinstance(entry, OutgoingBatch):
            try:
                pack(0, [entry])
            except ValueError as error:
                self._report.refused("frame name", error)
                return None
            return entry
        errors = list(map(_refusal, entry.samples))
        if not any(errors):
            return entry
        for refused in filter(None, errors):
            self._report.refused(refused.reason, refused)
        kept = tuple(sample for sample, error in zip(entry.samples, errors, strict=True) if error is None)
        return OutgoingBatch(entry.origin, entry.sequence, kept) if kept else None


def can_hold(sample: TransformStamped) -> bool:
    """Whether a message can hold a sample."""
    return _refusal(sample) is None


def write_answer(entries: Sequence[_Entry], step: StateStep) -> Message:
    """The answer to a question for changes of a state; each of the entries has to fit into a message.

    Raises
    ------
    ValueError
        If one message cannot hold all of them.
    """
    return _message(entries, 0, step)


def read_message(payload: bytes, attachment: bytes) -> ReceivedMessage:
    """The entries that a message holds.

    Raises
    ------
    MalformedMessageError
        If the attachment or the payload is malformed, or they do not fit together.
    """
    unpacked = unpack(attachment)
    _check_count(unpacked, payload, MOST_AT_ONCE)
    decoded = decode(payload, unpacked.tags(), ReceivedTransform)
    entries = list(_received_entries(unpacked.entries, decoded.samples))
    return ReceivedMessage(entries, unpacked.number, decoded.errors, unpacked.step, unpacked.time)


def is_large(payload: bytes, attachment: bytes) -> bool:
    """Whether a message takes too long for one turn of the event loop."""
    return len(payload) > _LARGE_PAYLOAD or len(attachment) > _LARGE_ATTACHMENT


def read_message_in_parts(payload: bytes, attachment: bytes) -> Iterator[ReceivedMessage | None]:
    """The entries that a large message holds, some at a time, with each batch whole; first None for each turn.

    Nothing of a malformed message is a part: all of it is decoded before the first one.

    Raises
    ------
    MalformedMessageError
        As `read_message`.
    """
    unpacked = unpack(attachment)
    _check_count(unpacked, payload, MAX_SAMPLES)
    yield None
    samples: list[ReceivedTransform | None] = []
    errors: list[InvalidTransformError] = []
    for decoded in decode_in_parts(payload, _PART, ReceivedTransform, tags=unpacked.tags()):
        samples += decoded.samples
        errors += decoded.errors
        yield None
    gathered: list[ReceivedBatch | RemovedFrame | MovingFrame] = []
    size, continues, time = 0, False, unpacked.time
    for entry in _received_entries(unpacked.entries, samples):
        if size >= _PART:
            yield ReceivedMessage(gathered, unpacked.number, errors, unpacked.step, time, continues, goes_on=True)
            gathered, size, errors, continues, time = [], 0, [], True, None
        gathered.append(entry)
        size += 1 + (len(entry.samples) if isinstance(entry, ReceivedBatch) else 0)
    yield ReceivedMessage(gathered, unpacked.number, errors, unpacked.step, time, continues)


def _check_count(attachment: Attachment, payload: bytes, most: int) -> None:
    count = sum(entry.count for entry in attachment.entries if isinstance(entry, PublishedBatch))
    # A number that the payload cannot hold is malformed, and is told as such.
    if most < count <= len(payload) // MIN_SIZE:
        raise MalformedMessageError("oversized", f"a message of {count} samples, more than {most}")


def _received_entries(
    entries: Sequence[PublishedBatch | RemovedFrame | MovingFrame], samples: Sequence[ReceivedTransform | None]
) -> Iterator[ReceivedBatch | RemovedFrame | MovingFrame]:
    start = 0
    for entry in entries:
        if not isinstance(entry, PublishedBatch):
            yield entry
            continue
        end = start + entry.count
        valid = [sample for sample in samples[start:end] if sample is not None]
        yield ReceivedBatch(valid, [authority for authority, _, _ in entry.runs], entry.origin, entry.sequence)
        start = end


def _message(entries: Sequence[_Entry], number: int, step: StateStep | None = None, time: int | None = None) -> Message:
    """A message of all entries; raises `ValueError` if one message cannot hold them."""
    samples: list[TransformStamped] = []
    for entry in entries:
        if isinstance(entry, OutgoingBatch):
            samples += entry.samples
    payload = encode(samples)
    published = [_published(entry) if isinstance(entry, OutgoingBatch) else entry for entry in entries]
    attachment = pack(number, published, step, time)
    size = len(payload) + len(attachment)
    if len(samples) > MAX_SAMPLES:
        raise ValueError(f"a message of {len(samples)} samples, more than {MAX_SAMPLES}")
    if size > MAX_BYTES:
        raise ValueError(f"a message of {len(samples)} samples has {size} bytes, more than {MAX_BYTES}")
    return Message(payload, attachment, len(samples), number)


def _published(batch: OutgoingBatch) -> PublishedBatch:
    tags = groupby(batch.samples, lambda sample: (sample.authority, sample.static))
    runs = tuple((authority, static, len(tuple(samples))) for (authority, static), samples in tags)
    return PublishedBatch(batch.origin, batch.sequence, runs)


def _size(entry: _Entry) -> int:
    return len(entry.samples) if isinstance(entry, OutgoingBatch) else 1


def _refusal(sample: TransformStamped) -> InvalidTransformError | None:
    """The reason why a sample cannot be in a message; None if it can."""
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
