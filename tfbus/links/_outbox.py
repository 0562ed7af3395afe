"""The outbox of a link: what is published and removed gathers in it until the turn of the event loop ends."""

from collections.abc import Callable, Collection
from dataclasses import dataclass

from tfbus.geometry.stamped import TransformStamped
from tfbus.links._entries import MovingFrame, OutgoingBatch, RemovedFrame
from tfbus.links._state import LinkState, StateStep


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
    """

    entries: list[OutgoingBatch | RemovedFrame]
    statics: dict[str, OutgoingBatch | RemovedFrame | None]
    step: StateStep | None = None


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
        self._changes: dict[str, OutgoingBatch | RemovedFrame | None] = {}
        self._told = 0
        self._silent = False
        self.pending = 0
        self.state = LinkState()

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
        if self.state.static(frame) is not None:
            # A peer that is lost here may be present elsewhere, so its loss is no tombstone for others.
            self._changes[frame] = None if echo and removal.lost else removal
        # Those that hear of it by the link which brought the removal are told by that one.
        if brought or not echo:
            self._change(frame, removal, echo)
            self._notify()

    def flush(self) -> Turn:
        """Remove and return all that has gathered."""
        turn = Turn(self._entries, self._changes, self.step())
        self._entries, self._changes, self.pending = [], {}, 0
        self._told, self._silent = self.state.number, False
        return turn

    def step(self) -> StateStep:
        """What has changed of the state since the last turn."""
        # What no entry tells has to be asked for.
        since = self.state.number if self._silent else self._told
        return StateStep(since, self.state.number, self.state.digest)

    def _follow(self, batch: OutgoingBatch, echo: bool) -> bool:
        """Note the frames of a batch; returns whether anything changes for late joiners."""
        changed = False
        state = self.state
        for sample in batch.samples:
            _, child, _, _, _, static = sample._fields
            if not static and state.brings_moving(child):
                continue
            kept = state.static(child) is not None
            if static and (not echo or kept):
                if self._can_hold is None or self._can_hold(sample):
                    single = OutgoingBatch(batch.origin, batch.sequence, (sample,))
                    self._change(child, single, echo)
                    self._changes[child] = single
                    changed = True
                continue
            if kept:
                self._changes[child] = None
                changed = True
            if not echo:
                if self._can_hold is None or self._can_hold(sample):
                    self._change(child, MovingFrame(child), echo)
            elif state.brings(child):
                self._change(child, RemovedFrame(batch.origin, batch.sequence, child, lost=True), echo)
                changed = True
        return changed

    def _change(self, frame: str, entry: OutgoingBatch | MovingFrame | RemovedFrame, silent: bool) -> None:
        self.state.change(frame, entry)
        self._silent = self._silent or silent
