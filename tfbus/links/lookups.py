"""Lookups in the buffers of other processes: a link asks, and a `BufferServer` of another link answers.

The signs of life of a link say whether it serves a buffer. A question goes to one such peer of the robot, and waits
there like any lookup of that buffer, for `LONGEST_WAIT` at most. Then the server answers what is missing, and the asker
asks again if its own timeout has not passed. If the asker gives a question up, it cancels it at the server.
`tfbus.links.message` checks the bytes of strangers.
"""

import logging
import os
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from time import monotonic
from types import TracebackType
from typing import Any, Protocol, Self

import anyio
import anyio.abc

from tfbus._aio.task_groups import close_task_group
from tfbus.buffer.buffer import Buffer
from tfbus.bus.queues import check_capacity
from tfbus.bus.subscribers import OnceLogger
from tfbus.errors import MAY_COME, LookupTimeoutError, RemoteLookupError, TransformError, TransformLookupError
from tfbus.geometry.stamped import TransformStamped
from tfbus.links.message import (
    NUMBER,
    Kind,
    RemoteQuestion,
    read_answer,
    read_question,
    write_answer,
    write_body,
    write_question,
)
from tfbus.registration import AsyncOnly
from tfbus.statistics import BufferServerStatistics
from tfbus.tf_message import MalformedMessageError
from tfbus.tree.lookup import Hold

LONGEST_WAIT = 10.0
"""s; then the server answers what is missing."""
PATIENCE = 3.0
"""s; the longest wait for a server that has not joined yet, and for an answer that is late."""
_MOST_SILENCES = 3
_ARGUMENTS = "target", "source", "at", "max_age", "source_at", "fixed", "tolerance", "max_gap", "covariance"


@dataclass(eq=False, slots=True)
class _Pending:
    """A question that was sent: `done` is set when it has an answer, or will have none."""

    peer: str
    answer: bytes | None = None
    done: anyio.Event = field(default_factory=anyio.Event)


