"""A filter that pairs each message with the transform of its own stamp, as soon as that is known.

::

    source ──> reads ──> ready ────────────────────────────> reader
                 │         ^ ^
                 v         │ └────────────────┐
              parked ── publish ──> due ──> attends ──> dropped
                 ^        timeout, end ^       │
                 └─────────────────────────────┘

One task reads the source. A message whose transform is known on arrival is ready at once. Any other is parked in the
buffer's index as a lookup is, but no task sleeps for it: the insertion that unblocks it calls a function.

* If the insertion hands over the answer, the message is ready before `publish` returns. With one target and no
  margin this is the usual end of a wait.
* Otherwise the message is due, and a task, the attendant, asks again: it makes the message ready, parks it once more,
  or drops it. So it is with several targets, after a change of the target, when the time of the message is up, when its
  transform can no longer come, and when the buffer is closed. One attendant serves all messages that are due.

The function runs inside a publish, where no code of the user may run: `on_drop` is called by the tasks only, and when
the clock jumps back. No task raises an `Exception`: a message that fails is dropped, and an error of the source is kept
for the reader.

A clock that is not a class of tfbus has no alarms: there each waiting message takes a task that keeps the time.
"""

import logging
import math
import warnings
from bisect import bisect_left, insort
from collections import Counter
from collections.abc import AsyncIterable, Callable, Sequence
from functools import partial
from inspect import iscoroutinefunction
from itertools import count
from operator import attrgetter
from types import TracebackType
from typing import Generic, Literal, NamedTuple, TypeVar, cast, overload

import anyio
import anyio.abc
import anyio.lowlevel

from tfbus._aio.loops import checkpoint
from tfbus._aio.task_groups import OneReader, close_task_group, raise_unchanged, read_source
from tfbus.buffer.buffer import Buffer
from tfbus.buffer.lookups import Wait
from tfbus.bus.queues import check_capacity
from tfbus.bus.subscribers import OnceLogger
from tfbus.errors import (
    MAY_COME,
    BusClosedError,
    ClockResetError,
    LookupTimeoutError,
    TransformError,
    TransformLookupError,
    UnknownFrameError,
)
from tfbus.frames import is_frame
from tfbus.geometry.stamped import TransformStamped, answer_of
from tfbus.registration import AsyncOnly, Registration
from tfbus.rows import IDENTITY
from tfbus.stamps import LATEST, STAMP_MAX, Latest, as_duration, as_stamp, from_seconds
from tfbus.tree.lookup import Question
from tfbus.tree.tree import forest_of
from tfbus.waiting.live_tree import without_traceback

MessageT = TypeVar("MessageT")

DropReason = Literal["too old", "queue full", "timed out", "unknown frame", "clock reset", "closed"]


class DroppedMessages(Generic[MessageT]):
    """Counts dropped messages and calls a callback for each; its errors are logged and counted.

    Parameters
    ----------
    on_drop : callable or None
        Called with the message, the reason and the error, if there is one.

    Attributes
    ----------
    counts : Counter
        By reason.
    callbacks_failed : int
        Number of exceptions that the callback raised.
    """

    def __init__(self, on_drop: Callable[[MessageT, DropReason, TransformError | None], object] | None) -> None:
        if on_drop is not None and not callable(on_drop):
            raise TypeError(f"on_drop must be callable, not {on_drop!r}")
        if iscoroutinefunction(on_drop):
            raise TypeError(f"on_drop must not be async, as {on_drop!r} is")
        self._on_drop = on_drop
        self._log = OnceLogger(logging.getLogger("tfbus"))
        self.counts: Counter[DropReason] = Counter()
        self.callbacks_failed: int = 0

    def drop(self, message: MessageT, reason: DropReason, error: TransformError | None) -> None:
        """Count a message and call the callback; its first `Exception` is logged."""
        self.counts[reason] += 1
        if self._on_drop is None:
            return
        try:
            self._on_drop(message, reason, error)
        except Exception as raised:  # noqa: BLE001 - the callback must not stop the filter
            self.callbacks_failed += 1
            self._log.warning("on_drop", "the on_drop callback %r raised", self._on_drop, exc_info=raised)


