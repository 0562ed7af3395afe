"""The outbox of a link, in which batches and removals gather until the turn of the event loop ends."""

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass

from tfbus.geometry.stamped import TransformStamped

Rank = tuple[int, bytes]
"""Number and origin. Of two things that are said of one frame, the one of the higher rank holds."""
LOWEST: Rank = (-1, b"")


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
    """A frame was removed, by the batch number `sequence` of the bus `origin`."""

    origin: bytes
    sequence: int
    frame: str


@dataclass(slots=True)
class Turn:
    """All that one turn of the event loop has published and removed.

    Attributes
    ----------
    entries : list of OutgoingBatch or RemovedFrame
        In the order in which it happened.
    statics : dict of str to TransformStamped or None
        The static frames whose state for late joiners has changed, for networks that keep messages for these: the
        newest sample of each, or None if the frame is not to be kept any more.
    time : int or None
        The time of the clock that the link tells, in ns, if it has to be told. A turn may have nothing else.
    """

    entries: list[OutgoingBatch | RemovedFrame]
    statics: dict[str, TransformStamped | None]
    time: int | None = None


class Outbox:
    """The sending half of a link.

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
    time : int or None
        The time of the clock that was told last, in ns.
    """

    def __init__(self, frames: Collection[str] | None, notify: Callable[[], object]) -> None:
        self._frames = frames
        self._notify = notify
        self._entries: list[OutgoingBatch | RemovedFrame] = []
        self._time_waits = False
        self.pending = 0
        self.time: int | None = None

    def add_batch(self, batch: OutgoingBatch, echo: bool = False) -> None:
        """Add samples that were published; an echo, samples that came in by this very link, does not go out."""
        if self._frames is not None:
            wanted = tuple(sample for sample in batch.samples if sample.child in self._frames)
            if not wanted:
                return
            batch = OutgoingBatch(batch.origin, batch.sequence, wanted)
        if not echo:
            self._entries.append(batch)
            self.pending += len(batch.samples)
        if self._follow(batch, echo) or not echo:
            self._notify()

    def add_removal(self, removal: RemovedFrame, echo: bool = False, withdrawn: bool = False) -> None:
        """Add the removal of a frame; it goes out as batches do.

        A frame is withdrawn rather than removed if it left this bus only because its owner was lost.
        """
        if self._frames is not None and removal.frame not in self._frames:
            return
        goes_out = not echo and not (withdrawn and self.keeps_withdrawn)
        if goes_out:
            self._entries.append(removal)
            self.pending += 1
        if self._follow_removal(removal.frame, (removal.sequence, removal.origin) if goes_out else None) or goes_out:
            self._notify()

    def tell_time(self, stamp: int) -> None:
        """Tell the time of a clock, in ns, with what is sent next."""
        self.time = stamp
        self._time_waits = True
        self._notify()

    def flush(self) -> Turn:
        """Remove and return all that has gathered."""
        turn = Turn(self._entries, self._take_statics(), self.time if self._time_waits else None)
        self._time_waits = False
        self._entries, self.pending = [], 0
        return turn

    keeps_withdrawn = False
    """Whether the other ends see for themselves that the owner of a frame was lost."""

    def keep(self, entry: OutgoingBatch | RemovedFrame) -> None:
        """Note what another link knows and is not, or no more, on this bus, for whoever shows it."""

    def kept(self) -> Iterable[OutgoingBatch | RemovedFrame]:
        """All that is known by this link, for another one that begins later."""
        return ()

    def own_sample(self, _frame: str, /) -> TransformStamped | None:
        """The newest sample of a frame that this bus has to say again if somebody has outnumbered it."""
        return None

    def ways(self) -> Iterable[tuple[bytes, tuple[bytes, ...]]]:
        """The buses that the peers of this link lead to, each with the buses on the way there."""
        return ()

    def reach_changed(self) -> None:
        """The buses that this one reaches by other links have changed."""

    def _follow(self, batch: OutgoingBatch, echo: bool) -> bool:
        """Note the frames of a batch for late joiners; returns whether anything changes for these."""
        raise NotImplementedError

    def _follow_removal(self, frame: str, rank: Rank | None) -> bool:
        """Note for late joiners that a frame has gone; returns whether anything changes for these.

        There is no rank if the other ends know it, because they have said so or see that its owner was lost.
        """
        raise NotImplementedError

    def _take_statics(self) -> dict[str, TransformStamped | None]:
        return {}


class LatchingOutbox(Outbox):
    """The outbox of a link to a world that keeps messages with static frames for late joiners, as ROS does.

    Of frames that this link has sent before, an echo replaces what is kept, for now another link brings them.
    """

    def __init__(self, frames: Collection[str] | None, notify: Callable[[], object]) -> None:
        super().__init__(frames, notify)
        self._kept: set[str] = set()
        self._changes: dict[str, TransformStamped | None] = {}

    def _follow(self, batch: OutgoingBatch, echo: bool) -> bool:
        changed = False
        for sample in batch.samples:
            _, child, _, _, _, static = sample._fields
            if static and (not echo or child in self._kept):
                self._kept.add(child)
                self._changes[child] = sample
                changed = True
            elif not static and child in self._kept:
                self._kept.remove(child)
                self._changes[child] = None
                changed = True
        return changed

    def _follow_removal(self, frame: str, rank: Rank | None) -> bool:
        del rank
        if frame not in self._kept:
            return False
        self._kept.remove(frame)
        self._changes[frame] = None
        return True

    def _take_statics(self) -> dict[str, TransformStamped | None]:
        changes, self._changes = self._changes, {}
        return changes
