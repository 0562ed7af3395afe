"""The outbox of a link: what is published and removed gathers in it until the turn of the event loop ends."""

from collections.abc import Callable, Collection
from dataclasses import dataclass

from tfbus.geometry.stamped import TransformStamped
from tfbus.links._entries import MovingFrame, OutgoingBatch, RemovedFrame
from tfbus.links._state import LinkState, StateStep

_NO_ORIGIN = bytes(16)


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
    step : StateStep or None
        What the entries change of the link's state; for carriers whose peers ask for it.
    time : int or None
        The time of the clock that the link tells, in ns, if it has to be told. A turn may have nothing else.
    """

    entries: list[OutgoingBatch | RemovedFrame]
    statics: dict[str, OutgoingBatch | RemovedFrame | None]
    step: StateStep | None = None
    time: int | None = None


class Outbox:
    """The sending half of a link.

    It also follows which frames the link brings: late joiners, and peers that have missed something, are told those.

    Parameters
    ----------
    frames : collection of str or None
        The children that may go out; None for all.
    notify : callable
        Called when something was added.
    can_hold : callable, optional
        Whether a message can hold a sample; the state is to hold no other.

    Attributes
    ----------
    pending : int
        How many samples and removals wait to go out.
    state : LinkState
    """

    def __init__(
        self,
        frames: Collection[str] | None,
        notify: Callable[[], object],
        can_hold: Callable[[TransformStamped], bool] | None = None,
    ) -> None:
        self._frames = frames
        self._notify = notify
        self._can_hold = can_hold
        self._entries: list[OutgoingBatch | RemovedFrame] = []
        self._kept: set[str] = set()
        self._changes: dict[str, OutgoingBatch | RemovedFrame | None] = {}
        self._told = 0
        self._silent = False
        self._time: int | None = None
        self._time_waits = False
        self.pending = 0
        self.state = LinkState()

    def add_batch(self, batch: OutgoingBatch, echo: bool = False) -> None:
        """Add samples that were published.

        An echo, samples that came in by this very link, does not go out. Of frames that this link has sent before, it
        replaces what is kept, and takes them out of the link's state, for now another link brings them.
        """
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

    def add_removal(self, removal: RemovedFrame, echo: bool = False) -> None:
        """Add the removal of a frame; an echo only changes what is kept, as in `add_batch`."""
        frame = removal.frame
        if self._frames is not None and frame not in self._frames:
            return
        if not echo:
            self._entries.append(removal)
            self.pending += 1
        brought = self.state.brings(frame)
        kept = frame in self._kept
        if kept:
            self._kept.remove(frame)
            # A peer that is lost here may be present elsewhere, so its loss is no tombstone for others.
            self._changes[frame] = None if echo and removal.lost else removal
        # The link that brought the removal tells the peers that hear of it by that link.
        if brought or not echo:
            self._change(frame, removal, echo)
        if kept or brought or not echo:
            self._notify()

    @property
    def time(self) -> int | None:
        """The newest time that was told, in ns."""
        return self._time

    def tell_time(self, stamp: int) -> None:
        """Tell the time of a clock, in ns, with what is sent next."""
        self._time = stamp
        self._time_waits = True
        self._notify()

    def flush(self) -> Turn:
        """Remove and return all that has gathered."""
        turn = Turn(self._entries, self._changes, self.step(), self._time if self._time_waits else None)
        self._time_waits = False
        self._entries, self._changes, self.pending = [], {}, 0
        self._told, self._silent = self.state.number, False
        return turn

    def step(self) -> StateStep:
        """The changes of the state since the last turn."""
        # A peer asks for the removals that no entry tells.
        since = self.state.number if self._silent else self._told
        return StateStep(since, self.state.number, self.state.digest)

    def _follow(self, batch: OutgoingBatch, echo: bool) -> bool:
        """Note the frames of a batch; returns whether anything changes for late joiners."""
        changed = False
        for sample in batch.samples:
            _, child, _, _, _, static = sample._fields
            if static and (not echo or child in self._kept):
                self._kept.add(child)
                self._changes[child] = single = OutgoingBatch(batch.origin, batch.sequence, (sample,))
                if echo or not self._holds(sample):
                    self._release(child, echo)
                else:
                    self._change(child, single)
                changed = True
                continue
            if child in self._kept:
                self._kept.remove(child)
                self._changes[child] = None
                changed = True
            entry = self.state.entry(child)
            if not echo:
                if not isinstance(entry, MovingFrame) and self._holds(sample):
                    self._change(child, MovingFrame(child))
            elif static or not isinstance(entry, MovingFrame):
                changed = self._release(child, echo) or changed
        return changed

    def _holds(self, sample: TransformStamped) -> bool:
        return self._can_hold is None or self._can_hold(sample)

    def _release(self, frame: str, silent: bool) -> bool:
        """Bring a frame no more, if it was brought, because another link does; returns whether it was."""
        if not self.state.brings(frame):
            return False
        entry = self.state.entry(frame)
        # The number of what is lost, and not that of what has come in its place.
        origin, sequence = (entry.origin, entry.sequence) if isinstance(entry, OutgoingBatch) else (_NO_ORIGIN, 0)
        self._change(frame, RemovedFrame(origin, sequence, frame, lost=True), silent)
        return True

    def _change(self, frame: str, entry: OutgoingBatch | MovingFrame | RemovedFrame, silent: bool = False) -> None:
        self.state.change(frame, entry)
        self._silent = self._silent or silent
