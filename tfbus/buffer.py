"""A tree that a bus feeds, and lookups that wait for what is still missing."""

import logging
import math
from types import TracebackType
from typing import Any, TypeVar

import anyio
import anyio.lowlevel

from tfbus.bus import Bus
from tfbus.data import Stamped, check_registered, do_transform
from tfbus.errors import (
    BusClosedError,
    ClockResetError,
    LookupTimeoutError,
    TransformLookupError,
    UnknownFrameError,
)
from tfbus.feed import Feed
from tfbus.once import OnceLogger
from tfbus.stamped import TransformStamped, is_frame
from tfbus.stamps import LATEST, Latest, as_duration, from_seconds
from tfbus.tree import TransformTree
from tfbus.waiting import MAY_COME, PendingLookup, Question, Waiter, blocking_frames

DataT = TypeVar("DataT", bound=Stamped)

_REPORT_AFTER = 5.0


class Buffer:
    """A few seconds of every frame on a bus, and the transforms between them.

    Parameters
    ----------
    bus : Bus
        It feeds the buffer from now on, what is latched included, and holds it until `close`.
    keep : float or None
        How much history to keep for each frame, in s before that frame's newest stamp; None keeps everything.

    Raises
    ------
    BusClosedError
        If the bus is closed.
    ValueError
        If `keep` is negative.

    Notes
    -----
    `lookup_nowait` and `tree` may be used from any thread; what is awaited, only on the bus's event loop.
    """

    def __init__(self, bus: Bus, keep: float | None = 10.0) -> None:
        self.bus = bus
        self._clock = bus.clock
        self._feed = Feed(keep)
        self._log = OnceLogger(logging.getLogger("tfbus"))
        bus.attach(self._feed)

    @property
    def tree(self) -> TransformTree:
        """The tree behind this buffer, to read: its samples come from the bus."""
        return self._feed.tree

    def lookup_nowait(
        self,
        target: str,
        source: str,
        at: int | Latest = LATEST,
        *,
        max_age: float | None = None,
        source_at: int | Latest | None = None,
        fixed: str | None = None,
    ) -> TransformStamped:
        """Where `source` is, seen from `target`, or an error at once. See `TransformTree.lookup`.

        Parameters
        ----------
        target, source : str
        at : int or LATEST
            ns.
        max_age : float, optional
            Count a `LATEST` answer older than this many s as not yet arrived.
        source_at, fixed
            As `TransformTree.lookup`.

        Raises
        ------
        TransformLookupError, TypeError
            As `TransformTree.lookup`.
        """
        not_before = None if max_age is None else self._not_before(max_age, at, source_at)
        return self._feed.tree.answer(target, source, at, source_at, fixed, not_before)

    async def lookup(
        self,
        target: str,
        source: str,
        at: int | Latest = LATEST,
        *,
        timeout: float | None = None,
        max_age: float | None = None,
        source_at: int | Latest | None = None,
        fixed: str | None = None,
    ) -> TransformStamped:
        """Where `source` is, seen from `target`, as soon as that can be answered.

        What can be answered is answered after one checkpoint. What waiting cannot help fails at once: a stamp older
        than an edge's window raises `PastExtrapolationError`. Everything else waits; a frame that nobody ever
        publishes waits for ever, unless there is a timeout, and is logged after 5 s.

        Parameters
        ----------
        target, source : str
        at : int or LATEST
            ns. `LATEST` is the newest stamp that every moving edge on the path can answer.
        timeout : float, optional
            In s on the bus's clock; None waits for ever.
        max_age : float, optional
            Count a `LATEST` answer older than this many s as not yet arrived, so that a dead broadcaster cannot
            answer for ever.
        source_at : int or LATEST, optional
            Take source at this stamp instead, and carry it to `at` through `fixed`.
        fixed : str, optional
            The frame that is held still between the two stamps.

        Returns
        -------
        TransformStamped
            Parent is target and child is source.

        Raises
        ------
        LookupTimeoutError
            If the timeout ran out; its ``__cause__`` says what was still missing.
        PastExtrapolationError
            If it is older than an edge's window.
        BusClosedError
            If it cannot be answered and nothing more will come.
        ClockResetError
            If the clock jumped back meanwhile.
        UnknownFrameError
            At once, if a name cannot be that of a frame: empty, or with a leading slash.
        TypeError
            If a stamp is a float, or `max_age` comes without a `LATEST`.
        """
        limit = math.inf if timeout is None else as_duration(timeout, "timeout")
        reset = self._feed.last_reset
        await anyio.lowlevel.checkpoint()
        question = Question(target, source, at, source_at, fixed)
        try:
            return self._read(question, max_age, reset)
        except MAY_COME as error:
            for name in (target, source, fixed):
                if name is not None and not is_frame(name):
                    raise UnknownFrameError(frame=name, known=self.tree.frames()) from None
            blocker = error
        self.bus.check_thread()
        return await self._wait(question, max_age, limit, reset, blocker)

    async def transform(
        self,
        data: DataT,
        target: str,
        *,
        timeout: float | None = None,
        max_age: float | None = None,
        at: int | Latest | None = None,
        fixed: str | None = None,
    ) -> DataT:
        """`data` in the frame `target`, by the transform of their own stamp, as soon as that has arrived.

        Parameters
        ----------
        data : any type of `tfbus.data` but LaserScan, or a type registered with `do_transform`
            With `frame` and `stamp`; the stamp may be `LATEST`.
        target : str
        timeout, max_age : float, optional
            As `lookup`.
        at : int or LATEST, optional
            Move the data from their own stamp to this one (ns), through `fixed`.
        fixed : str, optional
            The frame that is held still between the two stamps.

        Returns
        -------
        same type as `data`
            Its frame is `target`, its stamp that of the transform.

        Raises
        ------
        TypeError
            If `data` are of a type that is not registered or has no frame and stamp, or only one of `at` and `fixed`
            is given.
        TransformError
            As `lookup`.
        """
        question = _question_of(data, target, at, fixed)
        moved: DataT = do_transform(data, await self.lookup(**question, timeout=timeout, max_age=max_age))
        return moved

    def transform_nowait(
        self,
        data: DataT,
        target: str,
        *,
        max_age: float | None = None,
        at: int | Latest | None = None,
        fixed: str | None = None,
    ) -> DataT:
        """As `transform`, or an error at once."""
        question = _question_of(data, target, at, fixed)
        moved: DataT = do_transform(data, self.lookup_nowait(**question, max_age=max_age))
        return moved

    def can_transform(self, target: str, source: str, at: int | Latest = LATEST, **question: Any) -> bool:
        """Whether `lookup_nowait` with the same arguments has an answer now."""
        try:
            self.lookup_nowait(target, source, at, **question)
        except TransformLookupError:
            return False
        return True

    def pending(self) -> tuple[PendingLookup, ...]:
        """The lookups that wait now, with what blocks each."""
        return self._feed.waiting.pending()

    def describe(self) -> str:
        """The tree as text, with each edge's rate, age, span and authority, and the lookups that wait."""
        lines = [self.tree.describe(self._clock.now())]
        lines += [f"waiting: {pending}" for pending in self.pending()]
        return "\n".join(lines)

    def close(self) -> None:
        """Leave the bus; lookups that wait end with `BusClosedError`. What is buffered can still be looked up."""
        self.bus.detach(self._feed)
        self._feed.end("the buffer is closed")

    def __enter__(self) -> "Buffer":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    async def _wait(
        self,
        question: Question,
        max_age: float | None,
        limit: float,
        reset: ClockResetError | None,
        blocker: TransformLookupError,
    ) -> TransformStamped:
        """Park under what is missing, read again when woken, and so on until there is an answer or the time is up."""
        since = self._clock.now()
        quiet = min(limit, _REPORT_AFTER)
        for late, seconds in ((False, quiet), (True, limit - quiet)):
            with self._clock.move_on_after(seconds):
                while True:
                    if late:
                        self._report(question, blocker)
                    await self._park(question, since, blocker)
                    try:
                        return self._read(question, max_age, reset)
                    except MAY_COME as error:
                        blocker = error
            try:
                # The data may have come in the very turn of the loop in which the time was up.
                return self._read(question, max_age, reset)
            except MAY_COME as error:
                blocker = error
            if seconds >= limit:
                break
        raise LookupTimeoutError(
            target=question.target, source=question.source, timeout=limit, missing=blocker
        ) from blocker

    async def _park(self, question: Question, since: int, blocker: TransformLookupError) -> None:
        """Wait until something comes that can have removed what blocks a lookup."""
        if self._feed.ended:
            raise BusClosedError(self._feed.ended) from blocker
        woken = anyio.Event()
        waiter = Waiter(question, since, woken.set)
        self._feed.waiting.park(waiter, blocker)
        try:
            await woken.wait()
        except BaseException:
            # Cancelled; whoever wakes a waiter has taken it out already.
            self._feed.waiting.remove(waiter)
            raise

    def _read(self, question: Question, max_age: float | None, reset: ClockResetError | None) -> TransformStamped:
        """As `lookup_nowait`, for a lookup that began when the clock's last jump back was `reset`."""
        latest = self._feed.last_reset
        if latest is not None and latest is not reset:
            raise ClockResetError(before=latest.before, after=latest.after)
        not_before = None if max_age is None else self._not_before(max_age, question.at, question.source_at)
        return self._feed.tree.answer(
            question.target, question.source, question.at, question.source_at, question.fixed, not_before
        )

    def _not_before(self, max_age: float, at: int | Latest, source_at: int | Latest | None) -> int | None:
        if at is not LATEST and source_at is not LATEST:
            raise TypeError("max_age goes with LATEST: an answer at a given stamp never gets newer")
        if as_duration(max_age, "max_age") == math.inf:
            return None
        return self._clock.now() - from_seconds(max_age)

    def _report(self, question: Question, blocker: TransformLookupError) -> None:
        """Log what blocks a lookup that has waited for long."""
        self._log.warning(
            (type(blocker), blocking_frames(blocker)),
            "a lookup of %r in %r has waited for more than %g s: %s",
            question.source,
            question.target,
            _REPORT_AFTER,
            blocker,
        )


def _question_of(data: Stamped, target: str, at: int | Latest | None, fixed: str | None) -> dict[str, Any]:
    """What `lookup` has to be asked to move `data`."""
    check_registered(data)
    if not (hasattr(data, "frame") and hasattr(data, "stamp")):
        kind = type(data).__name__
        raise TypeError(f"a {kind} has no frame and stamp of its own: look the transform up and call do_transform")
    question: dict[str, Any] = {"target": target, "source": data.frame, "at": data.stamp}
    if at is None and fixed is None:
        return question
    if at is None or fixed is None:
        raise TypeError("at and fixed go together: the data at their stamp, carried to `at` through the fixed frame")
    return {**question, "at": at, "source_at": data.stamp, "fixed": fixed}
