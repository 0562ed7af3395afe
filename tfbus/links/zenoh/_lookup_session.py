"""The zenoh session of a buffer server or of a buffer client: that of a link, or one of its own.

Where *robot* is ``~`` without one, the keys are::

    tfbus/domain/robot/lookup            a queryable of each server: questions and cancellations
    tfbus/domain/robot/@lookup/server    a liveliness token of each server
    tfbus/domain/robot/@asking/asker     a liveliness token of each asker
"""

import logging
import threading
import weakref
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from queue import SimpleQueue
from typing import Any

import anyio
import anyio.to_thread
import zenoh

from tfbus.bus.once_logger import OnceLogger
from tfbus.links.zenoh._closing import begin_to_close, close_session, wait_at_exit, wait_until_closed
from tfbus.links.zenoh._keys import NO_ROBOT, check_domain, check_robot
from tfbus.links.zenoh._opening import directly, open_session
from tfbus.links.zenoh._settings import Addresses, settings
from tfbus.links.zenoh.zenoh_link import ZenohLink

_CLOSING_TIME = 1.0

_Sending = SimpleQueue[Callable[[], object] | None]


class Failures:
    """Counts and logs what went wrong in a thread that has to go on: the data of a stranger must not end it.

    Attributes
    ----------
    count : int
    """

    def __init__(self) -> None:
        self.count = 0
        self._lock = threading.Lock()
        self._log = OnceLogger(logging.getLogger("tfbus"))

    def note(self, error: Exception, what: str = "a message of a lookup") -> None:
        """Count an error, and log the first of its type; for any thread."""
        with self._lock:
            self.count += 1
            self._log.warning((what, type(error)), "%s failed with %s", what, type(error).__name__, exc_info=error)


