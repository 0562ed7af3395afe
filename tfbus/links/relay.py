"""What all links of one bus have in common: who it is to others, and what it has heard already.

Every batch is numbered by the bus on which it was published first, its *origin*. The same batch may come back on
another way, for a bus with two links passes on by each what came by the other; so a sample is taken only if its number
is higher than that of the newest one of its origin and child. A ring, of any number of buses, thus has no echo.

What was removed is remembered, with the number up to which a copy on a slower way is not to bring it back. Of so many
removals that they cannot all be remembered, the highest number of each origin is: new names below it are old ones too.
"""

from collections.abc import Iterable, Iterator, Sequence
from itertools import count, groupby
from typing import NamedTuple, Protocol
from uuid import uuid4
from weakref import WeakKeyDictionary

from tfbus.bus.bus import Bus
from tfbus.errors import UnknownFrameError
from tfbus.geometry.stamped import Batch, TransformStamped
from tfbus.links.peers import Peer, ages
from tfbus.links.provenance import ReceivedTransform, Source

_REMEMBERED_REMOVALS = 10_000
_REMEMBERED_ORIGINS = 1_000


class Piece:
    """Samples of one batch and one origin, as they go out."""

    __slots__ = ("origin", "samples", "sequence")

    def __init__(self, origin: bytes, sequence: int, samples: Sequence[TransformStamped]) -> None:
        self.origin = origin
        self.sequence = sequence
        self.samples = samples


class _Removal(NamedTuple):
    """What is remembered of a frame of one origin that has gone."""

    sequence: int
    """What has no higher number is older."""
    since: int | None = None
    """If it was not removed but lost: the age from which on peers may say the same again."""
    peer: str = ""
    """And who has told of it, and may do so too. All others had the same before, so it may only be late."""


class Outlet(Protocol):
    """The sending half of a link; what came by this very link, it is told with `send` false."""

    def take(self, piece: Piece, send: bool) -> object: ...
    def remove(self, origin: bytes, sequence: int, frame: str, lost: bool, send: bool) -> object: ...


