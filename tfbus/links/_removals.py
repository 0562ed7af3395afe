"""The memory of frames that have gone from a bus, by which the relay tells what of them is news."""

from typing import NamedTuple

from tfbus.links._peers import next_age
from tfbus.links._provenance import LOWEST, Provenance, Rank

_REMEMBERED = 10_000
_REMEMBERED_ORIGINS = 1_000


class _Gone(NamedTuple):
    """The newest sample of one origin that a frame had: its number; and, if it was lost, when and who told of it."""

    sequence: int
    lost_at: int | None = None
    told_by: str = ""


class Removals:
    """Tells of frames that are not there whether their samples are news, or come too late.

    A *removal* is somebody's word that a frame is not to be there. Of two things that are said of a frame, that of the
    higher rank holds, so a removal outdates all samples below it, whoever brings them.

    A *loss* is less: a bus that has lost a peer tells those to whom it brought the frame that it cannot bring it any
    more. It has a number too, higher than that of the frame. The frame may be lost for good, and copies of it still on
    their way; buses that took it from each other would then keep it for ever. Or only one of several ways to its owner,
    the bus that has published it, is lost. No bus can tell these apart but by the owner, as in DSDV (Perkins and
    Bhagwat, "Highly dynamic destination-sequenced distance-vector routing", 1994). So this is the rule:

    1. A bus that hears of a loss lets the frame go if the teller was the last to bring it, and tells of the loss
       itself. If it has the frame on another way, it keeps it, and passes the loss on there, towards the owner.
    2. The number that was lost is news again from the peer that told of the loss and from peers met later, for those
       have it anew. From all others it counts as a late copy.
    3. A bus that refuses a static sample as a late copy tells of the loss again, to those who have brought the copy;
       and to those who have told it a copy before, when it loses the frame.
    4. An owner that hears of a loss with a higher number than that of its static sample says the sample again, with a
       number above that of the loss; so it is news to all.

    Hence a static frame that was lost comes back as soon as its owner is reached on any way, and not without it. A
    moving frame has higher numbers with its next samples, and needs none of this.

    The memory is bounded: of what leaves it, only the highest number of each origin is remembered, and live samples of
    unknown frames below that number count as late.

    Attributes
    ----------
    ranks : dict of str to (int, bytes)
        The ranks of the newest removals; no losses.
    """

    def __init__(self) -> None:
        self.ranks: dict[str, Rank] = {}
        self._gone: dict[tuple[bytes, str], _Gone] = {}
        self._late_up_to: dict[bytes, int] = {}

    def __len__(self) -> int:
        return len(self.ranks) + len(self._gone) + len(self._late_up_to)

    def clear(self) -> None:
        """Forget everything."""
        for memory in (self.ranks, self._gone, self._late_up_to):
            memory.clear()

    def rank(self, frame: str) -> Rank:
        """The rank of a frame's newest removal; the lowest one if none is remembered."""
        return self.ranks.get(frame, LOWEST)

    def is_late(self, provenance: Provenance, frame: str) -> bool:
        """Whether a sample of a frame that is not there comes too late."""
        gone = self._gone.get((provenance.origin, frame))
        if gone is None:
            # A sample that is kept for late joiners holds now, however old it is.
            return provenance.live and provenance.sequence <= self._late_up_to.get(provenance.origin, -1)
        if gone.sequence == provenance.sequence and gone.lost_at is not None and provenance.peer is not None:
            return provenance.peer.age < gone.lost_at and provenance.peer.id != gone.told_by
        return gone.sequence >= provenance.sequence

    def was_lost(self, provenance: Provenance, frame: str) -> bool:
        """Whether it was a loss by which a sample comes too late."""
        gone = self._gone.get((provenance.origin, frame))
        return gone is not None and gone.lost_at is not None

    def remove(self, frame: str, removal: Provenance) -> None:
        """Remember a removal."""
        self.ranks.pop(frame, None)
        self.ranks[frame] = removal.rank
        if len(self.ranks) > _REMEMBERED:
            del self.ranks[next(iter(self.ranks))]

    def gone(self, origin: bytes, frame: str, sequence: int, removal: Provenance | None = None) -> None:
        """Remember the newest sample of an origin that a frame had, with the removal or loss by which it has gone.

        Without either, the peer that was the first to bring it was lost.
        """
        if removal is None:
            gone = _Gone(sequence, next_age())
        elif removal.lost and removal.peer is not None:
            gone = _Gone(sequence, next_age(), removal.peer.id)
        else:
            gone = _Gone(sequence)
        known = self._gone.pop((origin, frame), None)
        self._gone[origin, frame] = known if known is not None and known.sequence > sequence else gone
        if len(self._gone) > _REMEMBERED:
            oldest = next(iter(self._gone))
            self._forget(oldest[0], self._gone.pop(oldest).sequence)

    def _forget(self, origin: bytes, sequence: int) -> None:
        self._late_up_to[origin] = max(sequence, self._late_up_to.pop(origin, -1))
        if len(self._late_up_to) > _REMEMBERED_ORIGINS:
            del self._late_up_to[next(iter(self._late_up_to))]