class LookupSession:
    """A session, and the keys of one robot's lookups.

    Questions and answers are sent by a thread of its own: zenoh drops none, and waits for a peer that is frozen or
    overloaded. So that thread also makes the answers that are at hand.

    Parameters
    ----------
    domain : str
    robot : str or None
    link : ZenohLink or None
        The link whose session is used; its domain, then, and no further settings.
    listen, connect, config, lease
        As those of a `ZenohLink`.

    Attributes
    ----------
    domain : str
    robot : str or None
    failures : Failures
        What went wrong in the session's thread, or in one of zenoh.
    """

    def __init__(
        self,
        domain: str | None,
        robot: str | None,
        link: ZenohLink | None,
        listen: Addresses | None,
        connect: Addresses | None,
        config: Mapping[str, Any] | None,
        lease: float | None,
    ) -> None:
        if link is not None and not (domain is listen is connect is config is None):
            raise TypeError("domain, listen, connect and config are those of the link")
        if link is None:
            self.domain = check_domain("tf" if domain is None else domain)
            self._config = settings(listen, connect, config, lease)
        else:
            self.domain = link.domain
        self.robot = robot
        self.failures = Failures()
        self._link = link
        self._base = f"tfbus/{self.domain}/{NO_ROBOT if robot is None else check_robot(robot)}"
        self._session: zenoh.Session | None = None
        self._declared: list[Any] = []
        self._sending: _Sending = SimpleQueue()
        self._sender: threading.Thread | None = None
        self._close_at_exit: weakref.finalize[..., LookupSession] | None = None

    def key(self, *parts: str) -> str:
        """A key of the robot's lookups."""
        return "/".join((self._base, *parts))

    async def open(self) -> None:
        """Open the session.

        Raises
        ------
        OSError
            If it cannot listen where it should, or as a client reaches nobody.
        RuntimeError
            If the link is not entered.
        """
        if self._link is not None:
            self._session = self._link._zenoh_session()
        else:
            self._session = await anyio.to_thread.run_sync(open_session, self._config)
        self._sender = threading.Thread(target=_send_all, args=(self._sending, self.failures), daemon=True)
        self._sender.start()
        # A program may exit without the end of its server.
        own = None if self._link is not None else self._session
        self._close_at_exit = weakref.finalize(self, _end_at_exit, self._sender, self._sending, own)

    def answer(self, receive: Callable[[zenoh.Query], object], server: str) -> None:
        """Have questions received in zenoh's threads, and announce a server."""
        session = self._opened()
        self._declared += [
            session.declare_queryable(self.key("lookup"), directly(receive, self.failures.note), complete=True),
            session.liveliness().declare_token(self.key("@lookup", server)),
        ]

    def announce_asker(self, asker: str) -> None:
        """Announce an asker, whose questions end when it goes."""
        self._declared.append(self._opened().liveliness().declare_token(self.key("@asking", asker)))

    def follow(self, kind: str, note: Callable[[str, bool], object]) -> None:
        """Have `note` called in zenoh's threads with the id of each server or asker that comes (True) or goes."""

        def receive(sample: zenoh.Sample) -> None:
            note(str(sample.key_expr).rpartition("/")[2], sample.kind == zenoh.SampleKind.PUT)

        key = self.key(kind, "*")
        self._declared.append(
            self._opened().liveliness().declare_subscriber(key, directly(receive, self.failures.note), history=True)
        )

    @property
    def is_closed(self) -> bool:
        """Whether the session has ended, as that of a link does with the link."""
        return bool(self._opened().is_closed())

    @property
    def unsent(self) -> int:
        """The number of things that wait for the session's thread, such as questions to be sent."""
        return self._sending.qsize()

    def soon(self, do: Callable[[], object]) -> None:
        """Have something done by the session's thread, in order."""
        self._sending.put(do)

    def ask(self, payload: bytes, take: Callable[[bytes | None], object], timeout: float, to_all: bool = False) -> None:
        """Send a question; `take` is called once in another thread, with the answer or with None."""
        session = self._opened()
        answered = False

        def take_reply(reply: zenoh.Reply) -> None:
            nonlocal answered
            if reply.ok is not None and not answered:
                answered = True
                take(reply.ok.payload.to_bytes())

        def end() -> None:
            if not answered:
                take(None)

        def send() -> None:
            try:
                session.get(
                    self.key("lookup"),
                    directly(take_reply, self.failures.note, end),
                    target=zenoh.QueryTarget.ALL if to_all else zenoh.QueryTarget.BEST_MATCHING,
                    payload=payload,
                    consolidation=zenoh.ConsolidationMode.NONE,
                    timeout=timeout,
                    # The answer is sent as the question was.
                    congestion_control=zenoh.CongestionControl.BLOCK,
                    express=True,
                )
            except zenoh.ZError:
                end()

        self._sending.put(send)

    def reply(self, query: zenoh.Query, answer: bytes) -> None:
        """Send the answer of a question that was received."""
        self._sending.put(partial(reply_now, query, answer))

    async def close(self) -> None:
        """End what was declared, send what waits for that, and end the session if it is not the link's."""
        declared, self._declared = self._declared, []
        session, self._session = self._session, None
        if self._close_at_exit is not None:
            self._close_at_exit.detach()
        if self._sender is not None:
            _end_sending(self._sender, self._sending)
            with anyio.move_on_after(_CLOSING_TIME, shield=True):
                await anyio.to_thread.run_sync(_end, declared, self._sender, abandon_on_cancel=True)
        if self._link is None:
            await wait_until_closed([begin_to_close(session)])

    def _opened(self) -> zenoh.Session:
        assert self._session is not None
        return self._session


def reply_now(query: zenoh.Query, answer: bytes) -> None:
    """Send the answer of a question; for the session's thread."""
    # An asker that has gone needs no answer.
    with suppress(zenoh.ZError):
        query.reply(query.key_expr, answer, express=True)
    query.drop()


def _send_all(sending: _Sending, failures: Failures) -> None:
    while (send := sending.get()) is not None:
        try:
            send()
        except Exception as error:  # noqa: BLE001 - the next one is sent
            failures.note(error)
        # It refers to the session, which is closed when nobody else does.
        del send


def _end_sending(sender: threading.Thread, sending: _Sending) -> None:
    """Have a session's thread end after all that waits."""
    sending.put(None)
    wait_at_exit(sender)


def _end_at_exit(sender: threading.Thread, sending: _Sending, session: zenoh.Session | None) -> None:
    _end_sending(sender, sending)
    close_session(session)
    # The interpreter may have waited before. That thread itself comes here if what it has sent held the last reference.
    if sender is not threading.current_thread():
        sender.join(_CLOSING_TIME)


def _end(declared: list[Any], sender: threading.Thread) -> None:
    for one in declared:
        # The link may have ended before, and its session with it.
        with suppress(zenoh.ZError):
            one.undeclare()
    # A peer that is frozen takes nothing.
    sender.join(_CLOSING_TIME)
