"""What one link has to send: gathered until the turn of the event loop ends, then made into messages."""

from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import dataclass
from itertools import groupby

from tfbus.errors import InvalidTransformError
from tfbus.geometry.stamped import TransformStamped
from tfbus.links.attachment import PublishedBatch, RemovedFrame, pack
from tfbus.links.relay import Piece
from tfbus.tf_message import encode, refusal

MAX_SAMPLES = 5_000
"""With so many, a message is full; the batch that fills it is still whole."""
MAX_BYTES = 2**22
"""The largest message that is sent, or taken by the other end: some 30,000 samples, which keep its loop for a while."""
_LONGEST_AUTHORITY = 65_535


@dataclass(frozen=True, slots=True)
class Message:
    """One message as it goes out: a TFMessage, and what goes beside it."""

    payload: bytes
    attachment: bytes
    samples: int


class Outbox:
    """The sending half of a link.

    Parameters
    ----------
    frames : collection of str or None
        The children that may go out; None for all.
    notify : callable
        Called when something has been added.
    refused : callable
        Called with an error for what cannot be put into a message.

    Attributes
    ----------
    pending : int
        How many samples and removals wait.
    statics : dict of str to Piece, RemovedFrame or None
        What has changed of the static frames: the newest sample of each, its tombstone, or None when it is not to be
        kept any more.
    not_sent : Counter
        Samples and removals that cannot be put into a message, by reason.
    """

    def __init__(
        self,
        frames: Collection[str] | None,
        notify: Callable[[], object],
        refused: Callable[[Exception], object],
    ) -> None:
        self._frames = frames
        self._notify = notify
        self._refused = refused
        self._entries: list[Piece | RemovedFrame] = []
        self._static: set[str] = set()
        self._changes: dict[str, Piece | RemovedFrame | None] = {}
        self._number = 0
        self.pending = 0
        self.statics: dict[str, Piece | RemovedFrame | None] = {}
        self.not_sent: Counter[str] = Counter()

    def take(self, piece: Piece, send: bool = True) -> None:
        """Add samples that were published; without `send`, only the static frames that were sent before follow them."""
        if self._frames is not None:
            wanted = tuple(sample for sample in piece.samples if sample.child in self._frames)
            if not wanted:
                return
            piece = Piece(piece.origin, piece.sequence, wanted)
        if send:
            self._entries.append(piece)
            self.pending += len(piece.samples)
        if self._note_statics(piece, send) or send:
            self._notify()

    def remove(self, origin: bytes, sequence: int, frame: str, lost: bool = False, send: bool = True) -> None:
        """Add that a frame was removed; without `send`, only for what is kept of it."""
        if self._frames is not None and frame not in self._frames:
            return
        entry = RemovedFrame(origin, sequence, frame, lost)
        if send:
            self._entries.append(entry)
            self.pending += 1
        kept = frame in self._static
        if kept:
            self._static.remove(frame)
            # Who is lost at this end may be there for others.
            self._changes[frame] = entry if send or not lost else None
        if kept or send:
            self._notify()

    def flush(self) -> list[Message]:
        """All that has gathered, as live messages, in order; batches stay whole."""
        self.statics.update(self._changes)
        self._changes.clear()
        entries, self._entries, self.pending = self._entries, [], 0
        messages: list[Message] = []
        gathered: list[Piece | RemovedFrame] = []
        size = 0
        for entry in entries:
            gathered.append(entry)
            size += _size(entry)
            if size >= MAX_SAMPLES:
                messages += self._messages(gathered)
                gathered, size = [], 0
        return messages + self._messages(gathered) if gathered else messages

    def take_statics(self, most: int) -> dict[str, Message | None]:
        """Take out some of `statics`; the link keeps the last message of each for those who join late."""
        changes: dict[str, Message | None] = {}
        while self.statics and len(changes) < most:
            frame = next(iter(self.statics))
            entry = self.statics.pop(frame)
            try:
                changes[frame] = None if entry is None else _message([entry], 0)
            except ValueError:
                # It could not go out live either, where it was counted.
                continue
        return changes

    def _note_statics(self, piece: Piece, send: bool) -> bool:
        """Whether anything changes for late joiners."""
        changed = False
        for sample in piece.samples:
            _, child, _, _, _, static = sample._fields
            if static and (send or child in self._static):
                self._static.add(child)
                self._changes[child] = Piece(piece.origin, piece.sequence, (sample,))
                changed = True
            elif child in self._static:
                self._static.remove(child)
                self._changes[child] = None
                changed = True
        return changed

    def _messages(self, entries: list[Piece | RemovedFrame]) -> list[Message]:
        """One message of all entries if that can be; what cannot be sent at all is left out and counted."""
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
        self._refuse("oversized", failure, _size(entries[0]))
        return []

    def _sendable(self, entry: Piece | RemovedFrame) -> Piece | RemovedFrame | None:
        """What can be sent of an entry by itself: the same if that is all, None if it is nothing."""
        if isinstance(entry, RemovedFrame):
            try:
                pack(0, [entry])
            except ValueError as error:
                self._refuse("frame name", error, 1)
                return None
            return entry
        errors = list(map(_refusal, entry.samples))
        if not any(errors):
            return entry
        for refused in filter(None, errors):
            self._refuse(refused.reason, refused, 1)
        kept = tuple(sample for sample, error in zip(entry.samples, errors, strict=True) if error is None)
        return Piece(entry.origin, entry.sequence, kept) if kept else None

    def _refuse(self, reason: str, error: Exception, count: int) -> None:
        self.not_sent[reason] += count
        self._refused(error)


def _message(entries: list[Piece | RemovedFrame], number: int) -> Message:
    """A message of all entries; `ValueError` if that cannot be."""
    samples: list[TransformStamped] = []
    for entry in entries:
        if isinstance(entry, Piece):
            samples += entry.samples
    payload = encode(samples)
    attachment = pack(number, [_batch(entry) if isinstance(entry, Piece) else entry for entry in entries])
    size = len(payload) + len(attachment)
    if size > MAX_BYTES:
        raise ValueError(f"a message of {len(samples)} samples has {size} bytes, more than {MAX_BYTES}")
    return Message(payload, attachment, len(samples))


def _batch(piece: Piece) -> PublishedBatch:
    tags = groupby(piece.samples, lambda sample: (sample.authority, sample.static))
    runs = tuple((authority, static, len(tuple(samples))) for (authority, static), samples in tags)
    return PublishedBatch(piece.origin, piece.sequence, runs)


def _size(entry: Piece | RemovedFrame) -> int:
    return len(entry.samples) if isinstance(entry, Piece) else 1


def _refusal(sample: TransformStamped) -> InvalidTransformError | None:
    """Why a sample cannot be sent, or None if it can."""
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
