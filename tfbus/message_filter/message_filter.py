"""Messages come in as they like and come out with their transform, as soon as that is known.

One task reads the source. A message that can be answered on arrival is ready at once; any other gets a task that waits
for its transforms, so there are never more than `capacity` of these. No task raises: what goes wrong with a message is
a drop, and what the source raises is kept for the reader.
"""

import math
from collections import Counter
from collections.abc import AsyncGenerator, AsyncIterable, Callable, Sequence
from contextlib import suppress
from operator import attrgetter
from types import TracebackType
from typing import Generic, Literal, TypeVar, overload

import anyio
import anyio.abc
import anyio.lowlevel

from tfbus.buffer.buffer import Buffer
from tfbus.errors import MAY_COME, ClockResetError, TransformError, TransformLookupError, UnknownFrameError
from tfbus.frames import is_frame
from tfbus.geometry.stamped import TransformStamped
from tfbus.message_filter._dropped_messages import DroppedMessages, DropReason, reason_of
from tfbus.message_filter._message_queue import MessageQueue, Order, PendingMessage
from tfbus.message_filter._targets import Targets
from tfbus.registration import Registration
from tfbus.stamps import LATEST, Latest, as_duration, as_stamp

MessageT = TypeVar("MessageT")
AnswerT = TypeVar("AnswerT")

MessageOverflow = Literal["drop_oldest", "drop_newest", "block"]
"""Drop the message that arrived first, drop the one that arrives, or stop reading the source."""


