"""The relay of a bus: all its links share it, so that what comes by one goes out by the others, and nothing goes round.

Every batch is numbered by the bus on which it was published first, its *origin*. The same batch may arrive on several
ways, for a bus with two links passes on by each what came by the other. So a sample is news only if its number is
higher than that of the newest sample of the same origin and child; then no ring of buses has an echo.

Batches of a world that has no origins, such as ROS, get this bus as their origin. Such a world gives back what it was
sent, by another link of this bus or by another bus, and nothing in it tells. So while a link to such a world is
attached, the relay remembers the newest samples of each child, and takes the same one for news only once.

A bus numbers on from the highest number that it has seen of any origin (Lamport, "Time, clocks, and the ordering of
events in a distributed system", 1978). So of two things that are said of one frame, such as a static sample and a
removal, the one of the higher number was said with the other in mind, or without knowing it; that one holds on every
bus, in whatever order they come. The first number is the machine's time in microseconds, so that what a program says
when it is started again holds against what it has said before, although it knows nothing of that.

What has gone is remembered with its number; see `tfbus.links._removals`.
"""

import os
from collections.abc import Callable, Container, Iterable
from itertools import groupby
from time import time_ns

from tfbus.bus.bus import Bus
from tfbus.errors import UnknownFrameError
from tfbus.geometry.stamped import Batch, TransformStamped
from tfbus.links._entries import OutgoingBatch, RemovedFrame
from tfbus.links._outbox import Outbox
from tfbus.links._passed import PassedSamples
from tfbus.links._peers import Peer
from tfbus.links._provenance import LOWEST, Provenance, Rank, ReceivedTransform
from tfbus.links._removals import Removals
from tfbus.registration import Registration

Brings = Callable[[str, Peer | None], bool]
LARGEST_JUMP = 2**52
"""A number may be so far ahead of all that came before: 142 years in us, for some machines begin in 1970."""


def _nobody(_frame: str, _peer: Peer | None) -> bool:
    return False


