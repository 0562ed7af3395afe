"""The server of a buffer: other processes ask it, and wait for the answers, instead of hearing all that it holds."""

import threading
from collections import Counter, deque
from collections.abc import Mapping
from contextlib import suppress
from functools import partial
from time import monotonic
from types import TracebackType
from typing import Any, Self

import anyio
import anyio.abc
import zenoh

from tfbus._aio.loop_waker import LoopWaker
from tfbus._aio.task_groups import close_task_group
from tfbus.buffer.buffer import Buffer
from tfbus.bus.sample_queue import check_capacity
from tfbus.errors import MAY_COME, RemoteLookupError, TransformError
from tfbus.geometry.stamped import TransformStamped
from tfbus.links._remote_lookup import (
    Cancellation,
    RemoteQuestion,
    as_timeout,
    read_question,
    write_answer,
)
from tfbus.links.link import warn_unless_entered
from tfbus.links.zenoh._keys import new_id
from tfbus.links.zenoh._lookup_session import LookupSession, reply_now
from tfbus.links.zenoh._settings import Addresses
from tfbus.links.zenoh.zenoh_link import ZenohLink
from tfbus.statistics import BufferServerStatistics, QueueStatistics
from tfbus.tree.policy import Hold

_Item = tuple[zenoh.Query, RemoteQuestion] | Cancellation | str
"""A question that has to wait, the end of one, or an asker that has gone."""
LONGEST_WAIT = 10.0
"""s; then the asker is told what is missing, and asks again if it still wants to know."""


