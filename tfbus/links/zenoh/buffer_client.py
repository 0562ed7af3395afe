"""Lookups in the buffer of another process, which a `BufferServer` there answers."""

import math
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from time import monotonic
from types import TracebackType
from typing import Any, Self

import anyio

from tfbus._aio.loop_waker import LoopWaker
from tfbus.bus.sample_queue import check_capacity
from tfbus.errors import LookupTimeoutError, RemoteLookupError, TransformLookupError
from tfbus.geometry.stamped import TransformStamped
from tfbus.links._remote_lookup import Cancellation, RemoteQuestion, read_answer, write_question
from tfbus.links.link import warn_unless_entered
from tfbus.links.zenoh._closing import use_zenoh
from tfbus.links.zenoh._keys import new_id
from tfbus.links.zenoh._lookup_session import LookupSession
from tfbus.links.zenoh._settings import Addresses
from tfbus.links.zenoh.buffer_server import LONGEST_WAIT
from tfbus.links.zenoh.zenoh_link import ZenohLink
from tfbus.stamps import LATEST, Latest, as_duration, as_stamp
from tfbus.tree.policy import Hold, policy_of

PATIENCE = 3.0
"""s; a client waits for so long for a server that it has not met, and for an answer that is late."""
_MOST_SILENCES = 3
_SETTLING = 0.5
"""s."""


class _Pending:
    """A question that was sent: `done` is set when it has an answer, or will have none."""

    __slots__ = ("answer", "done")

    def __init__(self) -> None:
        self.answer: bytes | None = None
        self.done = anyio.Event()


