"""The message that links of tfbus send each other: a TFMessage with its attachment.

Carriers between tfbus and tfbus share it; a carrier to another world has messages of that world.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

from tfbus.errors import InvalidTransformError
from tfbus.geometry.stamped import TransformStamped
from tfbus.links._attachment import PublishedBatch, pack, unpack
from tfbus.links._carrier import SendReport
from tfbus.links._inbox import ReceivedBatch, ReceivedMessage
from tfbus.links._outbox import OutgoingBatch, RemovedFrame
from tfbus.links._provenance import ReceivedTransform
from tfbus.tf_message import decode, encode, refusal

FULL_MESSAGE = 5_000
"""A message with so many samples and removals is full; the batch that fills it is still whole."""
MAX_BYTES = 2**22
"""The largest message that is sent or accepted: some 30,000 samples, which keep the receiver's loop for a while."""
_LONGEST_AUTHORITY = 65_535

_Entry = OutgoingBatch | RemovedFrame


@dataclass(frozen=True, slots=True)
class Message:
    """One message as it goes out: a TFMessage, its attachment, and the number of its samples."""

    payload: bytes
    attachment: bytes
    samples: int


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

    def write(self, entries: Sequence[_Entry]) -> list[Message]:
        """The messages that hold all entries in order; batches stay whole."""
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
            message = _message(entries, self._number + 1)
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
        if isinstance(entry, RemovedFrame):
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


def message_to_keep(entry: _Entry) -> Message | None:
    """A message without a number, to be kept for late joiners; None if no message can hold the entry."""
    try:
        return _message([entry], 0)
    except ValueError:
        # It could not go out live either, and was reported there.
        return None


def read_message(payload: bytes, attachment: bytes) -> ReceivedMessage:
    """The entries that a message holds.

    Raises
    ------
    MalformedMessageError
        If the attachment or the payload is malformed, or they do not fit together.
    """
    unpacked = unpack(attachment)
    decoded = decode(payload, unpacked.tags(), ReceivedTransform)
    entries = list(_received_entries(unpacked.entries, decoded.samples))
    return ReceivedMessage(entries, unpacked.number, decoded.errors)


def _received_entries(
    entries: Sequence[PublishedBatch | RemovedFrame], samples: Sequence[ReceivedTransform | None]
) -> Iterator[ReceivedBatch | RemovedFrame]:
    start = 0
    for entry in entries:
        if isinstance(entry, RemovedFrame):
            yield entry
            continue
        end = start + entry.count
        valid = [sample for sample in samples[start:end] if sample is not None]
        yield ReceivedBatch(valid, [authority for authority, _, _ in entry.runs], entry.origin, entry.sequence)
        start = end


def _message(entries: Sequence[_Entry], number: int) -> Message:
    """A message of all entries; raises `ValueError` if one message cannot hold them."""
    samples: list[TransformStamped] = []
    for entry in entries:
        if isinstance(entry, OutgoingBatch):
            samples += entry.samples
    payload = encode(samples)
    attachment = pack(number, [_published(entry) if isinstance(entry, OutgoingBatch) else entry for entry in entries])
    size = len(payload) + len(attachment)
    if size > MAX_BYTES:
        raise ValueError(f"a message of {len(samples)} samples has {size} bytes, more than {MAX_BYTES}")
    return Message(payload, attachment, len(samples))


def _published(batch: OutgoingBatch) -> PublishedBatch:
    tags = groupby(batch.samples, lambda sample: (sample.authority, sample.static))
    runs = tuple((authority, static, len(tuple(samples))) for (authority, static), samples in tags)
    return PublishedBatch(batch.origin, batch.sequence, runs)


def _size(entry: _Entry) -> int:
    return len(entry.samples) if isinstance(entry, OutgoingBatch) else 1


def _refusal(sample: TransformStamped) -> InvalidTransformError | None:
    """Why a sample cannot be in a message, or None if it can."""
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
