"""Who waits for what.

A lookup that cannot be answered is parked under what blocks it: an edge whose newest stamp is too old, ordered by the
stamp it needs; a frame that nobody has named; or the roots of two trees. An insertion then finds those that it can have
unblocked without looking at the others. Nothing here waits or evaluates: whoever inserts takes the waiters that are due
and wakes them, and they read again for themselves.
"""

from bisect import bisect_left, insort
from collections.abc import Callable
from dataclasses import dataclass
from itertools import count

from tfbus.errors import (
    MAY_COME,
    DisconnectedError,
    FutureExtrapolationError,
    GapError,
    TransformLookupError,
    UnknownFrameError,
)
from tfbus.stamps import STAMP_MIN, Latest
from tfbus.tree.question import Question

_Place = tuple[int, int, "Waiter"]


@dataclass(frozen=True, slots=True)
class PendingLookup:
    """One lookup that waits: its question, since when (ns on the bus's clock), and the error that blocks it."""

    question: Question
    since: int
    blocked_by: TransformLookupError

    def __str__(self) -> str:
        return f"{self.question.source!r} in {self.question.target!r}: {self.blocked_by}"


class Waiter:
    """A parked lookup.

    Parameters
    ----------
    question : Question
    since : int
        When the lookup began to wait, in ns.
    wake : callable
        Called once, by whoever took the waiter from the index.
    """

    __slots__ = ("blocked_by", "names", "place", "question", "since", "wake")

    def __init__(self, question: Question, since: int, wake: Callable[[], object]) -> None:
        self.question = question
        self.since = since
        self.wake = wake
        self.blocked_by: TransformLookupError | None = None
        self.names: tuple[str, ...] = ()
        self.place: _Place | None = None


def blocking_frames(error: TransformLookupError) -> tuple[str, ...]:
    """The frames of which a sample may remove what `error` says.

    Raises
    ------
    TypeError
        If `error` is of a kind that waiting cannot help.
    """
    if isinstance(error, FutureExtrapolationError):
        return (error.child, *error.others)
    if isinstance(error, UnknownFrameError):
        return (error.frame,)
    if isinstance(error, DisconnectedError):
        return error.roots
    raise TypeError(f"waiting cannot help against {error!r}")


def without_traceback(error: TransformLookupError) -> TransformLookupError:
    """An error to be kept while a lookup waits.

    A traceback holds the frames that it has been through, the waiting one among them, which holds the error: every wait
    would leave a cycle for the garbage collector, and that stops the loop for 100 ms now and then.
    """
    here: BaseException | None = error
    while here is not None:
        here.__traceback__ = None
        here = here.__cause__
    return error


class _Blocked:
    """The waiters under one frame: by the stamp that its edge must reach, and those that need any sample of it.

    The places are sorted backwards, by negative stamp and negative order, so that whoever is due stands at the end.
    """

    __slots__ = ("for_any", "places")

    def __init__(self) -> None:
        self.places: list[_Place] = []
        self.for_any: dict[Waiter, None] = {}


class WaitingIndex:
    """The parked lookups of one buffer.

    Attributes
    ----------
    blocked : mapping
        The frames that somebody is parked under. A frame that is not in it has nothing to take.
    """

    def __init__(self) -> None:
        self.blocked: dict[str, _Blocked] = {}
        self._waiters: dict[Waiter, None] = {}
        self._order = count()

    def __len__(self) -> int:
        return len(self._waiters)

    def park(self, waiter: Waiter, error: TransformLookupError) -> None:
        """Put a waiter under what `error` says is missing.

        Raises
        ------
        TypeError
            If `error` is of a kind that waiting cannot help.
        """
        waiter.names = blocking_frames(error)
        cause = error.__cause__
        if isinstance(cause, (*MAY_COME, GapError)):
            # At the stamp that all have reached, something else is missing as well; late data may bring it.
            also = (cause.child,) if isinstance(cause, GapError) else blocking_frames(cause)
            waiter.names = tuple(dict.fromkeys((*waiter.names, *also)))
        if isinstance(error, FutureExtrapolationError) and len(waiter.names) == 1:
            needed = STAMP_MIN if isinstance(error.stamp, Latest) else error.stamp - error.slack
            waiter.place = (-needed, -next(self._order), waiter)
            insort(self._under(error.child).places, waiter.place)
        else:
            waiter.place = None
            for name in waiter.names:
                self._under(name).for_any[waiter] = None
        waiter.blocked_by = error
        self._waiters[waiter] = None

    def remove(self, waiter: Waiter) -> None:
        """Take one waiter out, if it is still parked."""
        if waiter not in self._waiters:
            return
        del self._waiters[waiter]
        for name in waiter.names:
            blocked = self.blocked.get(name)
            if blocked is None:
                continue
            if waiter.place is not None:
                del blocked.places[bisect_left(blocked.places, waiter.place)]
            else:
                blocked.for_any.pop(waiter, None)
            if not blocked.places and not blocked.for_any:
                del self.blocked[name]
        waiter.place = None

    def take(self, frame: str, stamp: int | None) -> list[Waiter]:
        """Take out those that a sample of `frame` can have unblocked: who needs any, or its stamp or an older one.

        Who needs an older one than the newest has never been parked, so a late sample unblocks nobody else.
        """
        blocked = self.blocked.get(frame)
        if blocked is None:
            return []
        ready = list(blocked.for_any)
        for waiter in ready:
            self.remove(waiter)
        places = blocked.places
        while stamp is not None and places and -places[-1][0] <= stamp:
            waiter = places.pop()[2]
            # It holds the waiter, which would be a cycle for the garbage collector.
            waiter.place = None
            del self._waiters[waiter]
            ready.append(waiter)
        if not places:
            self.blocked.pop(frame, None)
        return ready

    def take_asking(self, frames: set[str]) -> list[Waiter]:
        """Take out those whose question names one of these frames."""
        ready = [
            waiter
            for waiter in self._waiters
            if waiter.question.target in frames or waiter.question.source in frames or waiter.question.fixed in frames
        ]
        for waiter in ready:
            self.remove(waiter)
        return ready

    def take_all(self) -> list[Waiter]:
        """Take everybody out, as when a frame is removed, the clock jumps back, or nothing more will come."""
        ready = list(self._waiters)
        for waiter in ready:
            waiter.place = None
        self._waiters.clear()
        self.blocked.clear()
        return ready

    def _under(self, frame: str) -> _Blocked:
        blocked = self.blocked.get(frame)
        if blocked is None:
            blocked = self.blocked[frame] = _Blocked()
        return blocked

    def pending(self) -> tuple[PendingLookup, ...]:
        """Who waits, and what blocks each."""
        # Copied first, because another thread may ask while the loop parks and wakes.
        return tuple(
            PendingLookup(waiter.question, waiter.since, waiter.blocked_by)
            for waiter in list(self._waiters)
            if waiter.blocked_by is not None
        )