class MessageFilter(Generic[MessageT, AnswerT]):
    """Pairs each message with its transform: ``async with MessageFilter(...) as pairs: async for message, t in pairs``.

    Every message that arrives is delivered once or dropped once, and no drop is silent: `dropped` counts them by
    reason, and `on_drop` hears of each. The iteration ends when the source is exhausted and nothing waits any more, or
    when the bus or the buffer is closed and what is ready has been read. The filter is for one reader at a time.

    Parameters
    ----------
    messages : async iterable
        Where messages come from: an async generator, a stream of anyio, anything with ``__aiter__``. Leaving the
        ``async with`` closes an async generator, which can be read no further, and nothing else.
    buffer : Buffer
    target : str or sequence of str
        The frame that messages are wanted in. Of several, all are needed, and the pair holds a tuple of transforms in
        that order. A message that is in the target already is ready at once, whatever the buffer knows.
    frame, stamp : callable, optional
        Give the frame and the stamp (ns, or `LATEST`) of a message; by default its attributes `frame` and `stamp`.
    tolerance : float
        In s. Demands more, where that of a lookup allows more: a message is answered only when its stamp and the one
        this much later both can be.
    timeout : float, optional
        How long a message may wait, in s on the bus's clock from its arrival; None for ever. One that is ready does
        not time out.
    capacity : int
        How many messages may wait or be ready and unread.
    overflow : {"drop_oldest", "drop_newest", "block"}
        What happens when one more arrives: the first that arrived is dropped, or the new one, or none, because the
        source is not read until there is room. To replay what does not wait by itself, such as a recording, block.
    order : {"ready", "stamp", "arrival"}
        Deliver as messages become answerable; or by stamp, which holds back what is newer than a message that waits;
        or as they came, which holds back what came after one that waits.
    on_drop : callable, optional
        Called with a message, the reason, and the error that says what it lacked, or None for one that lacked
        nothing. If it raises an `Exception`, that is logged once and counted.

    Raises
    ------
    UnknownFrameError
        If a target cannot be the name of a frame.
    TypeError, ValueError
        If an argument is of the wrong type, negative, or none of the words above.

    Notes
    -----
    The reasons are ``"too old"`` (older than an edge's window, or in a gap), ``"queue full"``, ``"timed out"``,
    ``"unknown frame"`` (a name that cannot be a frame's, or one that was still unknown when the time was up),
    ``"clock reset"`` (it waited when the clock jumped back) and ``"closed"`` (the bus or the buffer was closed, or the
    ``async with`` was left).

    What the source raises, and what `frame` and `stamp` raise, comes out of the iteration as it is, after what is
    ready; if nobody reads on, out of the end of the ``async with``, unless that is left by another exception. What is
    no `Exception`, such as Ctrl-C, stops the body at once, and comes out of the ``async with`` as it is.
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
        tolerance: float = 0.0,
        timeout: float | None = None,
        capacity: int = 100,
        overflow: MessageOverflow = "drop_oldest",
        order: Order = "ready",
        on_drop: Callable[[MessageT, DropReason, TransformError | None], object] | None = None,
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
        tolerance: float = 0.0,
        timeout: float | None = None,
        capacity: int = 100,
        overflow: MessageOverflow = "drop_oldest",
        order: Order = "ready",
        on_drop: Callable[[MessageT, DropReason, TransformError | None], object] | None = None,
    ) -> None: ...

    def __init__(
        self,
        messages: AsyncIterable[MessageT],
        buffer: Buffer,
        target: str | Sequence[str],
        *,
        frame: Callable[[MessageT], str] | None = None,
        stamp: Callable[[MessageT], int | Latest] | None = None,
        tolerance: float = 0.0,
        timeout: float | None = None,
        capacity: int = 100,
        overflow: MessageOverflow = "drop_oldest",
        order: Order = "ready",
        on_drop: Callable[[MessageT, DropReason, TransformError | None], object] | None = None,
    ) -> None:
        if not isinstance(messages, AsyncIterable):
            raise TypeError(f"messages must be an async iterable, not {messages!r}")
        if overflow not in ("drop_oldest", "drop_newest", "block"):
            raise ValueError(f"overflow must be 'drop_oldest', 'drop_newest' or 'block', not {overflow!r}")
        for name, function in (("frame", frame), ("stamp", stamp)):
            if function is not None and not callable(function):
                raise TypeError(f"{name} must be callable, not {function!r}")
        self.buffer = buffer
        self._messages = messages
        self._targets: Targets[AnswerT] = Targets(buffer, target, tolerance)
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
        self._reading = anyio.ResourceGuard("reading from")
        self._reader: anyio.Event | None = None
        self._room: anyio.Event | None = None

    @property
    def arrived(self) -> int:
        """Messages that have come from the source: ``arrived == delivered + sum(dropped.values()) + pending``."""
        return self._arrived

    @property
    def delivered(self) -> int:
        """Messages that the reader has got."""
        return self._delivered

    @property
    def pending(self) -> int:
        """Messages that wait, or are ready and unread."""
        return len(self._pending)

    @property
    def dropped(self) -> Counter[DropReason]:
        """How many messages were dropped for which reason; a copy."""
        return self._drops.counts.copy()

    @property
    def callbacks_failed(self) -> int:
        """Exceptions that `on_drop` raised."""
        return self._drops.callbacks_failed

    def set_target(self, target: str | Sequence[str]) -> None:
        """Want messages in another frame from now on, those that wait too; what is ready keeps its transform.

        Parameters
        ----------
        target : str or sequence of str
            As at the beginning: one frame if it was one, and else a sequence.

        Raises
        ------
        UnknownFrameError
            If a target cannot be the name of a frame.
        TypeError
            If it is one frame instead of a sequence, or the other way round.
        ValueError
            If the sequence is empty.
        """
        self._targets.replace(target)
        for pending in self._pending.waiting:
            pending.stop()

    async def __aenter__(self) -> "MessageFilter[MessageT, AnswerT]":
        if self._tasks is not None:
            raise RuntimeError("a message filter is entered once: make another one")
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
            # A task group would wrap what the body raises, so it is not told.
            await self._tasks.__aexit__(None, None, None)
        except BaseExceptionGroup as group:
            if len(group.exceptions) > 1:
                raise
            self._error, error = group.exceptions[0], None
        finally:
            for registration in self._registrations:
                registration.close()
            for pending in self._pending.everything:
                self._drop(pending, "closed", self._blocker(pending))
        if error is None:
            self._raise_error()

    def __aiter__(self) -> "MessageFilter[MessageT, AnswerT]":
        return self

    async def __anext__(self) -> tuple[MessageT, AnswerT]:
        if self._tasks is None:
            raise RuntimeError("enter the message filter first: async with MessageFilter(...) as pairs")
        with self._reading:
            await anyio.lowlevel.checkpoint()
            while (pending := self._pending.take()) is None:
                self._raise_error()
                if self._exhausted and not self._pending.unanswered:
                    raise StopAsyncIteration
                self._reader = anyio.Event()
                try:
                    await self._reader.wait()
                finally:
                    self._reader = None
        self._delivered += 1
        self._wake()
        return pending.message, pending.answers[0]

    async def _read_source(self, scope: anyio.CancelScope) -> None:
        try:
            with scope:
                await anyio.lowlevel.checkpoint()
                messages = aiter(self._messages)
                try:
                    async for message in messages:
                        self._arrive(message)
                        await anyio.lowlevel.checkpoint()
                        await self._make_room()
                finally:
                    if isinstance(messages, AsyncGenerator):
                        await messages.aclose()
        except anyio.get_cancelled_exc_class() as error:
            if anyio.current_effective_deadline() == -math.inf:
                raise
            # Nobody cancels this task: the source was cancelled in its own right, as a task of asyncio can be.
            self._error = error
        except Exception as error:  # noqa: BLE001 - the reader raises it
            self._error = error
        finally:
            self._exhausted = True
            self._wake()

    async def _make_room(self) -> None:
        while self._overflow == "block" and self._pending.full:
            self._room = anyio.Event()
            try:
                await self._room.wait()
            finally:
                self._room = None

    def _arrive(self, message: MessageT) -> None:
        frame, stamp = self._frame(message), self._stamp(message)
        if stamp is not LATEST or self._pending.order == "stamp":
            stamp = as_stamp(stamp)
        named = is_frame(frame)
        self._arrived += 1
        if not named:
            self._drops.add(message, "unknown frame", UnknownFrameError(frame=frame, known=self.buffer.tree.frames()))
            return
        answers: list[AnswerT] = []
        blocker: TransformLookupError | None = None
        try:
            if self._timeout:
                answers.append(self._targets.ask(frame, stamp))
            else:
                answers.append(self._targets.ask_for_the_last_time(frame, stamp, 0.0))
        except MAY_COME as error:
            blocker = error
        except TransformLookupError as error:
            self._drops.add(message, reason_of(error), error)
            return
        if self._pending.full and self._overflow == "drop_newest":
            self._drops.add(message, "queue full", blocker)
            return
        dropped = [self._pending.oldest] if self._pending.full else []
        lacking = [self._blocker(pending) for pending in dropped]
        for pending in dropped:
            self._remove(pending)
        self._take_in(PendingMessage(message, frame, stamp), answers)
        # Told last, so that a callback finds the books balanced.
        for pending, lack in zip(dropped, lacking, strict=True):
            self._drops.add(pending.message, "queue full", lack)

    def _take_in(self, pending: PendingMessage[MessageT, AnswerT], answers: list[AnswerT]) -> None:
        assert self._tasks is not None
        self._pending.add(pending)
        if answers:
            self._answer(pending, answers[0])
        else:
            self._tasks.start_soon(self._wait, pending)

    async def _wait(self, pending: PendingMessage[MessageT, AnswerT]) -> None:
        """Wait until a message has its answer, cannot have one, or is out of time."""
        frame, stamp = pending.frame, pending.stamp
        try:
            with self.buffer.bus.clock.move_on_after(self._timeout):
                while self._pending.waits(pending):
                    # Left early when the message is dropped, and to ask for other targets.
                    with anyio.CancelScope() as scope:
                        pending.stop = scope.cancel
                        await self._targets.wait(frame, stamp)
                    if self._pending.waits(pending):
                        with suppress(*MAY_COME):
                            self._answer(pending, self._targets.ask(frame, stamp))
            if self._pending.waits(pending):
                self._answer(pending, self._targets.ask_for_the_last_time(frame, stamp, self._timeout))
        except TransformError as error:
            self._drop(pending, reason_of(error), error)

    def _answer(self, pending: PendingMessage[MessageT, AnswerT], answer: AnswerT) -> None:
        tree = self.buffer.tree
        self._pending.answer(pending, answer, moment=tree.inserted + tree.replaced)
        self._wake()

    def _blocker(self, pending: PendingMessage[MessageT, AnswerT]) -> TransformLookupError | None:
        return None if pending.answers else self._targets.blocker(pending.frame, pending.stamp)

    def _clock_jumped(self, before: int, after: int) -> None:
        if after < before:
            for pending in self._pending.waiting:
                self._drop(pending, "clock reset", ClockResetError(before=before, after=after))

    def _drop(
        self, pending: PendingMessage[MessageT, AnswerT], reason: DropReason, error: TransformError | None
    ) -> None:
        if pending in self._pending:
            self._remove(pending)
            self._drops.add(pending.message, reason, error)

    def _remove(self, pending: PendingMessage[MessageT, AnswerT]) -> None:
        self._pending.remove(pending)
        pending.stop()
        self._wake()

    def _wake(self) -> None:
        for event in (self._reader, self._room):
            if event is not None:
                event.set()

    def _raise_error(self) -> None:
        error, self._error = self._error, None
        if error is not None:
            context = error.__context__
            try:
                raise error
            finally:
                # Raising has put what is handled here in the place of what it was raised from.
                error.__context__ = context
                del error