class Relay:
    """Between one bus and its links; `join` makes it with the first of them, and `leave` ends it with the last.

    Attributes
    ----------
    origin : bytes
        How this bus is known to others: 16 random bytes.
    """

    def __init__(self, bus: Bus) -> None:
        self.origin, self._numbers = _identities.setdefault(bus, (uuid4().bytes, count(1)))
        self._bus = bus
        self._outlets: list[Outlet] = []
        self._newest: dict[bytes, dict[str, int]] = {}
        self._brought_by: dict[tuple[bytes, str], Peer] = {}
        self._removals: dict[tuple[bytes, str], _Removal] = {}
        self._forgotten: dict[bytes, int] = {}
        self._last_from: dict[str, Peer | None] = {}
        self._removing: tuple[str, Source] | None = None
        self._registration = bus.subscribe(self._published, self._removed)

    def add(self, outlet: Outlet) -> None:
        """Give a link all that is published from now on, and what is latched."""
        self._bus.subscribe(lambda batch: self._send(batch, [outlet])).close()
        self._outlets.append(outlet)

    def drop(self, outlet: Outlet) -> bool:
        """Give a link nothing any more; whether it was the last one."""
        self._outlets.remove(outlet)
        if not self._outlets:
            self._registration.close()
        return not self._outlets

    def publish(self, source: Source, samples: Iterable[ReceivedTransform], max_frames: int) -> tuple[int, int]:
        """Publish those samples of a batch that are news.

        Parameters
        ----------
        source : Source
        samples : iterable of ReceivedTransform
        max_frames : int
            How many frames the peer may have.

        Returns
        -------
        published, refused : int
            The rest is no news. Refused are those whose frames would be too many.
        """
        if source.origin == self.origin:
            return 0, 0
        refused = 0
        newest = self._newest.setdefault(source.origin, {})
        fresh = []
        for sample in samples:
            child = sample._fields[1]
            known = newest.get(child)
            if known is not None:
                if known >= source.sequence:
                    continue
            # Else it is the second one of a child that is new in this batch.
            elif (source.origin, child) not in source.peer.frames:
                if self._is_known(source, child):
                    continue
                if len(source.peer.frames) >= max_frames:
                    refused += 1
                    continue
                self._charge(source, child)
            sample._source = source
            fresh.append(sample)
        # Only now: a batch may have several samples of one child.
        for sample in fresh:
            newest[sample._fields[1]] = source.sequence
        if not newest:
            del self._newest[source.origin]
        if fresh:
            self._bus.publish(fresh, invalid="drop")
        return len(fresh), refused

    def remove(self, source: Source, frame: str) -> None:
        """Remove a frame from the bus, unless newer samples of it have come from the same origin.

        One that was lost goes if that peer was the last to bring it.
        """
        if source.origin == self.origin:
            return
        if source.lost:
            # It may be there all the same, on another way.
            news = self._last_from.get(frame) is source.peer
        else:
            known = self._newest.get(source.origin, {}).get(frame, -1)
            news = known < source.sequence and not self._is_known(source, frame)
        if news:
            self._take_off(frame, source)

    def lose(self, peer: Peer, link: object, drop: bool) -> tuple[str, ...]:
        """Forget a peer; the frames that it was the last to publish, which leave the bus with `drop`."""
        frames = tuple(sorted(frame for frame, last in self._last_from.items() if last is peer))
        since = next(ages)
        for origin, child in tuple(peer.frames):
            self._remember_removal(origin, child, _Removal(self._newest[origin][child], since))
            self._discharge(origin, child)
        for frame in frames:
            # Whoever hears of a removal may have removed or published others of them.
            if self._last_from.get(frame) is peer:
                if drop and not self._bus.closed:
                    # Whoever is behind this link has noticed by himself; others have to be told.
                    self._take_off(frame, Source(self.origin, next(self._numbers), link, peer, lost=True))
                else:
                    self._last_from[frame] = None
        return frames

    def _take_off(self, frame: str, source: Source) -> None:
        if frame not in self._last_from:
            # Nothing of it was passed on, so there is nobody to tell.
            self._forget(frame, source)
            return
        self._removing = frame, source
        try:
            self._bus.remove_frame(frame)
        except UnknownFrameError:
            # The bus has forgotten it when its clock jumped back; the others have not.
            self._removed(frame)
        finally:
            self._removing = None

    def _published(self, batch: Batch) -> None:
        for sample in batch:
            self._last_from[sample._fields[1]] = sample._source.peer if type(sample) is ReceivedTransform else None
        self._send(batch, self._outlets)

    def _send(self, batch: Batch, outlets: Sequence[Outlet]) -> None:
        for source, samples in groupby(batch, _source_of):
            if source is None:
                piece, link = Piece(self.origin, next(self._numbers), tuple(samples)), None
            else:
                piece, link = Piece(source.origin, source.sequence, tuple(samples)), source.link
            for outlet in outlets:
                outlet.take(piece, outlet is not link)

    def _removed(self, frame: str) -> None:
        if self._removing is not None and self._removing[0] == frame:
            source = self._removing[1]
        else:
            source = Source(self.origin, next(self._numbers), None, _NOBODY)
        self._last_from.pop(frame, None)
        self._forget(frame, source)
        for outlet in self._outlets:
            outlet.remove(source.origin, source.sequence, frame, source.lost, outlet is not source.link)

    def _forget(self, frame: str, source: Source) -> None:
        since, by = (next(ages), source.peer.id) if source.lost else (None, "")
        for origin in [origin for origin, newest in self._newest.items() if frame in newest]:
            self._remember_removal(origin, frame, _Removal(self._newest[origin][frame], since, by))
            self._discharge(origin, frame)
        self._remember_removal(source.origin, frame, _Removal(source.sequence, since, by))

    def _charge(self, source: Source, child: str) -> None:
        source.peer.frames.add((source.origin, child))
        self._brought_by[source.origin, child] = source.peer

    def _discharge(self, origin: bytes, child: str) -> None:
        self._brought_by.pop((origin, child)).frames.discard((origin, child))
        newest = self._newest[origin]
        del newest[child]
        if not newest:
            del self._newest[origin]

    def _is_known(self, source: Source, child: str) -> bool:
        """Whether something of an origin's child that is not there is no news."""
        known = self._removals.get((source.origin, child))
        if known is None:
            # What is kept for late joiners is there now, however old it is.
            return source.live and source.sequence <= self._forgotten.get(source.origin, -1)
        if known.sequence == source.sequence and known.since is not None:
            return source.peer.age < known.since and source.peer.id != known.peer
        return known.sequence >= source.sequence

    def _remember_removal(self, origin: bytes, frame: str, removal: _Removal) -> None:
        if origin == self.origin:
            return
        known = self._removals.pop((origin, frame), None)
        if known is not None and known.sequence > removal.sequence:
            removal = known
        self._removals[origin, frame] = removal
        if len(self._removals) > _REMEMBERED_REMOVALS:
            oldest = next(iter(self._removals))
            self._forget_removal(oldest[0], self._removals.pop(oldest).sequence)

    def _forget_removal(self, origin: bytes, sequence: int) -> None:
        self._forgotten[origin] = max(sequence, self._forgotten.pop(origin, -1))
        if len(self._forgotten) > _REMEMBERED_ORIGINS:
            del self._forgotten[next(iter(self._forgotten))]


_NOBODY = Peer("")


def _source_of(sample: TransformStamped) -> Source | None:
    return sample._source if type(sample) is ReceivedTransform else None


_relays: dict[Bus, Relay] = {}
# For as long as a bus lives: its own samples are also to be known when its links have ended and others begin.
_identities: WeakKeyDictionary[Bus, tuple[bytes, Iterator[int]]] = WeakKeyDictionary()


def join(bus: Bus, outlet: Outlet) -> Relay:
    """Give a link its part in what is published on a bus."""
    relay = _relays.get(bus)
    if relay is None:
        relay = _relays[bus] = Relay(bus)
    relay.add(outlet)
    return relay


def leave(bus: Bus, outlet: Outlet) -> None:
    """Undo `join`."""
    if _relays[bus].drop(outlet):
        del _relays[bus]
