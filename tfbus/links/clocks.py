"""The clocks of a domain: how far the clock of each peer is from this bus's, and what to do about it.

Steady clocks
-------------
The clock of a bus, by which samples are stamped, may be set, slewed, or be any `Clock` of a program. So the links
measure the *steady* clocks of their machines, which only count, and tell the *base* of each bus: its clock less the
steady clock of its machine, in ns. A step of a clock changes its base, which comes with each batch, and disturbs no
measurement. A bus without a clock that runs by itself, such as a `SimulatedClock`, has no base.

Measuring
---------
A sign of life ends with the sender's steady time and base and, for each peer that was heard since the last sign, with
the steady time that the peer told, and the own one when that came. So each sign that comes completes an exchange of
four stamps (Mills, RFC 5905, section 8): with the times t1 of sending, t2 of hearing, t3 of answering and t4 of hearing
the answer, the peer's steady clock is ahead by ``((t2 - t1) + (t3 - t4)) / 2``, and the round trip took
``(t4 - t1) - (t3 - t2)``. The error is half the round trip at most, whatever the delays of the two directions are, plus
the drift of the two clocks since then, at most `TOLERANCE` of the time. Of the last `KEPT` exchanges the one with the
smallest bound now is believed: usually that of the lowest round trip (the clock filter of RFC 5905, section 10). An
exchange that contradicts it shows that a steady clock has stopped, as in a machine that slept; it replaces all others.

Placing
-------
Each batch carries the base of the clock that stamped it, against the steady clock of the sending machine. The receiver
adds how far that steady clock is ahead of its own, which gives the base against the own steady clock, and passes that
on with the batch. So a batch that comes over several buses is placed by the sum along the way, whichever of them
correct their own copies of it. To correct is to add to each stamp the own base less that base. The measured offset
enters slowly, by `SLEW` at most, but never leaves its bound.

A batch whose clock has stepped does not continue the frames of its bus: the samples before it would be interpolated
with those behind it. So their history ends there.
"""

import struct
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Final, NamedTuple

import numpy as np

from tfbus.clock import Clock, SimulatedClock
from tfbus.stamps import SECOND, to_seconds
from tfbus.statistics import PeerClock

TOLERANCE: Final = 200e-6
"""The greatest drift between two steady clocks, in s per s: each is a crystal of 100 ppm."""
KEPT: Final = 32
"""The exchanges of a peer that are kept."""
SLEW: Final = 500e-6
"""The rate at which the offset of corrected stamps approaches the measured one, in s per s."""
STEP: Final = 5_000_000
"""ns; a base that changes by more between two messages, and by more than 0.1 % of the time between them, was set."""
MOST_ECHOES: Final = 64
"""The peers that one sign answers; with more peers, the next sign answers the others."""
_SLEW_OF_BASE: Final = 1e-3
_STILL: Final = 20_000
"""ns; a base that changes by less is told unchanged: a reading is no better."""
_SLOW_READING: Final = 50_000
_READINGS: Final = 3
_SHORTEST_FIT: Final = 4 * SECOND
_PLACED: Final = SECOND // 2
_OTHER_ROUTE: Final = 10 * SECOND
_MOST_ORIGINS: Final = 10_000
_MOST_ARRIVED: Final = 1_000
_NO_BASE: Final = -(2**63)
_LARGEST: Final = 2**62
_ECHO = struct.Struct("<8sqq")
_END = struct.Struct("<qqH")

_RAW: Final[int | None] = getattr(time, "CLOCK_MONOTONIC_RAW", None)
steady_ns: Callable[[], int] = time.monotonic_ns if _RAW is None else partial(time.clock_gettime_ns, _RAW)
"""The steady clock of this machine, in ns, which nobody slews where that is possible."""


class OwnClock:
    """The base of a bus's clock.

    Parameters
    ----------
    clock : Clock
    steady : callable
        Returns the time of the steady clock, in ns.
    """

    def __init__(self, clock: Clock, steady: Callable[[], int] = steady_ns) -> None:
        self._now = clock.now
        self.steady = steady
        self.runs: bool = not isinstance(clock, SimulatedClock)
        self._clock = clock
        self._may_be_unset = hasattr(clock, "is_set")
        self._base: int | None = None

    def base(self) -> int | None:
        """The clock less the steady clock, in ns; None if it does not run by itself, or has no time yet."""
        if not self.runs or (self._may_be_unset and not self._clock.is_set):  # type: ignore[attr-defined]
            return None
        took, base = self._read()
        for _ in range(_READINGS):
            if took <= _SLOW_READING:
                break
            # The thread was interrupted between the readings.
            took, base = min((took, base), self._read())
        if self._base is None or abs(base - self._base) > _STILL:
            self._base = base
        return self._base

    def _read(self) -> tuple[int, int]:
        """The time that a reading of both clocks has taken, and the base by it, in ns."""
        before = self.steady()
        now = self._now()
        took = self.steady() - before
        return took, now - before - took // 2