class RemoteLookups:
    """The remote lookups of one link: its own questions, and the questions of its peers.

    Parameters
    ----------
    send : callable
        Sends a message to a link; returns False if it is known not to arrive.
    domain : str
    capacity : int
        How many questions may wait for their answers at once.

    Attributes
    ----------
    server : BufferServer or None
        The buffer that this link serves.
    """

    def __init__(self, send: Callable[[str, bytes], bool], domain: str, capacity: int = 10_000) -> None:
        self._send = send
        self._domain = domain
        self._capacity = capacity
        # Drawn at random, so that no peer can guess the numbers of questions to other peers.
        self._first = self._number = int.from_bytes(os.urandom(7), "little")
        self._pending: dict[int, _Pending] = {}
        # The peers that serve a buffer, and their robots.
        self._servers: dict[str, str] = {}
        self._changed = anyio.Event()
        self._is_open = True
        self.server: BufferServer | None = None

    # Coming in

    def close(self) -> None:
        """The link ends."""
        self._is_open = False
        self._changed.set()
        for pending in self._pending.values():
            pending.done.set()

    def note_server(self, peer: str, robot: str, serves: bool) -> None:
        """Note whether a peer serves a buffer; what waits for the answer of one that no longer does has none."""
        if serves != (peer in self._servers):
            if serves:
                self._servers[peer] = robot
            else:
                del self._servers[peer]
                for pending in self._pending.values():
                    if pending.peer == peer:
                        pending.done.set()
            # An anyio event stays set, so later waiters need a new one.
            self._changed.set()
            self._changed = anyio.Event()

    def left(self, peer: str) -> None:
        """Note that a link has gone."""
        self.note_server(peer, "", serves=False)
        if self.server is not None:
            self.server.lose(peer)

    def asked(self, asker: str, data: bytes) -> None:
        """Take a question of a link, or its cancellation: its number, and the question or nothing."""
        number, question = int.from_bytes(data[:NUMBER], "little"), data[NUMBER:]
        if self.server is None:
            self.refuse(asker, number, "absent", "nobody offers it")
        elif question:
            self.server.take(asker, number, question)
        else:
            self.server.cancel(asker, number)

    def answered(self, peer: str, data: bytes) -> None:
        """Take an answer of a link: a number, and the answer.

        Raises
        ------
        MalformedMessageError
            If no question had this number; an answer to a question that was given up is ignored.
        """
        number = int.from_bytes(data[:NUMBER], "little")
        if not self._first < number <= self._number:
            raise MalformedMessageError("lookup", "an answer to a question that was never asked")
        pending = self._pending.get(number)
        if pending is not None and pending.peer == peer:
            pending.answer = data[NUMBER:]
            pending.done.set()

    def put(self, kind: Kind, link: str, number: int, body: bytes) -> bool:
        """Send a question or an answer to a link; returns False if it is known not to arrive."""
        return self._send(link, write_body(kind, number.to_bytes(NUMBER, "little") + body))

    def refuse(self, asker: str, number: int, reason: str, detail: str) -> None:
        """Send an answer that refuses a question."""
        self.put(Kind.LOOKUP_ANSWER, asker, number, write_answer(self._error(None, reason, detail)))

    # Going out

    async def ask(self, question: RemoteQuestion, robot: str | None, limit: float) -> TransformStamped:
        """Ask a link of a robot that serves a buffer, until there is an answer; the errors are those of `lookup`."""
        until = anyio.current_time() + limit
        silences = 0
        while True:
            server = await self._find_server(robot, until)
            left = max(until - anyio.current_time(), 0.0)
            try:
                return await self._ask(server, question, robot, min(left, LONGEST_WAIT))
            except RemoteLookupError as error:
                # A congested network drops questions and answers.
                silences += 1
                if error.reason != "silent" or silences > _MOST_SILENCES or anyio.current_time() >= until:
                    raise
            except LookupTimeoutError as error:
                silences = 0
                if left <= LONGEST_WAIT:
                    missing = error.__cause__ if isinstance(error.__cause__, TransformLookupError) else error
                    target, source = question.target, question.source
                    raise LookupTimeoutError(target=target, source=source, timeout=limit, missing=missing) from missing

    async def _find_server(self, robot: str | None, until: float) -> str:
        server = self._server_of(robot)
        if server is None:
            with anyio.CancelScope(deadline=min(until, anyio.current_time() + PATIENCE)):
                while self._is_open and (server := self._server_of(robot)) is None:
                    await self._changed.wait()
        if not self._is_open:
            raise self._error(robot, "lost", "this link has ended")
        if server is None:
            raise self._error(robot, "absent", "nobody offers it")
        return server

    def _server_of(self, robot: str | None) -> str | None:
        return next((peer for peer, of in self._servers.items() if of == (robot or "")), None)

    async def _ask(self, server: str, question: RemoteQuestion, robot: str | None, timeout: float) -> TransformStamped:
        if len(self._pending) >= self._capacity:
            raise RuntimeError(f"{self._capacity} lookups wait on this link already")
        self._number = number = self._number + 1
        pending = self._pending[number] = _Pending(server)
        answered = False
        try:
            question.timeout = timeout
            if not self.put(Kind.LOOKUP, server, number, write_question(question)):
                raise self._error(robot, "silent", "the question could not be sent")
            with anyio.move_on_after(timeout + PATIENCE):
                await pending.done.wait()
                answered = True
        finally:
            del self._pending[number]
            if not answered:
                self.put(Kind.LOOKUP, server, number, b"")
        if not answered:
            raise self._error(robot, "silent", f"it has not answered within {timeout + PATIENCE:g} s")
        if pending.answer is None:
            raise self._error(robot, "lost", "it has gone" if self._is_open else "this link has ended")
        return read_answer(pending.answer, self._domain, robot, question)

    def _error(self, robot: str | None, reason: str, detail: str) -> RemoteLookupError:
        return RemoteLookupError(domain=self._domain, robot=robot, reason=reason, detail=detail)


