"""The numbered state of a link: what it brings to its domain, so that peers can tell whether they hold all of it.

The state has an entry for each frame that the link brings: the newest sample of a static one, the name of a moving one.
Each change has a number, one higher than that of the change before; the digest is over all entries. A peer that holds
the same number and the same digest holds the same state, and one that does not asks for the changes since a number.

A frame that has gone is a change too: a tombstone if it was removed, a release if the link does not bring it any more
because another one does. Their memory is bounded; a peer that asks for changes from before it gets the whole state.
"""

from bisect import bisect_right
from typing import NamedTuple

from tfbus.links._entries import MovingFrame, OutgoingBatch, RemovedFrame
from tfbus.links._hash import hash_bytes

MOST_GONE = 10_000
CHUNK = 500
"""So many changes are told at once."""
_SPARE = 1_000

StateEntry = OutgoingBatch | MovingFrame | RemovedFrame


class StateStep(NamedTuple):
    """The claim of a message that it tells all changes of a state behind one number, up to another.

    Attributes
    ----------
    since, number : int
    digest : int
        That of the state at `number`; 0 if `final` is not set.
    final : bool
        Whether `number` is that of the newest change.
    message : int
        The number of the newest live message before or with this claim.
    """

    since: int
    number: int
    digest: int
    final: bool = True
    message: int = 0


class LinkState:
    """The state of one link.

    Attributes
    ----------
    number : int
        That of the newest change.
    digest : int
        The exclusive or of `digest_of` over all frames that the link brings.
    """

    def __init__(self) -> None:
        self.number = 0
        self.digest = 0
        self._entries: dict[str, tuple[int, StateEntry]] = {}
        self._digests: dict[str, int] = {}
        self._log: list[tuple[int, str]] = []
        self._gone: dict[str, None] = {}
        self._forgotten = 0

    def entry(self, frame: str) -> StateEntry | None:
        """The entry of a frame; a `RemovedFrame` if it was removed."""
        entry = self._entries.get(frame)
        return None if entry is None else entry[1]

    def moving(self) -> list[str]:
        """The moving frames that the link brings."""
        return [frame for frame, (_, entry) in self._entries.items() if isinstance(entry, MovingFrame)]

    def brings(self, frame: str) -> bool:
        """Whether the link brings a frame."""
        return frame in self._digests

    def change(self, frame: str, entry: StateEntry) -> None:
        """Replace what is said of a frame."""
        self.digest ^= self._digests.pop(frame, 0)
        self._gone.pop(frame, None)
        if isinstance(entry, RemovedFrame):
            self._gone[frame] = None
        else:
            self._digests[frame] = digest = digest_of(frame, entry)
            self.digest ^= digest
        self.number += 1
        self._entries[frame] = self.number, entry
        self._log.append((self.number, frame))
        if len(self._gone) > MOST_GONE:
            oldest = next(iter(self._gone))
            del self._gone[oldest]
            self._forgotten = self._entries.pop(oldest)[0]
        if len(self._log) > 2 * len(self._entries) + _SPARE:
            self._log = [(number, frame) for number, frame in self._log if self._is_newest(number, frame)]

    def changes(self, since: int, limit: int = CHUNK) -> tuple[list[StateEntry], StateStep]:
        """The oldest changes behind a number, and the step that they are.

        A number that is too old, or that the state has not reached, gives the beginning of the whole state: a step
        since 0.
        """
        if since < self._forgotten or since > self.number:
            since = 0
        found: list[StateEntry] = []
        for place in range(bisect_right(self._log, since, key=lambda logged: logged[0]), len(self._log)):
            number, frame = self._log[place]
            if self._is_newest(number, frame):
                found.append(self._entries[frame][1])
                if len(found) == limit and number < self.number:
                    return found, StateStep(since, number, 0, final=False)
        return found, StateStep(since, self.number, self.digest)

    def _is_newest(self, number: int, frame: str) -> bool:
        entry = self._entries.get(frame)
        return entry is not None and entry[0] == number


def digest_of(frame: str, entry: OutgoingBatch | MovingFrame) -> int:
    """The share of a frame in a digest: 64 bits of its name, and of origin and number if it is static."""
    return (
        digest_static(frame, entry.origin, entry.sequence) if isinstance(entry, OutgoingBatch) else digest_moving(frame)
    )


def digest_static(frame: str, origin: bytes, sequence: int) -> int:
    """The share of a static frame in a digest."""
    return _digest(b"%b%d %b" % (origin, sequence, frame.encode("utf-8", "surrogatepass")))


def digest_moving(frame: str) -> int:
    """The share of a moving frame in a digest."""
    return _digest(frame.encode("utf-8", "surrogatepass"))


def _digest(data: bytes) -> int:
    return int.from_bytes(hash_bytes(data, 8), "little")