def reason_of(error: TransformError) -> DropReason:
    """The reason for dropping a message whose lookup ended with `error`."""
    if isinstance(error, LookupTimeoutError):
        return "unknown frame" if isinstance(error.__cause__, UnknownFrameError) else "timed out"
    if isinstance(error, UnknownFrameError):
        return "unknown frame"
    if isinstance(error, ClockResetError):
        return "clock reset"
    return "closed" if isinstance(error, BusClosedError) else "too old"


AnswerT = TypeVar("AnswerT")

Order = Literal["ready", "stamp", "arrival"]
"""The order of delivery: as messages become ready, by stamp, or by arrival."""


class PendingMessage(Generic[MessageT, AnswerT]):
    """One message, its frame and its stamp.

    Attributes
    ----------
    answer : transform or tuple of transforms, or None
        Delivered with the message; None while it waits.
    wait : Wait or None
        Its lookup, from the first time that it is parked until it has its answer or is dropped.
    number : int
        Number of messages that arrived before it.
    place : tuple of int or None
        Its place in the order of delivery: its rank, then its number.
    """

    __slots__ = ("answer", "frame", "message", "number", "place", "stamp", "wait")

    def __init__(self, message: MessageT, frame: str, stamp: int | Latest) -> None:
        self.message: MessageT = message
        self.frame: str = frame
        self.stamp: int | Latest = stamp
        self.answer: AnswerT | None = None
        self.wait: Wait | None = None
        self.number: int = -1
        self.place: tuple[int, int] | None = None


class MessageQueue(Generic[MessageT, AnswerT]):
    """A bounded queue from which the reader gets only answered messages.

    Parameters
    ----------
    capacity : int
        How many may wait or be ready; at least one. The caller of `append` makes room first.
    order : {"ready", "stamp", "arrival"}
        With ``"stamp"`` and ``"arrival"``, a message that waits holds back all later ones.

    Raises
    ------
    TypeError, ValueError
        If `capacity` is not an integer of at least one, or `order` has another value.
    """

    def __init__(self, capacity: int, order: Order) -> None:
        check_capacity(capacity)
        if order not in ("ready", "stamp", "arrival"):
            raise ValueError(f"order must be 'ready', 'stamp' or 'arrival', not {order!r}")
        self.capacity = capacity
        self.order: Order = order
        self.unanswered: int = 0
        self._arrivals = count()
        self._pending: dict[int, PendingMessage[MessageT, AnswerT]] = {}
        # The places in the order of delivery; with "ready", only the places of answered messages.
        self._line: list[tuple[int, int]] = []

    def __len__(self) -> int:
        return len(self._pending)

    def __contains__(self, pending: PendingMessage[MessageT, AnswerT]) -> bool:
        return pending.number in self._pending

    @property
    def full(self) -> bool:
        """Whether there is no room for another message."""
        return len(self._pending) >= self.capacity

    @property
    def messages(self) -> tuple[PendingMessage[MessageT, AnswerT], ...]:
        """All messages, in the order of arrival."""
        return tuple(self._pending.values())

    @property
    def waiting(self) -> tuple[PendingMessage[MessageT, AnswerT], ...]:
        """The messages without an answer, in the order of arrival."""
        return tuple(pending for pending in self._pending.values() if pending.answer is None)

    @property
    def oldest(self) -> PendingMessage[MessageT, AnswerT]:
        """The message that arrived first."""
        return next(iter(self._pending.values()))

    def is_waiting(self, pending: PendingMessage[MessageT, AnswerT]) -> bool:
        """Whether a message is in the queue and has no answer."""
        return pending in self and pending.answer is None

    def append(self, pending: PendingMessage[MessageT, AnswerT]) -> None:
        """Add a message without an answer; with the order "stamp" it must have a stamp."""
        pending.number = next(self._arrivals)
        self._pending[pending.number] = pending
        self.unanswered += 1
        if self.order == "arrival":
            self._line_up(pending, pending.number)
        elif self.order == "stamp" and not isinstance(pending.stamp, Latest):
            self._line_up(pending, pending.stamp)

    def set_answer(self, pending: PendingMessage[MessageT, AnswerT], answer: AnswerT, moment: int) -> None:
        """Give a waiting message its answer. If two get theirs at one moment, the first to arrive is ready first."""
        pending.answer = answer
        self.unanswered -= 1
        if pending.place is None:
            self._line_up(pending, moment)

    def remove(self, pending: PendingMessage[MessageT, AnswerT]) -> None:
        """Remove a message, answered or not."""
        del self._pending[pending.number]
        self.unanswered -= pending.answer is None
        if pending.place is not None:
            del self._line[bisect_left(self._line, pending.place)]

    def pop_ready(self) -> tuple[MessageT, AnswerT] | None:
        """Remove the next message in the order of delivery if it has its answer, and return both."""
        if not self._line:
            return None
        pending = self._pending[self._line[0][1]]
        if pending.answer is None:
            return None
        self.remove(pending)
        return pending.message, pending.answer

    def _line_up(self, pending: PendingMessage[MessageT, AnswerT], rank: int) -> None:
        pending.place = rank, pending.number
        insort(self._line, pending.place)


