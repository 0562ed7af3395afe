"""The outbox of a link: what is published and removed gathers in it until the turn of the event loop ends."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

from tfbus.geometry.stamped import TransformStamped


class OutgoingBatch:
    """Samples of one batch and one origin, as they go out.

    Attributes
    ----------
    origin : bytes
        The bus on which the batch was published first, 16 bytes.
    sequence : int
        The batch's number on that bus.
    samples : sequence of TransformStamped
    """

    __slots__ = ("origin", "samples", "sequence")

    def __init__(self, origin: bytes, sequence: int, samples: Sequence[TransformStamped]) -> None:
        self.origin = origin
        self.sequence = sequence
        self.samples = samples


@dataclass(frozen=True, slots=True)
class RemovedFrame:
    """A tombstone: a frame was removed, by the batch number `sequence` of the bus `origin`.

    With `lost`, the sender has lost the peer that brought the frame, so only what the sender itself brought is removed.
    """

    origin: bytes
    sequence: int
    frame: str
    lost: bool = False


@dataclass(slots=True)
class Turn:
    """All that one turn of the event loop has published and removed.

    Attributes
    ----------
    entries : list of OutgoingBatch or RemovedFrame
        In the order in which it happened.
    statics : dict of str to OutgoingBatch, RemovedFrame or None
        The static frames whose state for late joiners has changed: the newest sample of each as a batch of its own, its
        tombstone, or None if the frame is not to be kept any more.
    """

    entries: list[OutgoingBatch | RemovedFrame]
    statics: dict[str, OutgoingBatch | RemovedFrame | None]


class Outbox:
    """The sending half of a link.

    It also follows which static frames the link has sent, for the carrier keeps those for late joiners.

    Parameters
    ----------
    frames : collection of str or None
        The children that may go out; None for all.
    notify : callable
        Called when something was added.

    Attributes
    ----------
    pending : int
        How many samples and removals wait to go out.
    """

    def __init__(self, frames: Collection[str] | None, notify: Callable[[], object]) -> None:
        self._frames = frames
        self._notify = notify
        self._entries: list[OutgoingBatch | RemovedFrame] = []
        self._kept: set[str] = set()
        self._changes: dict[str, OutgoingBatch | RemovedFrame | None] = {}
        self.pending = 0

    def add_batch(self, batch: OutgoingBatch, echo: bool = False) -> None:
        """Add samples that were published.

        An echo, samples that came in by this very link, does not go out; it only replaces what is kept of frames that
        this link has sent before.
        """
        if self._frames is not None:
            wanted = tuple(sample for sample in batch.samples if sample.child in self._frames)
            if not wanted:
                return
            batch = OutgoingBatch(batch.origin, batch.sequence, wanted)
        if not echo:
            self._entries.append(batch)
            self.pending += len(batch.samples)
        if self._follow_statics(batch, echo) or not echo:
            self._notify()

    def add_removal(self, removal: RemovedFrame, echo: bool = False) -> None:
        """Add the removal of a frame; an echo only changes what is kept, as in `add_batch`."""
        frame = removal.frame
        if self._frames is not None and frame not in self._frames:
            return
        if not echo:
            self._entries.append(removal)
            self.pending += 1
        kept = frame in self._kept
        if kept:
            self._kept.remove(frame)
            # A peer that is lost here may be present elsewhere, so its loss is no tombstone for others.
            self._changes[frame] = None if echo and removal.lost else removal
        if kept or not echo:
            self._notify()

    def flush(self) -> Turn:
        """Remove and return all that has gathered."""
        turn = Turn(self._entries, self._changes)
        self._entries, self._changes, self.pending = [], {}, 0
        return turn

    def _follow_statics(self, batch: OutgoingBatch, echo: bool) -> bool:
        """Note the static frames of a batch; returns whether anything changes for late joiners."""
        changed = False
        for sample in batch.samples:
            _, child, _, _, _, static = sample._fields
            if static and (not echo or child in self._kept):
                self._kept.add(child)
                self._changes[child] = OutgoingBatch(batch.origin, batch.sequence, (sample,))
                changed = True
            elif child in self._kept:
                self._kept.remove(child)
                self._changes[child] = None
                changed = True
        return changed
