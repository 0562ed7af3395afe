"""An index of the waiting lookups by the frames that block them.

A lookup that cannot be answered is parked under the frame that blocks it: an edge whose newest stamp is too old,
ordered by the stamp that the lookup needs; an unknown frame; or the roots of two trees. An insertion then finds the
lookups that it may have unblocked without looking at the others. Nothing here waits or computes an answer: the
inserting code pops the waiters that may have an answer and wakes them, and each asks the tree again.
"""

from bisect import bisect_left, insort
from collections.abc import Callable
from dataclasses import dataclass
from itertools import count

from tfbus.errors import (
    MAY_COME,
    AheadError,
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
    """A waiting lookup: its question, when it began to wait (ns on the bus's clock), and the error that blocks it."""

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
        The stamp at which the lookup began to wait, in ns.
    wake : callable
        Called once, after the waiter was popped from the index.
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
    """The frames of which a new sample may remove the cause of `error`.

    Raises
    ------
    TypeError
        If `error` is of a kind that waiting cannot help.
    """
    if isinstance(error, FutureExtrapolationError):
        return (error.child, *error.others)
    if isinstance(error, AheadError):
        return (error.child,)
    if isinstance(error, UnknownFrameError):
        return (error.frame,)
    if isinstance(error, DisconnectedError):
        return error.roots
    raise TypeError(f"waiting cannot help against {error!r}")


def without_traceback(error: TransformLookupError) -> TransformLookupError:
    """The error without its traceback, to be kept while a lookup waits.

    A traceback refers to the waiting stack frame, which refers to the error: every wait would leave a reference cycle,
    and the garbage collector then stops the loop for 100 ms now and then.
    """
    here: BaseException | None = error
    while here is not None:
        here.__traceback__ = None
        here = here.__cause__
    return error


class _FrameWaiters:
    """The waiters under one frame: by the stamp that its edge must reach, and those that need any sample of it.

    The places are sorted backwards, by negative stamp and negative order, so that the next due waiter is the last.
    """

    __slots__ = ("for_any", "places")

    def __init__(self) -> None:
        self.places: list[_Place] = []
        self.for_any: dict[Waiter, None] = {}


class WaitingIndex:
    """The parked lookups of one buffer.

    Attributes
    ----------
    by_frame : mapping
        The waiters under each frame that blocks a lookup.
    """

    def __init__(self) -> None:
        self.by_frame: dict[str, _FrameWaiters] = {}
        self._waiters: dict[Waiter, None] = {}
        self._order = count()

    def __len__(self) -> int:
        return len(self._waiters)

    def park(self, waiter: Waiter, error: TransformLookupError) -> None:
        """Put a waiter under the frames that `error` says it lacks.

        Raises
        ------
        TypeError
            If `error` is of a kind that waiting cannot help.
        """
        waiter.names = blocking_frames(error)
        cause = error.__cause__
        if isinstance(cause, (*MAY_COME, GapError)):
            # At the newest common stamp something else is missing as well; late data may bring it.
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
        """Remove one waiter, if it is still parked."""
        if waiter not in self._waiters:
            return
        del self._waiters[waiter]
        for name in waiter.names:
            blocked = self.by_frame.get(name)
            if blocked is None:
                continue
            if waiter.place is not None:
                del blocked.places[bisect_left(blocked.places, waiter.place)]
            else:
                blocked.for_any.pop(waiter, None)
            if not blocked.places and not blocked.for_any:
                del self.by_frame[name]
        waiter.place = None

    def pop_unblocked(self, frame: str, stamp: int | None) -> list[Waiter]:
        """Remove and return the waiters that a sample of `frame` at `stamp` may have unblocked.

        These are the waiters that need any sample, and those that need this stamp or an older one. No waiter needs a
        stamp older than the newest sample, so a late sample unblocks no others.
        """
        blocked = self.by_frame.get(frame)
        if blocked is None:
            return []
        ready = list(blocked.for_any)
        for waiter in ready:
            self.remove(waiter)
        places = blocked.places
        while stamp is not None and places and -places[-1][0] <= stamp:
            waiter = places.pop()[2]
            # The place refers to the waiter: without this line they form a reference cycle.
            waiter.place = None
            del self._waiters[waiter]
            ready.append(waiter)
        if not places:
            self.by_frame.pop(frame, None)
        return ready

    def pop_asking_for(self, frames: set[str]) -> list[Waiter]:
        """Remove and return the waiters whose question names one of the frames."""
        ready = [
            waiter
            for waiter in self._waiters
            if waiter.question.target in frames or waiter.question.source in frames or waiter.question.fixed in frames
        ]
        for waiter in ready:
            self.remove(waiter)
        return ready

    def pop_all(self) -> list[Waiter]:
        """Remove and return all waiters."""
        ready = list(self._waiters)
        for waiter in ready:
            waiter.place = None
        self._waiters.clear()
        self.by_frame.clear()
        return ready

    def _under(self, frame: str) -> _FrameWaiters:
        blocked = self.by_frame.get(frame)
        if blocked is None:
            blocked = self.by_frame[frame] = _FrameWaiters()
        return blocked

    def pending(self) -> tuple[PendingLookup, ...]:
        """All waiting lookups with the errors that block them."""
        # Copied first, because another thread may call this while the loop parks and wakes.
        return tuple(
            PendingLookup(waiter.question, waiter.since, waiter.blocked_by)
            for waiter in list(self._waiters)
            if waiter.blocked_by is not None
        )