Asked = tuple[str, str, int | Latest]
"""A question of a message: target, source, and stamp in ns."""


class Blocked(NamedTuple):
    """The questions of a message that has no answer yet, the one that lacks something first, and its error."""

    questions: list[Asked]
    error: TransformLookupError


class Targets(Generic[AnswerT]):
    """The target frames of a message filter.

    Parameters
    ----------
    buffer : Buffer
    target : str or sequence of str
        With one, an answer is a transform; with a sequence, a tuple of transforms in that order.
    tolerance : float
        In s. The transform this much later has to be known too.

    Attributes
    ----------
    one : bool
        Whether an answer is a transform.

    Raises
    ------
    UnknownFrameError
        If a target cannot be the name of a frame.
    TypeError, ValueError
        If there is no target, or `tolerance` is not a duration.
    """

    def __init__(self, buffer: Buffer, target: str | Sequence[str], tolerance: float) -> None:
        self._buffer = buffer
        self.one: bool = isinstance(target, str)
        self._tolerance = from_seconds(as_duration(tolerance, "margin"))
        self.replace(target)

    def replace(self, target: str | Sequence[str]) -> None:
        """Change the targets; `TypeError` unless both are one frame, or both a sequence."""
        if isinstance(target, str) is not self.one:
            wanted = "one target" if self.one else "a sequence of targets"
            raise TypeError(f"the filter was made for {wanted}, and its pairs keep their shape: not {target!r}")
        self._names = self._names_of(target)

    def questions(self, frame: str, stamp: int | Latest) -> list[Asked]:
        """The questions of a message; the last one of each target gives its transform."""
        if not self._tolerance or isinstance(stamp, Latest):
            return [(target, frame, stamp) for target in self._names if target != frame]
        later = min(stamp + self._tolerance, STAMP_MAX)
        return [(target, frame, at) for target in self._names if target != frame for at in (later, stamp)]

    def plain(self, questions: list[Asked]) -> AnswerT | None:
        """The answer if it is the plain one of an only question; None where one has to look closer."""
        if not self.one or len(questions) != 1:
            return None
        return cast(AnswerT | None, self._buffer._paths.answer(*questions[0]))

    def look(self, frame: str, stamp: int | Latest) -> AnswerT | Blocked:
        """The answer, or what blocks it.

        Raises
        ------
        TransformLookupError
            If there is no answer, and waiting cannot help.
        """
        now = self._buffer.bus.clock.now() if isinstance(stamp, Latest) else stamp
        found = {frame: answer_of(frame, frame, now, IDENTITY, static=True)}
        questions = self.questions(frame, stamp)
        blocked: Blocked | None = None
        for asked in questions:
            try:
                found[asked[0]] = self._buffer.lookup_nowait(*asked)
            except MAY_COME as error:
                if blocked is None:
                    others = [other for other in questions if other is not asked]
                    blocked = Blocked([asked, *others], without_traceback(error))
        if blocked is not None:
            return blocked
        answers = tuple(found[target] for target in self._names)
        return cast(AnswerT, answers[0] if self.one else answers)

    def _names_of(self, target: str | Sequence[str]) -> tuple[str, ...]:
        names = (target,) if isinstance(target, str) else tuple(target)
        if not names:
            raise ValueError("there must be at least one target")
        for name in names:
            if not is_frame(name):
                raise UnknownFrameError(frame=name, known=forest_of(self._buffer.tree).some_frames())
        return names