class Serving(Protocol):
    """A link that can serve a buffer."""

    @property
    def lookups(self) -> RemoteLookups:
        """The lookups of the link; raises `RuntimeError` unless it is entered."""

    def serve(self, server: "BufferServer | None") -> None:
        """Say to all peers whether this link serves a buffer."""


class BufferServer(AsyncOnly):
    """Answers lookups of other processes from a buffer: ``async with BufferServer(buffer, link)``.

    `DomainLink.lookup` asks it. A question waits like any lookup of the buffer. It does the work of tf2's BufferServer.

    Parameters
    ----------
    buffer : Buffer
    link : DomainLink
        An entered link of tfbus; it serves one buffer. Its robot is what askers name.
    capacity : int
        How many lookups may wait at once; beyond that they are refused.
    rate : float
        How many lookups are taken in a second, and at once (one at least); beyond that they are refused.

    Raises
    ------
    ValueError, TypeError
        If an argument is out of range or of another type.
    RuntimeError
        On entering a second time, while the link is not entered, or if it serves a buffer already.

    Notes
    -----
    Where one robot has several servers, one of them answers. Anyone who can reach the link can ask it.

    Examples
    --------
    >>> import tempfile
    >>> from tfbus.links import BufferServer
    >>> bus = Bus()
    >>> async with LocalLink(bus, directory=tempfile.mkdtemp()) as link:
    ...     async with BufferServer(Buffer(bus), link) as server:
    ...         print(server.statistics().answered)
    0
    """

    def __init__(self, buffer: Buffer, link: Serving, *, capacity: int = 1_000, rate: float = 10_000.0) -> None:
        check_capacity(capacity)
        # Not a number is not greater either.
        if not rate > 0:
            raise ValueError(f"a rate must be greater than zero, got {rate!r} Hz")
        self._buffer = buffer
        self._link = link
        self._capacity = capacity
        self._rate = rate
        self._allowance = self._most_at_once = max(rate, 1.0)
        self._refilled = monotonic()
        self._waiting: dict[tuple[str, int], anyio.CancelScope] = {}
        self._counts: Counter[str] = Counter()
        self._log = OnceLogger(logging.getLogger("tfbus"))
        self._lookups: RemoteLookups
        self._tasks: anyio.abc.TaskGroup
        self._warn_unless_entered()

    def statistics(self) -> BufferServerStatistics:
        """All counters, as they are now.

        Examples
        --------
        >>> import tempfile
        >>> from tfbus.links import BufferServer
        >>> robot, folder = Bus(), tempfile.mkdtemp()
        >>> async with LocalLink(robot, directory=folder) as link, BufferServer(Buffer(robot), link) as server:
        ...     robot.publish(TransformStamped("map", "cart", 0, Transform((2.0, 0.0, 0.0)), static=True))
        ...     async with LocalLink(Bus(), directory=folder) as asker:
        ...         _ = await asker.lookup("map", "cart", timeout=5.0)
        ...     print(server.statistics().answered)
        1
        """
        counts = self._counts
        return BufferServerStatistics(
            waiting=len(self._waiting),
            answered=counts["answered"],
            failed=counts["failed"],
            cancelled=counts["cancelled"],
            refused={reason: counts[reason] for reason in ("busy", "malformed", "internal") if counts[reason]},
        )

    async def __aenter__(self) -> Self:
        self._enter_once()
        self._lookups = self._link.lookups
        if self._lookups.server is not None:
            raise RuntimeError("this link serves a buffer already")
        self._tasks = await anyio.create_task_group().__aenter__()
        self._link.serve(self)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._link.serve(None)
        self._tasks.cancel_scope.cancel()
        await close_task_group(self._tasks)

    def take(self, asker: str, number: int, data: bytes) -> None:
        """Answer a question that can be answered now, else let it wait. Called by the link."""
        key = asker, number
        try:
            question = read_question(RemoteQuestion, data)
        except MalformedMessageError as error:
            self._refuse(key, "malformed", f"the question cannot be read: {error.detail}")
            return
        if not self._admit():
            self._refuse(key, "busy", f"more than {self._rate:g} lookups come in a second")
            return
        if key in self._waiting:
            self._refuse(key, "malformed", "the number of the question was used before")
            return
        try:
            answer: TransformStamped | Exception = self._buffer.lookup_nowait(**_arguments(question))
        except MAY_COME:
            if len(self._waiting) >= self._capacity:
                self._refuse(key, "busy", f"{self._capacity} lookups wait there, and no more may")
                return
            self._waiting[key] = scope = anyio.CancelScope()
            self._tasks.start_soon(self._wait, key, question, scope)
            return
        except Exception as error:  # noqa: BLE001 - it is told to the asker
            answer = error
        self._answer(key, answer)

    def lose(self, asker: str) -> None:
        """Cancel the questions of a link that has gone. Called by the link."""
        for key in [key for key in self._waiting if key[0] == asker]:
            self.cancel(*key)

    def cancel(self, asker: str, number: int) -> None:
        """Cancel a question, if it waits. Called by the link."""
        scope = self._waiting.pop((asker, number), None)
        if scope is not None:
            self._counts["cancelled"] += 1
            scope.cancel()

    async def _wait(self, key: tuple[str, int], question: RemoteQuestion, scope: anyio.CancelScope) -> None:
        answer: TransformStamped | Exception | None = None
        with scope:
            try:
                answer = await self._look_up(question)
            except Exception as error:  # noqa: BLE001 - it is told to the asker
                answer = error
            finally:
                # Another question may have the number by now.
                if self._waiting.get(key) is scope:
                    del self._waiting[key]
        if answer is not None:
            self._answer(key, answer)

    async def _look_up(self, question: RemoteQuestion) -> TransformStamped:
        """The answer, in time by the clock of the bus and by that of this machine: a simulated one may stand still."""
        # Not a number is not less either.
        timeout = LONGEST_WAIT if question.timeout is None else min(LONGEST_WAIT, question.timeout)
        answer: TransformStamped
        with anyio.move_on_after(timeout):
            answer = await self._buffer.lookup(**_arguments(question), timeout=timeout)
            return answer
        try:
            answer = self._buffer.lookup_nowait(**_arguments(question))
        except MAY_COME as missing:
            target, source = question.target, question.source
            raise LookupTimeoutError(target=target, source=source, timeout=timeout, missing=missing) from missing
        return answer

    def _answer(self, key: tuple[str, int], answer: TransformStamped | Exception) -> None:
        """Count an answer and send it; no error of one question ends the task."""
        try:
            if isinstance(answer, Exception) and not isinstance(answer, (TransformError, TypeError, ValueError)):
                # As one that cannot be written.
                raise answer
            message = write_answer(answer)
        except Exception as error:  # noqa: BLE001 - the next question is answered
            self._log.warning(type(error).__name__, "a lookup of another process failed", exc_info=error)
            self._refuse(key, "internal", f"the lookup failed there with {type(error).__name__}")
        else:
            self._counts["failed" if isinstance(answer, Exception) else "answered"] += 1
            self._lookups.put(Kind.LOOKUP_ANSWER, *key, message)

    def _admit(self) -> bool:
        now = monotonic()
        self._allowance = min(self._most_at_once, self._allowance + (now - self._refilled) * self._rate)
        self._refilled = now
        if self._allowance < 1:
            return False
        self._allowance -= 1
        return True

    def _refuse(self, key: tuple[str, int], reason: str, detail: str) -> None:
        self._counts[reason] += 1
        self._lookups.refuse(*key, reason, detail)


def _arguments(question: RemoteQuestion) -> dict[str, Any]:
    hold = None if question.hold is None else Hold(question.hold)
    return {name: getattr(question, name) for name in _ARGUMENTS} | {"extrapolate": hold}