class Relay:
    """Passes samples and removals between one bus and its links.

    There is one relay a bus, from `relay_of`. While no link is attached, it does nothing and remembers nothing but its
    origin and its numbers: by those the bus knows its own samples when its links have ended and others begin.

    Parameters
    ----------
    bus : Bus
    number : int
        The number before the first one.

    Attributes
    ----------
    origin : bytes
        The name of this bus for others: 16 random bytes.
    """

    _registration: Registration

    def __init__(self, bus: Bus, number: int) -> None:
        self.origin = os.urandom(16)
        self._number = number
        self._bus = bus
        self._outboxes: list[Outbox] = []
        self._brings: dict[Outbox, Brings] = {}
        self._newest: dict[bytes, dict[str, int]] = {}
        self._brought_by: dict[tuple[bytes, str], Peer] = {}
        self._removals = Removals()
        self._latest: dict[str, Provenance] = {}
        self._settled: dict[str, Rank] = {}
        self._losses_passed_on: dict[str, int] = {}
        self._removing: tuple[str, Provenance] | None = None
        self._passed: PassedSamples | None = None

    def attach(self, outbox: Outbox, foreign: bool = False, brings: Brings = _nobody) -> None:
        """Give a link all that is latched, and all that is published from now on.

        Parameters
        ----------
        outbox : Outbox
        foreign : bool
            Whether it is a link to a world whose samples have no origin.
        brings : callable, optional
            Whether any peer of the link but a given one brings a frame.

        Raises
        ------
        BusClosedError
        """
        if foreign and self._passed is None:
            self._passed = PassedSamples()
        if not self._outboxes:
            self._registration = self._bus.subscribe(self._on_batch, self._on_removal)
        self._bus.subscribe(lambda batch: self._send_latched(batch, outbox)).close()
        self._outboxes.append(outbox)
        self._brings[outbox] = brings

    def detach(self, outbox: Outbox) -> None:
        """Give a link nothing any more; its peers must be lost before, with `lose`."""
        self._outboxes.remove(outbox)
        del self._brings[outbox]
        if not self._outboxes:
            self._registration.close()
            for memory in (self._newest, self._brought_by, self._removals):
                memory.clear()
            for by_frame in (self._latest, self._settled, self._losses_passed_on):
                by_frame.clear()
            self._passed = None

    def clock_jumped_back(self) -> None:
        """Take samples with the stamps of earlier ones for news."""
        if self._passed is not None:
            self._passed.forget_moving()

    def newest_number(self, frame: str) -> tuple[bytes, int] | None:
        """Origin and number of the newest batch with a frame; None if the frame is not there."""
        latest = self._latest.get(frame)
        return None if latest is None else (latest.origin, latest.sequence)

    def is_plausible(self, number: int) -> bool:
        """Whether a number may be one that a bus has given by now."""
        return number - self._number <= LARGEST_JUMP

    def publish(
        self, received: Iterable[tuple[Provenance, Iterable[ReceivedTransform]]], max_frames: int
    ) -> tuple[int, int]:
        """Publish those samples of some received batches that are news, as one batch.

        Parameters
        ----------
        received : iterable of (Provenance, iterable of ReceivedTransform)
            All of one peer.
        max_frames : int
            How many frames the peer may have.

        Returns
        -------
        published, refused : int
            Samples that were published, and samples whose frames are too many; all others are no news.
        """
        news: list[ReceivedTransform] = []
        refused = 0
        for provenance, samples in received:
            if provenance.origin != self.origin:
                refused += self._find_news(provenance, samples, max_frames, news)
            elif provenance.sequence > self._number:
                self._outnumber(provenance.sequence, {sample.child for sample in samples})
        if news:
            self._bus.publish(news, invalid="drop")
        return len(news), refused

    def publish_foreign(
        self, outbox: Outbox, peer: Peer, samples: Iterable[ReceivedTransform], max_frames: int
    ) -> tuple[int, int]:
        """Publish a batch of a world that has neither origins nor numbers; what went over this bus before is no news.

        The batch gets this bus as its origin and the next number of this bus. It goes out by all links but the one that
        brought it, whose outbox is `outbox`. Parameters and results are those of `publish`.
        """
        provenance = Provenance(self.origin, self._next_number(), outbox, peer)
        news: list[ReceivedTransform] = []
        refused = self._find_news(provenance, samples, max_frames, news)
        if news:
            self._bus.publish(news, invalid="drop")
        return len(news), refused

    def remove(self, provenance: Provenance, frame: str) -> None:
        """Remove a frame from the bus, unless newer samples of it have come from the same origin.

        If the frame was lost rather than removed, it goes only if that peer was the last to bring it.
        """
        if provenance.origin == self.origin:
            if provenance.sequence > self._number and not provenance.lost:
                self._outnumber(provenance.sequence, {frame})
            return
        self._number = max(self._number, provenance.sequence)
        latest = self._latest.get(frame)
        if provenance.lost:
            news = latest is not None and latest.peer is provenance.peer
            if latest is not None and not news:
                self._answer_loss(provenance, frame, latest)
            elif latest is not None and provenance.sequence <= latest.sequence:
                # The peer has left the frame to another one; for this bus it is lost.
                provenance = Provenance(self.origin, self._next_number(), provenance.outbox, provenance.peer, lost=True)
        else:
            newest = self._newest.get(provenance.origin, {}).get(frame, -1)
            news = newest < provenance.sequence and not self._removals.is_late(provenance, frame)
            if provenance.rank <= self._removals.rank(frame) or (latest and provenance.rank < latest.rank):
                news = False
        if news:
            self._remove_from_bus(frame, provenance)

    def keep_only(self, peer: Peer, kept: Container[str], outbox: Outbox) -> None:
        """Remove the frames that a peer was the last to bring, before it was lost too, and does not bring now."""
        gone = [
            frame
            for frame, latest in self._latest.items()
            if latest.peer is not None and latest.peer.id == peer.id and latest.outbox is outbox and frame not in kept
        ]
        self._remove_lost(gone, peer, outbox)

    def lose(self, peer: Peer, outbox: Outbox, drop: bool) -> tuple[str, ...]:
        """Forget a peer.

        Parameters
        ----------
        peer : Peer
        outbox : Outbox
            That of the link which has lost it; the peers behind that link notice the loss themselves.
        drop : bool
            Whether the frames that it was the last to bring leave the bus.

        Returns
        -------
        tuple of str
            Those frames, sorted.
        """
        frames = tuple(sorted(frame for frame, latest in self._latest.items() if latest.peer is peer))
        for origin, child in tuple(peer.frames):
            self._release(origin, child, None)
        if drop:
            self._remove_lost(frames, peer, outbox)
        return frames

    def _remove_lost(self, frames: Iterable[str], peer: Peer, outbox: Outbox) -> None:
        for frame in frames:
            latest = self._latest.get(frame)
            # A subscriber that hears of one removal may have removed or published other frames, or closed the bus.
            if not self._bus.closed and latest is not None and latest.peer is not None and latest.peer.id == peer.id:
                lost = Provenance(self.origin, self._next_number(), outbox, peer, lost=True)
                self._remove_from_bus(frame, lost)

    def _find_news(
        self,
        provenance: Provenance,
        samples: Iterable[ReceivedTransform],
        max_frames: int,
        news: list[ReceivedTransform],
    ) -> int:
        """Add the samples of one batch that are news; returns how many others are of frames that are too many."""
        refused, before = 0, len(news)
        peer = provenance.peer
        assert peer is not None
        self._number = max(self._number, provenance.sequence)
        rank = provenance.rank
        newest = self._newest.setdefault(provenance.origin, {})
        passed, foreign = self._passed, provenance.origin == self.origin
        removed = self._removals.ranks
        for sample in samples:
            fields = sample._fields
            child = fields[1]
            # A static one with an origin has to be ranked, so that all buses agree in the end.
            if passed is not None and (foreign or not fields[5]) and sample in passed:
                continue
            if (child in self._settled or child in removed or fields[5]) and self._is_outranked(sample, rank):
                continue
            known = newest.get(child)
            if known is not None:
                if known >= provenance.sequence:
                    continue
            # Otherwise the child is new in this batch, and this is not its first sample there.
            elif (provenance.origin, child) not in peer.frames:
                if self._removals.is_late(provenance, child):
                    if fields[5] and self._removals.was_lost(provenance, child):
                        self._tell_loss_again(provenance, child)
                    continue
                if len(peer.frames) >= max_frames:
                    refused += 1
                    continue
                self._assign(provenance.origin, peer, child)
            sample._provenance = provenance
            news.append(sample)
        # Only now, for a batch may have several samples of one child.
        for sample in news[before:] if before else news:
            newest[sample._fields[1]] = provenance.sequence
        if not newest:
            del self._newest[provenance.origin]
        return refused

    def _remove_from_bus(self, frame: str, provenance: Provenance) -> None:
        if frame not in self._latest:
            # None of its samples was passed on, so no link has to be told.
            self._forget_frame(frame, provenance)
            return
        self._removing = frame, provenance
        try:
            self._bus.remove_frame(frame)
        except UnknownFrameError:
            # The bus forgot it when its clock jumped back, but other buses did not.
            self._on_removal(frame)
        finally:
            self._removing = None

    def _on_batch(self, batch: Batch) -> None:
        for provenance, group in groupby(batch, _provenance_of):
            if provenance is None:
                provenance = Provenance(self.origin, self._next_number(), None, None)
            samples = tuple(group)
            for sample in samples:
                fields = sample._fields
                if self._passed is not None:
                    self._passed.add(sample)
                self._latest[fields[1]] = provenance
                if fields[5]:
                    self._settled[fields[1]] = provenance.rank
            outgoing = OutgoingBatch(provenance.origin, provenance.sequence, samples)
            for outbox in self._outboxes:
                outbox.add_batch(outgoing, echo=outbox is provenance.outbox)

    def _send_latched(self, batch: Batch, outbox: Outbox) -> None:
        def known(sample: TransformStamped) -> Provenance | None:
            return _provenance_of(sample) or self._latest.get(sample.child)

        for provenance, group in groupby(batch, known):
            if provenance is None:
                provenance = Provenance(self.origin, self._next_number(), None, None)
            samples = tuple(group)
            for sample in samples:
                if self._passed is not None:
                    self._passed.add(sample)
                self._latest[sample.child] = provenance
                self._settled[sample.child] = provenance.rank
            outgoing = OutgoingBatch(provenance.origin, provenance.sequence, samples)
            outbox.add_batch(outgoing, echo=outbox is provenance.outbox)

    def _on_removal(self, frame: str) -> None:
        if self._removing is not None and self._removing[0] == frame:
            provenance = self._removing[1]
        else:
            provenance = Provenance(self.origin, self._next_number(), None, None)
        latest = self._latest.pop(frame, None)
        lost_static = provenance.lost and latest is not None and self._settled.get(frame) == latest.rank
        self._forget_frame(frame, provenance)
        removal = RemovedFrame(provenance.origin, provenance.sequence, frame, provenance.lost)
        for outbox in self._outboxes:
            # The other links that brought it have to hear that it was taken from somebody else.
            asks = lost_static and self._brings[outbox](frame, provenance.peer)
            outbox.add_removal(removal, echo=outbox is provenance.outbox and not asks)

    def _forget_frame(self, frame: str, provenance: Provenance) -> None:
        self._settled.pop(frame, None)
        self._losses_passed_on.pop(frame, None)
        if self._passed is not None:
            # A lost sample may come again just as it was.
            (self._passed.forget if provenance.lost else self._passed.retire)(frame)
        if not provenance.lost:
            self._removals.remove(frame, provenance)
        for origin in [origin for origin, newest in self._newest.items() if frame in newest]:
            self._release(origin, frame, provenance)
        if provenance.origin != self.origin:
            self._removals.gone(provenance.origin, frame, provenance.sequence, provenance)

    def _answer_loss(self, loss: Provenance, frame: str, latest: Provenance) -> None:
        """Say a static frame again if this bus owns it, else tell towards its owner that a peer has lost it."""
        if loss.sequence <= latest.sequence or self._settled.get(frame) != latest.rank:
            return
        if latest.origin == self.origin:
            self._say_again([frame])
            return
        # Several peers may pass on the same.
        is_new = loss.sequence > self._losses_passed_on.get(frame, -1)
        if is_new and latest.outbox is not loss.outbox and latest.outbox in self._outboxes:
            self._losses_passed_on[frame] = loss.sequence
            latest.outbox.add_removal(RemovedFrame(loss.origin, loss.sequence, frame, lost=True))

    def _tell_loss_again(self, copy: Provenance, frame: str) -> None:
        """Tell those who have brought a copy of a static frame that it is not taken, unless the bus has the frame."""
        latest = self._latest.get(frame)
        if copy.outbox is not None and (latest is None or latest.rank < copy.rank):
            copy.outbox.add_removal(RemovedFrame(self.origin, self._next_number(), frame, lost=True))

    def _is_outranked(self, sample: ReceivedTransform, rank: Rank) -> bool:
        """Whether something else that was said of the frame holds: a removal, or a static sample of another bus."""
        _, child, _, _, _, static = sample._fields
        if rank < self._settled.get(child, LOWEST) or rank < self._removals.rank(child):
            return True
        latest = self._latest.get(child)
        return static and latest is not None and rank < latest.rank

    def _next_number(self) -> int:
        self._number += 1
        return self._number

    def _outnumber(self, number: int, frames: Iterable[str]) -> None:
        """Number on from a number of this bus that somebody has made up, and say again what it may have hidden."""
        self._number = number
        self._say_again(frames)

    def _say_again(self, frames: Iterable[str]) -> None:
        """Give static samples of this bus new numbers, by which they are news to all others."""
        for frame in sorted(frames):
            latest = self._latest.get(frame)
            if latest is None or latest.origin != self.origin:
                continue
            again = Provenance(self.origin, self._next_number(), latest.outbox, latest.peer)
            for outbox in self._outboxes:
                held = outbox.state.entry(frame)
                if isinstance(held, OutgoingBatch) and held.origin == self.origin:
                    self._latest[frame] = again
                    self._settled[frame] = again.rank
                    outbox.add_batch(OutgoingBatch(again.origin, again.sequence, held.samples))

    def _assign(self, origin: bytes, peer: Peer, child: str) -> None:
        """Count a frame of an origin for the peer that was the first to bring it."""
        peer.frames.add((origin, child))
        self._brought_by[origin, child] = peer

    def _release(self, origin: bytes, child: str, removal: Provenance | None) -> None:
        """Count a frame of an origin for nobody any more, because of a removal, a loss, or a peer that has gone."""
        self._brought_by.pop((origin, child)).frames.discard((origin, child))
        newest = self._newest[origin]
        if origin != self.origin:
            self._removals.gone(origin, child, newest[child], removal)
        del newest[child]
        if not newest:
            del self._newest[origin]


def relay_of(bus: Bus) -> Relay:
    """The relay of a bus, which its links share; the bus itself holds it."""
    if not isinstance(bus._relay, Relay):
        bus._relay = Relay(bus, time_ns() // 1_000)
    return bus._relay


def _provenance_of(sample: TransformStamped) -> Provenance | None:
    return sample._provenance if type(sample) is ReceivedTransform else None