class Exchange(NamedTuple):
    """One exchange of four stamps; all in ns.

    Attributes
    ----------
    at : int
        The middle of it, by the own steady clock.
    ahead : int
        The lead of the peer's steady clock.
    bound : int
        The greatest error of that.
    delay : int
        The round trip.
    apart : int
        The peer's base less the own one, at the end of the exchange.
    """

    at: int
    ahead: int
    bound: int
    delay: int
    apart: int

    def bound_at(self, now: int) -> int:
        """The greatest error at a later time."""
        return self.bound + round(TOLERANCE * abs(now - self.at))


class ClockFilter:
    """The offset of the clock of one peer, from exchanges of four stamps; it knows no event loop and no network.

    Attributes
    ----------
    base : int or None
        The base of the peer's bus that was told last.
    told : float or None
        The offset that was told last, in s; None if there is none to tell of.
    """

    def __init__(self) -> None:
        self._exchanges: deque[Exchange] = deque(maxlen=KEPT)
        # All bounds grow alike, so the smallest one stays the smallest until the next exchange.
        self._best: Exchange | None = None
        self.base: int | None = None
        self.told: float | None = None
        self._steady: tuple[int, int] | None = None

    def note(self, sent: int, heard: int, answered: int, arrived: int, apart: int = 0) -> None:
        """Take an exchange: when it was sent, heard and answered and the answer arrived, by the steady clocks, in ns.

        `apart` is the peer's base less the own one.
        """
        held, away = answered - heard, arrived - sent
        drift = round(TOLERANCE * away) + 1
        if away < 0 or held < 0 or held > away + drift:
            # No two clocks and no network can have made these.
            return
        delay = max(away - held, 0)
        ahead = ((heard - sent) + (answered - arrived)) // 2
        found = Exchange((sent + arrived) // 2, ahead, (delay + 1) // 2 + drift, delay, apart)
        best = self._best
        if best is not None and abs(best.ahead - ahead) > best.bound_at(found.at) + found.bound:
            self._exchanges.clear()
        self._exchanges.append(found)
        self._best = min(self._exchanges, key=lambda one: one.bound_at(arrived))

    def ahead(self, now: int) -> tuple[int, int] | None:
        """The lead of the peer's steady clock at a time of the own one, and the bound of the error, in ns."""
        best = self._best
        return None if best is None else (best.ahead, best.bound_at(now))

    def smoothly_ahead(self, now: int) -> int | None:
        """As `ahead`, but an offset that moves by `SLEW` at most, except to stay within the bound."""
        found = self.ahead(now)
        if found is None:
            return None
        ahead, bound = found
        if self._steady is not None:
            before, at = self._steady
            most = round(SLEW * max(now - at, 0))
            aim = min(max(ahead, before - most), before + most)
            if abs(ahead - before) <= _STILL:
                aim = before
            ahead = min(max(aim, ahead - bound), ahead + bound)
        self._steady = ahead, now
        return ahead

    def statistics(self, peer: str, authorities: tuple[str, ...], own_base: int | None, now: int) -> PeerClock:
        """The clock of the peer at a time of the own steady clock."""
        found, best = self.offset(own_base, now), self._best
        if found is None or best is None:
            return PeerClock(peer, authorities, runs=self.base is not None)
        return PeerClock(peer, authorities, *found, self._drift(), to_seconds(best.delay))

    def offset(self, own_base: int | None, now: int) -> tuple[float, float] | None:
        """The lead of the peer's clock over one of some base at a time of the own steady clock, and its bound; in s."""
        found = self.ahead(now)
        if found is None or self.base is None or own_base is None:
            return None
        return to_seconds(found[0] + self.base - own_base), to_seconds(found[1])

    def _drift(self) -> float | None:
        """The slope of the offsets, least squares weighted by the bounds; None for too short a time."""
        recent: list[Exchange] = []
        for one in self._exchanges:
            if recent and abs(one.apart - recent[-1].apart) > _most_slewed(one.at - recent[-1].at):
                # A clock was set: earlier exchanges do not show its drift.
                recent.clear()
            recent.append(one)
        if recent[-1].at - recent[0].at < _SHORTEST_FIT:
            return None
        weights = [1.0 / one.bound**2 for one in recent]
        first = recent[0]
        times = [float(one.at - first.at) for one in recent]
        offsets = [float(one.ahead + one.apart - first.ahead - first.apart) for one in recent]
        variance, covariance = np.cov(times, offsets, ddof=0, aweights=weights)[0]
        return float(covariance / variance)


def _most_slewed(time: int) -> int:
    """The ns by which a base changes at most in some ns, if its clock is not set."""
    return STEP + round(_SLEW_OF_BASE * time)


class Section(NamedTuple):
    """The end of a sign of life.

    Attributes
    ----------
    steady : int
        The sender's steady time, in ns.
    base : int or None
    echo : tuple of int or None
        The steady time that the reader told the sender, and the sender's own one when that came.
    """

    steady: int
    base: int | None
    echo: tuple[int, int] | None


def split_section(data: bytes) -> tuple[bytes, bytes]:
    """A message without the section at its end, and the section; empty if there is no whole one."""
    if len(data) < _END.size:
        return data, b""
    length = _END.size + _ECHO.size * _END.unpack_from(data, len(data) - _END.size)[2]
    return (data[:-length], data[-length:]) if length <= len(data) else (data, b"")


def read_section(section: bytes, reader: bytes) -> Section:
    """A section as a link reads it, whose id begins with these 8 bytes."""
    end = len(section) - _END.size
    steady, base, _ = _END.unpack_from(section, end)
    place = section.find(reader)
    echo = _ECHO.unpack_from(section, place)[1:] if 0 <= place <= end - _ECHO.size else None
    return Section(steady, None if base == _NO_BASE else base, echo)


def write_section(steady: int, base: int | None, echoes: Iterable[tuple[bytes, int, int]]) -> bytes:
    """The section with an answer for each of some peers, told by the first 8 bytes of their ids."""
    body = [_ECHO.pack(*echo) for echo in echoes]
    return b"".join(body) + _END.pack(steady, _NO_BASE if base is None else base, len(body))


@dataclass(slots=True)
class _Origin:
    """The clock of a bus as its last live batch has told it, by one link."""

    link: str
    told: int | None
    clock: int | None
    shift: int
    at: int
    placed: int
    step: int = 0


class Clocks:
    """The clocks of the peers of a link.

    Parameters
    ----------
    own : OwnClock
    link : str
        The id of this link.
    max_offset : float
        An offset up to this is not told of, in s.
    corrects : bool
        Whether stamps are moved to the clock of this bus.
    """

    def __init__(self, own: OwnClock, link: str, max_offset: float, *, corrects: bool = False) -> None:
        self.own = own
        self.corrects = corrects
        self._id = bytes.fromhex(link[:16])
        self._max_offset = max_offset
        # Filled by any thread.
        self._arrived: dict[str, tuple[Section, int]] = {}
        self._peers: dict[str, ClockFilter] = {}
        self._echoes: dict[str, tuple[int, int]] = {}
        self._origins: dict[bytes, _Origin] = {}
        # The peers that were measured since `news` was called.
        self._news: set[str] = set()

    def arrive(self, link: str, section: bytes) -> None:
        """Take the end of a sign, in any thread."""
        arrived, told = self.own.steady(), read_section(section, self._id)
        if link in self._arrived or len(self._arrived) < _MOST_ARRIVED:
            self._arrived[link] = told, arrived

    def joined(self, link: str) -> None:
        """Begin to measure a peer; one whose id is not made of hexadecimal digits cannot be answered."""
        with suppress(ValueError):
            bytes.fromhex(link[:16])
            self._peers[link] = ClockFilter()

    def left(self, link: str) -> None:
        """Forget a peer."""
        self._peers.pop(link, None)

    def settle(self) -> None:
        """Read all that has arrived."""
        own = self.own.base()
        while self._arrived:
            link, ((steady, base, echo), arrived) = self._arrived.popitem()
            if link not in self._peers:
                continue
            peer = self._peers[link]
            self._echoes[link] = steady, arrived
            peer.base = base
            if echo is not None:
                apart = 0 if base is None or own is None else base - own
                peer.note(echo[0], echo[1], steady, arrived, apart)
                self._news.add(link)

    def is_measured(self, link: str) -> bool:
        """Whether it is known how far the steady clock of a peer is ahead."""
        peer = self._peers.get(link)
        return peer is not None and peer.ahead(self.own.steady()) is not None

    def section(self, *, answers: bool) -> bytes:
        """The end of a sign that goes out now; one to a single peer answers no others."""
        self.settle()
        echoes = []
        for link in list(self._echoes)[:MOST_ECHOES] if answers else ():
            steady, arrived = self._echoes.pop(link)
            echoes.append((bytes.fromhex(link[:16]), steady, arrived))
        return write_section(self.own.steady(), self.own.base(), echoes)

    def place(self, link: str, told: int | None) -> tuple[int | None, int]:
        """The base of the clock of a batch against the own steady clock, and what to add to its stamps, in ns.

        Parameters
        ----------
        link : str
            The peer that has sent the batch.
        told : int or None
            The base that it tells, against its own steady clock.
        """
        peer = self._peers.get(link)
        if peer is None or told is None:
            return None, 0
        ahead = peer.smoothly_ahead(self.own.steady())
        if ahead is None or abs(told + ahead) > _LARGEST:
            return None, 0
        own = self.own.base() if self.corrects else None
        return told + ahead, 0 if own is None else own - told - ahead

    def goes_on(self, link: str, origin: bytes, told: int | None) -> int | None:
        """The base of a clock as of the last live batch, if this one tells the same and no stamp is to be corrected."""
        known = self._origins.get(origin)
        if known is None or known.told != told or known.link != link or self.corrects:
            return None
        now = self.own.steady()
        if now - known.placed > _PLACED:
            return None
        known.at = now
        return known.clock

    def jumps(self, link: str, origin: bytes, told: int | None, clock: int | None, shift: int) -> bool:
        """Take the clock of a live batch of a bus; returns whether its stamps do not go on from those before.

        Parameters
        ----------
        link : str
            The peer that has sent it. While several bring the samples of one bus, the first one is followed.
        origin : bytes
        told, clock : int or None
            The base of the clock, against the steady clock of the peer's machine, and against the own one.
        shift : int
            The ns that were added to its stamps.
        """
        now = self.own.steady()
        before = self._origins.get(origin)
        if before is None or before.link != link:
            if before is None or now - before.at > _OTHER_ROUTE:
                if len(self._origins) >= _MOST_ORIGINS:
                    del self._origins[next(iter(self._origins))]
                self._origins[origin] = _Origin(link, told, clock, shift, now, now)
            return False
        step = 0 if told is None or before.told is None else told - before.told
        moved, limit = shift - before.shift, _most_slewed(now - before.at)
        before.told, before.clock, before.shift, before.at, before.placed = told, clock, shift, now, now
        before.step = step if abs(step) > limit else 0
        return abs(moved) > limit if self.corrects else bool(before.step)

    def forget_origins(self, link: str) -> None:
        """Follow the clocks that a peer has told anew, with its next batches."""
        origins = self._origins.items()
        self._origins = {origin: known for origin, known in origins if known.link != link or known.told is None}

    def step_of(self, origin: bytes) -> int:
        """The step of the clock of a bus between its last two live batches, in ns."""
        return self._origins[origin].step

    def news(self) -> Iterator[tuple[str, float, float, bool]]:
        """The peers whose offsets are to be told now, each with the offset, its bound, and whether it is over; in s.

        An offset is told if it exceeds both its bound and `max_offset`, again when it has changed by as much, and when
        it is over.
        """
        while self._news:
            link = self._news.pop()
            peer = self._peers.get(link)
            found = None if peer is None else peer.offset(self.own.base(), self.own.steady())
            if peer is None or found is None:
                continue
            offset, bound = found
            least = max(bound, self._max_offset)
            if abs(offset) > least and (peer.told is None or abs(offset - peer.told) > least):
                peer.told = offset
                yield link, offset, bound, False
            elif peer.told is not None and abs(offset) <= self._max_offset:
                peer.told = None
                yield link, offset, bound, True

    def statistics(self, peers: Iterable[tuple[str, Iterable[str]]]) -> tuple[PeerClock, ...]:
        """The clocks of some peers, each given by its id and its authorities."""
        own, now = self.own.base(), self.own.steady()
        return tuple(
            self._peers[link].statistics(link, tuple(sorted(authorities)), own, now)
            for link, authorities in peers
            if link in self._peers
        )
