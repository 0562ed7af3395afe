"""What all links of one bus have in common: who it is to others, and what it has heard already.

Every batch is numbered by the bus on which it was published first, its *origin*. The same batch may come back on
another way, for a bus with two links passes on by each what came by the other; so a sample is taken only if its number
is higher than that of the newest one of its origin and child. A ring, of any number of buses, thus has no echo.
"""

from collections.abc import Iterable, Sequence
from itertools import groupby
from typing import Protocol
from uuid import uuid4

from tfbus.bus import Bus
from tfbus.errors import UnknownFrameError
from tfbus.links.peers import Peer
from tfbus.links.received import ReceivedTransform, Source
from tfbus.stamped import Batch, TransformStamped

_REMEMBERED_REMOVALS = 10_000


class Piece:
    """Samples of one batch and one origin, as they go out."""

    __slots__ = ("origin", "samples", "sequence")

    def __init__(self, origin: bytes, sequence: int, samples: Sequence[TransformStamped]) -> None:
        self.origin = origin
        self.sequence = sequence
        self.samples = samples


class Outlet(Protocol):
    """The sending half of a link."""

    def take(self, piece: Piece) -> object: ...
    def remove(self, origin: bytes, sequence: int, frame: str) -> object: ...


class Relay:
    """Between one bus and its links; `join` makes it with the first of them, and `leave` ends it with the last.

    Attributes
    ----------
    origin : bytes
        How this bus is known to others: 16 random bytes.
    """

    def __init__(self, bus: Bus) -> None:
        self.origin = uuid4().bytes
        self._bus = bus
        self._sequence = 0
        self._outlets: list[Outlet] = []
        self._newest: dict[bytes, dict[str, int]] = {}
        self._brought_by: dict[tuple[bytes, str], Peer] = {}
        self._removals: dict[tuple[bytes, str], int] = {}
        self._last_from: dict[str, Peer] = {}
        self._removing: Source | None = None
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
            known = newest.get(sample._fields[1])
            if known is None:
                if self._is_known(source, sample.child):
                    continue
                if len(source.peer.frames) >= max_frames:
                    refused += 1
                    continue
                self._charge(source, sample.child)
            elif known >= source.sequence:
                continue
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
        """Remove a frame from the bus, unless newer samples of it have come from the same origin."""
        known = self._newest.get(source.origin, {}).get(frame, -1)
        if source.origin == self.origin or known >= source.sequence or self._is_known(source, frame):
            return
        self._take_off(frame, source)

    def lose(self, peer: Peer, link: object, drop: bool) -> tuple[str, ...]:
        """Forget a peer; the frames that it was the last to publish, which leave the bus with `drop`."""
        frames = tuple(sorted(frame for frame, last in self._last_from.items() if last is peer))
        for origin, child in tuple(peer.frames):
            # When it comes back it may say the same again.
            self._discharge(origin, child)
        for frame in frames:
            del self._last_from[frame]
            if drop:
                # Whoever is behind this link has noticed by himself; others have to be told.
                self._take_off(frame, Source(self.origin, self._next(), link, peer))
        return frames

    def _take_off(self, frame: str, source: Source) -> None:
        self._removing = source
        try:
            self._bus.remove_frame(frame)
        except UnknownFrameError:
            self._remember_removal(source.origin, frame, source.sequence)
        finally:
            self._removing = None

    def _published(self, batch: Batch) -> None:
        for sample in batch:
            if type(sample) is ReceivedTransform:
                self._last_from[sample.child] = sample._source.peer
            elif self._last_from:
                self._last_from.pop(sample.child, None)
        self._send(batch, self._outlets)

    def _send(self, batch: Batch, outlets: Sequence[Outlet]) -> None:
        for source, samples in groupby(batch, _source_of):
            if source is None:
                piece, link = Piece(self.origin, self._next(), tuple(samples)), None
            else:
                piece, link = Piece(source.origin, source.sequence, tuple(samples)), source.link
            for outlet in outlets:
                if outlet is not link:
                    outlet.take(piece)

    def _removed(self, frame: str) -> None:
        self._last_from.pop(frame, None)
        for origin in [origin for origin, newest in self._newest.items() if frame in newest]:
            self._remember_removal(origin, frame, self._newest[origin][frame])
            self._discharge(origin, frame)
        source = self._removing or Source(self.origin, self._next(), None, _NOBODY)
        self._remember_removal(source.origin, frame, source.sequence)
        for outlet in self._outlets:
            if outlet is not source.link:
                outlet.remove(source.origin, source.sequence, frame)

    def _next(self) -> int:
        self._sequence += 1
        return self._sequence

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
        return self._removals.get((source.origin, child), -1) >= source.sequence

    def _remember_removal(self, origin: bytes, frame: str, sequence: int) -> None:
        self._removals[origin, frame] = max(sequence, self._removals.pop((origin, frame), -1))
        if len(self._removals) > _REMEMBERED_REMOVALS:
            del self._removals[next(iter(self._removals))]


_NOBODY = Peer("")


def _source_of(sample: TransformStamped) -> Source | None:
    return sample._source if type(sample) is ReceivedTransform else None


_relays: dict[Bus, Relay] = {}


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