MessageOverflow = Literal["drop_oldest", "drop_newest", "block"]
"""Drop the oldest message, drop the new message, or stop reading the source."""


class MessageFilter(AsyncOnly, Generic[MessageT, AnswerT]):
    """Pairs each message with its transform: ``async with MessageFilter(...) as pairs: async for message, t in pairs``.

    Every message that arrives is delivered once or dropped once, and no drop is silent: `dropped` counts them by
    reason, and `on_drop` is called for each. The iteration ends when the source is exhausted and no message waits any
    more, or when the bus or the buffer is closed and all ready messages have been read. One task at a time may read.

    Parameters
    ----------
    messages : async iterable
        The source: an async generator, a stream of anyio, anything with ``__aiter__``. Leaving the ``async with``
        closes an async generator for good, but no other source.
    buffer : Buffer
    target : str or sequence of str
        The frame into which the transforms lead. With a sequence, all of them are needed, and the pair holds a tuple of
        transforms in that order. A message that is in the target already is ready at once, even if the buffer does not
        know the target.
    frame, stamp : callable, optional
        Give the frame and the stamp (ns, or `LATEST`) of a message; by default its attributes `frame` and `stamp`.
    margin : float
        In s. A message is ready only when the transforms at its stamp and this much later are both known, as with the
        ``setTolerance`` of tf2.
    timeout : float, optional
        How long a message may wait, in s on the bus's clock from its arrival; None for ever. A ready message does not
        time out.
    capacity : int
        How many messages may wait or be ready and unread.
    overflow : {"drop_oldest", "drop_newest", "block"}
        If a message arrives while the filter is full: drop the oldest message, drop the new message, or stop reading
        the source until there is room. Use ``"block"`` for a source that does not wait by itself, such as a recording.
    order : {"ready", "stamp", "arrival"}
        Deliver messages as they become ready, or by stamp, or in the order of arrival. A waiting message holds back
        newer messages with ``"stamp"``, and later ones with ``"arrival"``.
    on_drop : callable, optional
        Called with a message, the reason, and the error that says what it lacked, or None for a ready message. If it
        raises an `Exception`, that is logged once and counted.
    tolerance : float, optional
        The earlier name of `margin`; deprecated, because the `tolerance` of a lookup means the opposite.

    Raises
    ------
    UnknownFrameError
        If a target cannot be the name of a frame.
    TypeError, ValueError
        If an argument is of the wrong type, negative, or not one of the words above.

    Notes
    -----
    The reasons are ``"too old"`` (older than an edge's window, or in a gap), ``"queue full"``, ``"timed out"``,
    ``"unknown frame"`` (a name that cannot be a frame's, or one that was still unknown when the time was up),
    ``"clock reset"`` (it waited when the clock jumped back) and ``"closed"`` (the bus or the buffer was closed, or the
    ``async with`` was left).

    An error of the source, or of `frame` and `stamp`, is raised unchanged by the iteration, after the ready messages;
    if nobody reads on, by the end of the ``async with``, unless that is left by another exception. An exception that is
    no `Exception`, such as Ctrl-C, stops the body at once, and is raised unchanged by the ``async with``.

    Examples
    --------
    >>> from collections.abc import AsyncIterator
    >>> async def points() -> AsyncIterator[PointStamped]:
    ...     yield PointStamped("laser", 0, (1.0, 0.0, 0.0))
    >>> bus = Bus(SimulatedClock())
    >>> TransformBroadcaster(bus).send_static("base_link", "laser", Transform((0.1, 0.0, 0.2)))
    >>> with Buffer(bus) as buffer:
    ...     async with MessageFilter(points(), buffer, target="base_link") as pairs:
    ...         async for point, transform in pairs:
    ...             print(point.frame, transform.parent)
    laser base_link
    """

    @overload
    def __init__(
        self: "MessageFilter[MessageT, TransformStamped]",
        messages: AsyncIterable[MessageT],
        buffer: Buffer,
        target: str,
        *,
        frame: Callable[[MessageT], str] | None = None,
        stamp: Callable[[MessageT], int | Latest] | None = None,
        margin: float = 0.0,
        timeout: float | None = None,
        capacity: int = 100,
        overflow: MessageOverflow = "drop_oldest",
        order: Order = "ready",
        on_drop: Callable[[MessageT, DropReason, TransformError | None], object] | None = None,
        tolerance: float | None = None,
    ) -> None: ...

    @overload
    def __init__(
        self: "MessageFilter[MessageT, tuple[TransformStamped, ...]]",
        messages: AsyncIterable[MessageT],
        buffer: Buffer,
        target: Sequence[str],
        *,
        frame: Callable[[MessageT], str] | None = None,
        stamp: Callable[[MessageT], int | Latest] | None = None,
        margin: float = 0.0,
        timeout: float | None = None,
        capacity: int = 100,
        overflow: MessageOverflow = "drop_oldest",
        order: Order = "ready",
        on_drop: Callable[[MessageT, DropReason, TransformError | None], object] | None = None,
        tolerance: float | None = None,
    ) -> None: ...

    def __init__(
        self,
        messages: AsyncIterable[MessageT],
        buffer: Buffer,
        target: str | Sequence[str],
        *,
        frame: Callable[[MessageT], str] | None = None,
        stamp: Callable[[MessageT], int | Latest] | None = None,
        margin: float = 0.0,
        timeout: float | None = None,
        capacity: int = 100,
        overflow: MessageOverflow = "drop_oldest",
        order: Order = "ready",
        on_drop: Callable[[MessageT, DropReason, TransformError | None], object] | None = None,
        tolerance: float | None = None,
    ) -> None:
        if tolerance is not None:
            warnings.warn(
                "the tolerance of a MessageFilter is called margin, because that of a lookup means the opposite",
                DeprecationWarning,
                stacklevel=2,
            )
            margin = tolerance
        if not isinstance(messages, AsyncIterable):
            raise TypeError(f"messages must be an async iterable, not {messages!r}")
        if overflow not in ("drop_oldest", "drop_newest", "block"):
            raise ValueError(f"overflow must be 'drop_oldest', 'drop_newest' or 'block', not {overflow!r}")
        for name, function in (("frame", frame), ("stamp", stamp)):
            if function is not None and not callable(function):
                raise TypeError(f"{name} must be callable, not {function!r}")
        self.buffer = buffer
        self._messages = messages
        self._targets: Targets[AnswerT] = Targets(buffer, target, margin)
        self._frame: Callable[[MessageT], str] = frame or attrgetter("frame")
        self._stamp: Callable[[MessageT], int | Latest] = stamp or attrgetter("stamp")
        self._timeout = math.inf if timeout is None else as_duration(timeout, "timeout")
        self._overflow: MessageOverflow = overflow
        self._pending: MessageQueue[MessageT, AnswerT] = MessageQueue(capacity, order)
        self._drops = DroppedMessages(on_drop)
        self._arrived = 0
        self._delivered = 0
        self._tasks: anyio.abc.TaskGroup | None = None
        self._registrations: list[Registration] = []
        self._error: BaseException | None = None
        self._exhausted = False
        self._lookups = buffer._lookups
        self._due: dict[PendingMessage[MessageT, AnswerT], None] = {}
        self._reader = OneReader()
        self._room: anyio.Event | None = None
        self._warn_unless_entered()

    @property
    def arrived(self) -> int:
        """Number of messages from the source: ``arrived == delivered + sum(dropped.values()) + pending``."""
        return self._arrived

    @property
    def delivered(self) -> int:
        """Number of messages that the reader has got."""
        return self._delivered

    @property
    def pending(self) -> int:
        """Number of messages that wait, or are ready and unread."""
        return len(self._pending)

    @property
    def dropped(self) -> Counter[DropReason]:
        """Number of dropped messages by reason; a copy."""
        return self._drops.counts.copy()

    @property
    def callbacks_failed(self) -> int:
        """Number of exceptions that `on_drop` raised."""
        return self._drops.callbacks_failed

    def set_target(self, target: str | Sequence[str]) -> None:
        """Change the target, also for the messages that wait; ready messages keep their transform.

        Parameters
        ----------
        target : str or sequence of str
            One frame if the filter was made with one, otherwise a sequence.

        Raises
        ------
        UnknownFrameError
            If a target cannot be the name of a frame.
        TypeError
            If it is one frame instead of a sequence, or the other way round.
        ValueError
            If the sequence is empty.

        Examples
        --------
        >>> async def points():
        ...     yield PointStamped("laser", 5, (1.0, 0.0, 0.0))
        >>> with Bus() as bus, Buffer(bus) as buffer:
        ...     TransformBroadcaster(bus).send_static("map", "laser", Transform((2.0, 0.0, 0.0)))
        ...     async with MessageFilter(points(), buffer, "odom") as pairs:
        ...         pairs.set_target("map")
        ...         print([answer.parent async for _, answer in pairs])
        ['map']
        """
        self._targets.replace(target)
        for pending in self._pending.waiting:
            self._make_due(pending)

    async def __aenter__(self) -> "MessageFilter[MessageT, AnswerT]":
        self._enter_once()
        self.buffer.bus._check_thread()
        self._tasks = await anyio.create_task_group().__aenter__()
        source = anyio.CancelScope()
        self._registrations = [
            self.buffer.bus.clock.on_jump(self._clock_jumped),
            self.buffer.on_close(source.cancel),
        ]
        self._tasks.start_soon(self._read_source, source)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        assert self._tasks is not None
        self._tasks.cancel_scope.cancel()
        try:
            await close_task_group(self._tasks)
        except BaseExceptionGroup:
            raise
        except BaseException as raised:  # noqa: BLE001 - raised below
            self._error, error = raised, None
        finally:
            for registration in self._registrations:
                registration.close()
            # A callback that changes the target calls no attendant for messages that are due.
            self._due = dict.fromkeys(self._pending.messages)
            for pending in self._due:
                self._drop(pending, "closed", self._blocker(pending))
            self._due.clear()
        if error is None:
            self._raise_error()

    def __aiter__(self) -> "MessageFilter[MessageT, AnswerT]":
        return self

    async def __anext__(self) -> tuple[MessageT, AnswerT]:
        if self._tasks is None:
            raise RuntimeError("enter the message filter first: async with MessageFilter(...) as pairs")
        with self._reader:
            await checkpoint()
            while (ready := self._pending.pop_ready()) is None:
                self._raise_error()
                if self._exhausted and not self._pending.unanswered:
                    raise StopAsyncIteration
                await self._reader.wait()
        self._delivered += 1
        if self._room is not None:
            self._room.set()
        return ready

    async def _read_source(self, scope: anyio.CancelScope) -> None:
        try:
            with scope:
                self._error = await read_source(self._messages, self._take)
        finally:
            self._exhausted = True
            self._wake()

    async def _take(self, message: MessageT) -> None:
        self._accept(message)
        await checkpoint()
        while self._overflow == "block" and self._pending.full:
            self._room = anyio.Event()
            try:
                await self._room.wait()
            finally:
                self._room = None

    def _accept(self, message: MessageT) -> None:
        frame, stamp = self._frame(message), self._stamp(message)
        if stamp is not LATEST or self._pending.order == "stamp":
            stamp = as_stamp(stamp)
        named = is_frame(frame)
        self._arrived += 1
        if not named:
            known = forest_of(self.buffer.tree).some_frames()
            self._drops.drop(message, "unknown frame", UnknownFrameError(frame=frame, known=known))
            return
        pending: PendingMessage[MessageT, AnswerT] = PendingMessage(message, frame, stamp)
        questions = self._targets.questions(frame, stamp)
        found: AnswerT | Blocked | None = self._targets.plain(questions)
        if found is None and (self._pending.full or not self._park(pending, questions)):
            try:
                found = self._look(pending)
            except TransformLookupError as error:
                self._forget_wait(pending)
                self._drops.drop(message, reason_of(error), error)
                return
        oldest, lacking = None, None
        if self._pending.full:
            if self._overflow == "drop_newest":
                self._drops.drop(message, "queue full", found.error if isinstance(found, Blocked) else None)
                return
            oldest = self._pending.oldest
            lacking = self._blocker(oldest)
            self._remove(oldest)
        self._pending.append(pending)
        if found is not None:
            self._give(pending, found)
        if oldest is not None:
            # Last, so that the callback finds consistent counters.
            self._drops.drop(oldest.message, "queue full", lacking)

    def _look(self, pending: PendingMessage[MessageT, AnswerT]) -> AnswerT | Blocked:
        """The answer of a message, or what blocks it; `LookupTimeoutError` if its time is up and waiting might help."""
        found = self._targets.look(pending.frame, pending.stamp)
        expired = not self._timeout if pending.wait is None else pending.wait.expired
        if not expired or not isinstance(found, Blocked):
            return found
        target, source, _ = found.questions[0]
        error = found.error
        raise LookupTimeoutError(target=target, source=source, timeout=self._timeout, missing=error) from error

    def _give(self, pending: PendingMessage[MessageT, AnswerT], found: AnswerT | Blocked) -> None:
        """Make a message in the queue ready, or let it wait for what it lacks; drop it if no more samples will come."""
        if isinstance(found, Blocked):
            try:
                self._park(pending, *found)
            except BusClosedError as error:
                self._drop(pending, reason_of(error), error)
            return
        tree = self.buffer.tree
        self._forget_wait(pending)
        self._pending.set_answer(pending, found, moment=tree.inserted + tree.replaced)
        self._reader.wake()

    def _park(
        self,
        pending: PendingMessage[MessageT, AnswerT],
        questions: list[Asked],
        error: TransformLookupError | None = None,
    ) -> bool:
        """Let a message wait, as `Lookups.park` does, with what it returns and raises."""
        wait = pending.wait
        if wait is None:
            if not questions or not self._timeout:
                return False
            wait = pending.wait = Wait((), self.buffer.bus.clock.now(), partial(self._woken, pending))
            wait.patience = self._timeout
        wait.asked, *wait.others = [self.buffer._on_bus(Question(*asked)) for asked in questions]
        return self._lookups.park(wait, error)

    def _woken(self, pending: PendingMessage[MessageT, AnswerT]) -> None:
        """Take the answer of an insertion, or let the attendant ask again. Called inside a publish, or by an alarm."""
        wait = pending.wait
        if wait is None or pending in self._due:
            return
        answer = self._lookups.given(wait) if self._targets.one and not wait.others else None
        if answer is None:
            self._make_due(pending)
        else:
            self._give(pending, cast(AnswerT, answer))

    def _make_due(self, pending: PendingMessage[MessageT, AnswerT]) -> None:
        if not self._due and self._tasks is not None:
            self._tasks.start_soon(self._attend)
        self._due[pending] = None

    async def _attend(self) -> None:
        """Ask again for each message that is due: answer it, let it wait on, or drop it."""
        while self._due:
            pending = next(iter(self._due))
            if self._pending.is_waiting(pending):
                try:
                    self._give(pending, self._look(pending))
                except TransformError as error:
                    self._drop(pending, reason_of(error), error)
            self._due.pop(pending, None)

    def _blocker(self, pending: PendingMessage[MessageT, AnswerT]) -> TransformLookupError | None:
        """The error that blocks a message now; None for one with an answer."""
        return None if pending.wait is None else self._lookups.blocker(pending.wait)

    def _clock_jumped(self, before: int, after: int) -> None:
        if after < before:
            for pending in self._pending.waiting:
                self._drop(pending, "clock reset", ClockResetError(before=before, after=after))

    def _drop(
        self, pending: PendingMessage[MessageT, AnswerT], reason: DropReason, error: TransformError | None
    ) -> None:
        if pending in self._pending:
            self._remove(pending)
            self._drops.drop(pending.message, reason, error)

    def _remove(self, pending: PendingMessage[MessageT, AnswerT]) -> None:
        self._pending.remove(pending)
        self._forget_wait(pending)
        self._wake()

    def _forget_wait(self, pending: PendingMessage[MessageT, AnswerT]) -> None:
        # The wait refers to the message: without this line they form a reference cycle.
        wait, pending.wait = pending.wait, None
        if wait is not None:
            self._lookups.end(wait)

    def _wake(self) -> None:
        self._reader.wake()
        if self._room is not None:
            self._room.set()

    def _raise_error(self) -> None:
        error, self._error = self._error, None
        if error is not None:
            raise_unchanged(error)