class BufferServer:
    """Answers lookups of other processes from a buffer: ``async with BufferServer(buffer, robot="r17")``.

    A lookup waits here as any lookup of the buffer does; a `BufferClient` asks. It is what a BufferServer is in tf2.

    Parameters
    ----------
    buffer : Buffer
    domain : str, optional
        As that of a `ZenohLink`; by default ``"tf"``, or that of `link`.
    robot : str, optional
        The robot whose buffer this is; askers name it.
    link : ZenohLink, optional
        An entered link whose session is used. By default, the server has a session of its own.
    listen, connect, config, lease
        As those of a `ZenohLink`, for a session of its own.
    capacity : int
        How many lookups may wait at once; beyond that they are refused.
    rate : float
        How many lookups are taken in a second, and at once (one at least); beyond that they are refused.

    Raises
    ------
    ValueError, TypeError
        If an argument is out of range or of another type, or `link` comes with a domain or addresses.
    OSError
        On entering, if it cannot listen where it should, or as a client reaches nobody.
    RuntimeError
        On entering a second time, or while the link is not entered.

    Notes
    -----
    Lookups that can be answered at once are answered by a thread of their own, also while the event loop is busy. The
    others wait on the event loop, until the asker is cancelled or goes. Where one robot has several servers, one of
    them answers. Anyone who can reach the server can ask it.
    """

    def __init__(
        self,
        buffer: Buffer,
        domain: str | None = None,
        *,
        robot: str | None = None,
        link: ZenohLink | None = None,
        listen: Addresses | None = None,
        connect: Addresses | None = None,
        config: Mapping[str, Any] | None = None,
        lease: float | None = None,
        capacity: int = 1_000,
        rate: float = 10_000.0,
    ) -> None:
        check_capacity(capacity)
        # Not a number is not greater either.
        if not rate > 0:
            raise ValueError(f"a rate must be greater than zero, got {rate!r} Hz")
        self._buffer = buffer
        self._session = LookupSession(domain, robot, link, listen, connect, config, lease)
        self._capacity = capacity
        self._rate = rate
        self._allowance = self._most_at_once = max(rate, 1.0)
        self._refilled = monotonic()
        self._entered = False
        self._received: deque[_Item] = deque()
        self._came = anyio.Event()
        self._waker = LoopWaker(lambda: self._came.set())
        self._waiting: dict[tuple[str, int], anyio.CancelScope] = {}
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()
        self._tasks: anyio.abc.TaskGroup | None = None
        self._never_entered = warn_unless_entered(self)

    def statistics(self) -> BufferServerStatistics:
        """All counters, as they are now."""
        counts = self._counts
        refused = {**counts, "internal": self._session.failures.count}
        return BufferServerStatistics(
            waiting=len(self._waiting),
            answered=counts["answered"],
            failed=counts["failed"],
            cancelled=counts["cancelled"],
            refused={reason: refused[reason] for reason in ("busy", "malformed", "internal") if refused.get(reason)},
            queue=QueueStatistics("lookups", "drop_newest", self._capacity, len(self._received), counts["dropped"]),
        )

    async def __aenter__(self) -> Self:
        if self._entered:
            raise RuntimeError("a buffer server is entered once: make another one")
        self._entered = True
        self._never_entered.detach()
        self._waker.bind()
        await self._session.open()
        self._tasks = await anyio.create_task_group().__aenter__()
        self._tasks.start_soon(self._take_all, self._tasks)
        self._session.follow("@asking", self._note_asker)
        self._session.answer(self._receive, new_id())
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        assert self._tasks is not None
        tasks, self._tasks = self._tasks, None
        tasks.cancel_scope.cancel()
        try:
            await close_task_group(tasks)
        finally:
            self._received.clear()
            await self._session.close()

    def _receive(self, query: zenoh.Query) -> None:
        if max(len(self._received), self._session.unsent) >= self._capacity:
            self._count("dropped")
            query.drop()
            return
        self._session.soon(partial(self._take, query))

    def _note_asker(self, asker: str, present: bool) -> None:
        if not present:
            # Behind its questions.
            self._session.soon(partial(self._hand_over, asker))

    def _hand_over(self, item: _Item) -> None:
        self._received.append(item)
        # The event loop may have ended without the end of the server, as in a crash.
        with suppress(RuntimeError):
            self._waker.wake()

    def _take(self, query: zenoh.Query) -> None:
        """Answer a question that can be answered now, else have the event loop wait; for the session's thread."""
        try:
            question = read_question(b"" if query.payload is None else query.payload.to_bytes())
        except ValueError as error:
            self._refuse(query, "malformed", f"the question cannot be read: {error}")
            return
        if isinstance(question, Cancellation):
            self._hand_over(question)
            query.drop()
            return
        if not self._admit():
            self._refuse(query, "busy", f"more than {self._rate:g} lookups come in a second")
            return
        answer: TransformStamped | Exception
        try:
            answer = self._buffer.lookup_nowait(**_arguments(question))
        except MAY_COME:
            self._hand_over((query, question))
            return
        except Exception as error:  # noqa: BLE001 - it is told to the asker
            answer = error
        self._answer(query, answer, at_once=True)

    async def _take_all(self, tasks: anyio.abc.TaskGroup) -> None:
        while True:
            self._came = anyio.Event()
            while self._received:
                received = self._received.popleft()
                if isinstance(received, str):
                    for key in [key for key in self._waiting if key[0] == received]:
                        self._cancel(key)
                elif isinstance(received, Cancellation):
                    self._cancel((received.asker, received.number))
                else:
                    self._begin_to_wait(*received, tasks)
            await self._came.wait()

    def _begin_to_wait(self, query: zenoh.Query, question: RemoteQuestion, tasks: anyio.abc.TaskGroup) -> None:
        key = question.asker, question.number
        if key in self._waiting:
            self._refuse(query, "malformed", "the number of the question was used before")
        elif len(self._waiting) >= self._capacity:
            self._refuse(query, "busy", f"{self._capacity} lookups wait there, and no more may")
        else:
            self._waiting[key] = scope = anyio.CancelScope()
            tasks.start_soon(self._wait, query, question, key, scope)

    def _admit(self) -> bool:
        now = monotonic()
        self._allowance = min(self._most_at_once, self._allowance + (now - self._refilled) * self._rate)
        self._refilled = now
        if self._allowance < 1:
            return False
        self._allowance -= 1
        return True

    def _cancel(self, key: tuple[str, int]) -> None:
        scope = self._waiting.pop(key, None)
        if scope is not None:
            self._count("cancelled")
            scope.cancel()

    async def _wait(
        self, query: zenoh.Query, question: RemoteQuestion, key: tuple[str, int], scope: anyio.CancelScope
    ) -> None:
        answer: TransformStamped | Exception | None = None
        with scope:
            try:
                timeout = as_timeout(question.timeout, LONGEST_WAIT)
                answer = await self._buffer.lookup(**_arguments(question), timeout=timeout)
            except Exception as error:  # noqa: BLE001 - it is told to the asker
                answer = error
            finally:
                self._waiting.pop(key, None)
        if answer is None:
            query.drop()
        else:
            self._answer(query, answer)

    def _answer(self, query: zenoh.Query, answer: TransformStamped | Exception, at_once: bool = False) -> None:
        """Count an answer and send it; no error of one question ends the thread or the task."""
        try:
            if isinstance(answer, Exception) and not isinstance(answer, (TransformError, TypeError, ValueError)):
                # As one that cannot be written.
                raise answer
            message = write_answer(answer)
        except Exception as error:  # noqa: BLE001 - the next question is answered
            self._session.failures.note(error, "a lookup of another process")
            message = self._refusal("internal", f"the lookup failed there with {type(error).__name__}")
        else:
            self._count("failed" if isinstance(answer, Exception) else "answered")
        (reply_now if at_once else self._reply)(query, message)

    def _refuse(self, query: zenoh.Query, reason: str, detail: str) -> None:
        self._count(reason)
        self._reply(query, self._refusal(reason, detail))

    def _refusal(self, reason: str, detail: str) -> bytes:
        domain, robot = self._session.domain, self._session.robot
        return write_answer(RemoteLookupError(domain=domain, robot=robot, reason=reason, detail=detail))

    def _reply(self, query: zenoh.Query, answer: bytes) -> None:
        if self._session.unsent >= self._capacity:
            self._count("dropped")
            query.drop()
            return
        self._session.reply(query, answer)

    def _count(self, what: str) -> None:
        # Threads of zenoh, that of the session and the event loop count.
        with self._lock:
            self._counts[what] += 1


def _arguments(question: RemoteQuestion) -> dict[str, Any]:
    return {
        "target": question.target,
        "source": question.source,
        "at": question.at,
        "max_age": question.max_age,
        "source_at": question.source_at,
        "fixed": question.fixed,
        "tolerance": question.tolerance,
        "max_gap": question.max_gap,
        "extrapolate": None if question.hold is None else Hold(question.hold),
    }
