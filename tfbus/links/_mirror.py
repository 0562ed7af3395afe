"""The state of a peer as far as it has told it, and whether that is all of it."""

from tfbus.links._entries import MovingFrame, RemovedFrame
from tfbus.links._state import StateStep, digest_moving, digest_static


class Mirror:
    """The state of one peer, as far as this end has been told.

    It is told by live messages, which tell every change, and by answers to questions for what live messages did not
    bring. It does not say what became of the frames here.

    Parameters
    ----------
    capacity : int
        How many frames it follows; a peer that brings more is not asked any more.

    Attributes
    ----------
    number : int
        All changes of the peer's state up to this one were told; the next question is for those behind it.
    agrees : bool
        Whether all was told that the peer has claimed, and the digests are equal.
    overfull : bool
        Whether the peer has brought more frames than the mirror follows.
    """

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._digests: dict[str, int] = {}
        self._moving: set[str] = set()
        self._digest = 0
        self._claimed = 0
        self._claimed_when_asked = 0
        self._torn = False
        self._whole = False
        self.number = 0
        self.agrees = False
        self.overfull = False

    def __contains__(self, frame: object) -> bool:
        return frame in self._digests

    def static(self, frame: str, origin: bytes, sequence: int) -> None:
        """The peer has a static frame."""
        self._moving.discard(frame)
        self._set(frame, digest_static(frame, origin, sequence))

    def has_moving(self, frame: str) -> bool:
        """Whether the peer is known to have a frame that moves."""
        return frame in self._moving

    def moving(self, frame: str) -> None:
        """The peer has a moving frame."""
        self._set(frame, digest_moving(frame))
        if frame in self._digests:
            self._moving.add(frame)

    def gone(self, frame: str) -> None:
        """The peer has a frame no more."""
        self._moving.discard(frame)
        self._digest ^= self._digests.pop(frame, 0)

    def entry(self, entry: MovingFrame | RemovedFrame) -> None:
        """Note an entry without a sample."""
        if isinstance(entry, RemovedFrame):
            self.gone(entry.frame)
        else:
            self.moving(entry.frame)

    def lost_message(self) -> None:
        """A live message is missing, so the next claim of a live message is not believed."""
        self._torn = True

    def claimed(self, step: StateStep) -> None:
        """A live message, whose entries were noted, claims to tell the peer's state up to a number."""
        if step.number < self._claimed:
            # It was overtaken.
            return
        self._claimed = step.number
        if step.since <= self.number and not self._torn:
            self.number = max(self.number, step.number)
        self._torn = False
        self._compare(step)

    def asks(self) -> int:
        """The number behind which the peer is asked for changes now."""
        self._claimed_when_asked = self._claimed
        return self.number

    def begins_anew(self) -> None:
        """The peer tells its whole state from the beginning."""
        self._digests.clear()
        self._moving.clear()
        self._digest = self.number = 0
        self._whole = True
        self.overfull = False

    def answered(self, step: StateStep) -> None:
        """An answer, whose entries were noted, has told the changes up to a number."""
        self.number = step.number
        if step.final:
            if self._claimed == self._claimed_when_asked:
                # A number that the peer does not know was made up.
                self._claimed = step.number
            self._compare(step)

    def take_whole(self) -> bool:
        """Whether the whole state was told since this was asked last; only then is what is not in it gone."""
        whole, self._whole = self._whole, False
        return whole

    def _compare(self, step: StateStep) -> None:
        complete = self.number == step.number == self._claimed
        self.agrees = complete and self._digest == step.digest
        if complete and not self.agrees:
            self.number = 0

    def _set(self, frame: str, digest: int) -> None:
        if len(self._digests) >= self._capacity and frame not in self._digests:
            self.overfull = True
            return
        self._digest ^= self._digests.get(frame, 0) ^ digest
        self._digests[frame] = digest
