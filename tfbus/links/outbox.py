"""What one link has to send: gathered until the turn of the event loop ends, then made into messages."""

from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import dataclass
from itertools import groupby, islice

from tfbus.errors import InvalidTransformError
from tfbus.links.attachment import PublishedBatch, RemovedFrame, pack
from tfbus.links.relay import Piece
from tfbus.stamped import TransformStamped
from tfbus.tf_message import encode, refusal

MAX_SAMPLES = 5_000


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
        How many samples wait.
    statics : dict of str to Message or None
        What has changed of the static frames: the newest message of each, or None when it has become a moving one.
    not_sent : Counter
        Samples that cannot be put into a message, by reason.
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
        self._number = 0
        self.pending = 0
        self.statics: dict[str, Message | None] = {}
        self.not_sent: Counter[str] = Counter()

    def take(self, piece: Piece) -> None:
        """Add samples that were published."""
        if self._frames is not None:
            wanted = tuple(sample for sample in piece.samples if sample.child in self._frames)
            if not wanted:
                return
            piece = Piece(piece.origin, piece.sequence, wanted)
        self._entries.append(piece)
        self.pending += len(piece.samples)
        self._notify()

    def remove(self, origin: bytes, sequence: int, frame: str) -> None:
        """Add that a frame was removed."""
        if self._frames is None or frame in self._frames:
            self._entries.append(RemovedFrame(origin, sequence, frame))
            self.pending += 1
            self._notify()

    def flush(self) -> list[Message]:
        """All that has gathered, as live messages, in order; batches stay whole."""
        entries, self._entries, self.pending = self._entries, [], 0
        messages: list[Message] = []
        gathered: list[Piece | RemovedFrame] = []
        size = 0
        for entry in entries:
            gathered.append(entry)
            size += len(entry.samples) if isinstance(entry, Piece) else 1
            if size >= MAX_SAMPLES:
                messages += self._messages(gathered)
                gathered, size = [], 0
        return messages + self._messages(gathered) if gathered else messages

    def take_statics(self, most: int) -> dict[str, Message | None]:
        """Take out some of `statics`; the link keeps the last message of each for those who join late."""
        frames = list(islice(self.statics, most))
        return {frame: self.statics.pop(frame) for frame in frames}

    def _messages(self, entries: list[Piece | RemovedFrame]) -> list[Message]:
        """One message of all entries if that can be; what cannot be sent at all is left out and counted."""
        try:
            return [self._message(entries)]
        except InvalidTransformError:
            sendable = [self._sendable(entry) if isinstance(entry, Piece) else entry for entry in entries]
            kept = [entry for entry in sendable if entry is not None]
            return self._messages(kept) if kept else []
        except ValueError as error:
            if len(entries) > 1:
                middle = len(entries) // 2
                return self._messages(entries[:middle]) + self._messages(entries[middle:])
            self._refuse("attachment", error, len(entries[0].samples) if isinstance(entries[0], Piece) else 1)
            return []

    def _message(self, entries: list[Piece | RemovedFrame]) -> Message:
        samples: list[TransformStamped] = []
        for entry in entries:
            if isinstance(entry, Piece):
                samples += entry.samples
        payload = encode(samples)
        parts = [_batch(entry) if isinstance(entry, Piece) else entry for entry in entries]
        attachment = pack(self._number + 1, parts)
        self._number += 1
        for entry in entries:
            self._note_static(entry)
        return Message(payload, attachment, len(samples))

    def _note_static(self, entry: Piece | RemovedFrame) -> None:
        if isinstance(entry, RemovedFrame):
            if entry.frame in self._static:
                self._static.remove(entry.frame)
                self.statics[entry.frame] = Message(encode(()), pack(0, [entry]), 0)
            return
        for sample in entry.samples:
            if sample.static:
                alone = Piece(entry.origin, entry.sequence, (sample,))
                self._static.add(sample.child)
                self.statics[sample.child] = Message(encode(alone.samples), pack(0, [_batch(alone)]), 1)
            elif sample.child in self._static:
                self._static.remove(sample.child)
                self.statics[sample.child] = None

    def _sendable(self, piece: Piece) -> Piece | None:
        kept = []
        for sample in piece.samples:
            error = refusal(sample)
            if error is None:
                kept.append(sample)
            else:
                self._refuse(error.reason, error, 1)
        return Piece(piece.origin, piece.sequence, tuple(kept)) if kept else None

    def _refuse(self, reason: str, error: Exception, count: int) -> None:
        self.not_sent[reason] += count
        self._refused(error)


def _batch(piece: Piece) -> PublishedBatch:
    tags = groupby(piece.samples, lambda sample: (sample.authority, sample.static))
    runs = tuple((authority, static, len(tuple(samples))) for (authority, static), samples in tags)
    return PublishedBatch(piece.origin, piece.sequence, runs)