class BufferClient:
    """Asks the buffer of another process: ``async with BufferClient(robot="r17") as remote``.

    One round trip for each lookup instead of a stream of all that the robot publishes. The other process offers its
    buffer by a `BufferServer`. It is what a BufferClient is in tf2.

    Parameters
    ----------
    domain : str, optional
        As that of a `ZenohLink`; by default ``"tf"``, or that of `link`.
    robot : str, optional
        The robot whose buffer is asked; by default, that of a server without a robot.
    link : ZenohLink, optional
        An entered link whose session is used. By default, the client has a session of its own.
    listen, connect, config, lease
        As those of a `ZenohLink`, for a session of its own.
    capacity : int
        How many lookups may wait for their answers at once.

    Raises
    ------
    ValueError, TypeError
        If an argument is out of range or of another type, or `link` comes with a domain or addresses.
    OSError
        On entering, if it cannot listen where it should, or as a client reaches nobody.
    RuntimeError
        On entering a second time, or while the link is not entered.
    """

    def __init__(
        self,
        domain: str | None = None,
        *,
        robot: str | None = None,
        link: ZenohLink | None = None,
        listen: Addresses | None = None,
        connect: Addresses | None = None,
        config: Mapping[str, Any] | None = None,
        lease: float | None = None,
        capacity: int = 10_000,
    ) -> None:
        check_capacity(capacity)
        self._session = LookupSession(domain, robot, link, listen, connect, config, lease)
        self._capacity = capacity
        self._id = new_id()
        self._entered = False
        self._is_open = False
        self._number = 0
        self._pending: dict[int, _Pending] = {}
        self._arrived: deque[tuple[int, bytes | None]] = deque()
        self._servers_changed: deque[tuple[str, bool]] = deque()
        self._servers: set[str] = set()
        self._changed = anyio.Event()
        self._waker = LoopWaker(self._handle_arrived)
        self._never_entered = warn_unless_entered(self)

    async def __aenter__(self) -> Self:
        if self._entered:
            raise RuntimeError("a buffer client is entered once: make another one")
        self._entered = True
        self._never_entered.detach()
        self._waker.bind()
        await self._session.open()
        self._session.announce_asker(self._id)
        self._session.follow("@lookup", self._note_server)
        self._is_open = True
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._is_open = False
        for pending in self._pending.values():
            pending.done.set()
        await self._session.close()

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
        tolerance: float = 0.0,
        max_gap: float | None = None,
        extrapolate: Hold | None = None,
    ) -> TransformStamped:
        """The transform from `source` to `target` in the other buffer, as soon as it is known there.

        Parameters
        ----------
        target, source, at, max_age, source_at, fixed, tolerance, max_gap, extrapolate
            As those of `tfbus.Buffer.lookup`.
        timeout : float, optional
            In s on the clock of the other bus, and on this machine's; None waits for as long as there is a server.

        Returns
        -------
        TransformStamped

        Raises
        ------
        RemoteLookupError
            If there is no server for 3 s, or within the timeout if that is shorter; if it goes, is too busy, or does
            not answer.
        TransformLookupError, BusClosedError, ClockResetError, TypeError, ValueError
            As `tfbus.Buffer.lookup` there: the same error, with its facts.
        RuntimeError
            If `capacity` lookups wait already, the client is not entered, or this process was forked after it was.
        """
        policy_of(tolerance, max_gap, extrapolate)
        limit = math.inf if timeout is None else as_duration(timeout, "timeout")
        until = monotonic() + limit
        question = RemoteQuestion(
            asker=self._id,
            number=0,
            target=target,
            source=source,
            at=at if isinstance(at, Latest) else as_stamp(at),
            max_age=None if max_age is None else as_duration(max_age, "max_age"),
            source_at=source_at if source_at is None or isinstance(source_at, Latest) else as_stamp(source_at),
            fixed=fixed,
            tolerance=float(tolerance),
            max_gap=None if max_gap is None else float(max_gap),
            hold=None if extrapolate is None else float(extrapolate.max_age),
        )
        if not self._is_open:
            raise RuntimeError("the client is not entered")
        use_zenoh()
        silences = 0
        while True:
            if not self._servers:
                await self._meet(until)
            if not self._is_open:
                raise self._error("lost", "this client has ended")
            left = max(until - monotonic(), 0.0)
            try:
                return await self._ask(question, min(left, LONGEST_WAIT))
            except RemoteLookupError as error:
                # zenoh drops questions and answers while the network is congested.
                silences += 1
                if error.reason != "silent" or silences > _MOST_SILENCES or monotonic() >= until:
                    raise
            except LookupTimeoutError as error:
                missing = error.__cause__
                if monotonic() >= until or left <= LONGEST_WAIT:
                    if not isinstance(missing, TransformLookupError):
                        missing = error
                    raise LookupTimeoutError(target=target, source=source, timeout=limit, missing=missing) from missing

    async def _meet(self, until: float) -> None:
        """Wait until there is a server."""
        with anyio.move_on_after(min(PATIENCE, max(until - monotonic(), 0.0))):
            while not self._servers:
                await self._changed.wait()
        if not self._servers:
            raise self._error("absent", "nobody offers it")

    async def _ask(self, question: RemoteQuestion, timeout: float) -> TransformStamped:
        # Questions that were given up may wait to be sent, too.
        if max(len(self._pending), self._session.unsent) >= self._capacity:
            raise RuntimeError(f"{self._capacity} lookups wait for this client already")
        self._number = number = self._number + 1
        pending = self._pending[number] = _Pending()
        answered = False
        try:
            payload = write_question(question, number, timeout)
            if self._session.is_closed:
                raise self._error("lost", "the session is closed")
            self._session.ask(payload, lambda answer: self._take(number, answer), timeout + 2 * PATIENCE)
            with anyio.move_on_after(timeout + PATIENCE):
                await pending.done.wait()
                answered = True
        finally:
            del self._pending[number]
            if not answered:
                self._cancel(number)
        if not answered:
            raise self._error("silent", f"it has not answered within {timeout + PATIENCE:g} s")
        if pending.answer is None:
            if not self._is_open:
                raise self._error("lost", "this client has ended")
            # The news that the server has gone may come a moment after the end of its questions.
            with anyio.move_on_after(_SETTLING):
                while self._servers:
                    await self._changed.wait()
            if not self._servers:
                raise self._error("lost", "it has gone")
            raise self._error("silent", "it has dropped the question, or it has gone")
        answer = read_answer(pending.answer, self._session.domain, self._session.robot, question)
        if isinstance(answer, Exception):
            raise answer
        return answer

    def _cancel(self, number: int) -> None:
        # Without a session, nobody waits there.
        with suppress(AssertionError):
            if self._session.unsent < self._capacity:
                payload = write_question(Cancellation(self._id, number))
                self._session.ask(payload, lambda _: None, PATIENCE, to_all=True)

    def _error(self, reason: str, detail: str) -> RemoteLookupError:
        return RemoteLookupError(domain=self._session.domain, robot=self._session.robot, reason=reason, detail=detail)

    def _take(self, number: int, answer: bytes | None) -> None:
        self._arrived.append((number, answer))
        self._wake()

    def _note_server(self, server: str, present: bool) -> None:
        self._servers_changed.append((server, present))
        self._wake()

    def _wake(self) -> None:
        # The event loop may have ended without the end of the client, as in a crash.
        with suppress(RuntimeError):
            self._waker.wake()

    def _handle_arrived(self) -> None:
        while self._servers_changed:
            server, present = self._servers_changed.popleft()
            (self._servers.add if present else self._servers.discard)(server)
            # It wakes all that wait now, and none that waits later.
            self._changed.set()
            self._changed = anyio.Event()
        if not self._servers:
            for pending in self._pending.values():
                pending.done.set()
        while self._arrived:
            number, answer = self._arrived.popleft()
            found = self._pending.get(number)
            if found is not None and not found.done.is_set():
                found.answer = answer
                found.done.set()
