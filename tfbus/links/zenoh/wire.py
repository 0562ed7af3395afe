"""The wire beyond one machine: each link is one client session of a zenoh router, and another one when it breaks.

Keys, where *robot* is ``~`` for a link without one, *link* is 32 hexadecimal digits that each link draws at random, and
*n* counts the sessions of a link from 1::

    tfbus/domain/robot/channel/link     messages of a link; subscribed by links that hear the channel of the robot
    tfbus/domain/@to/link               messages to a link; subscribed by it alone. The attachment is the sender's
                                        id as 16 bytes
    tfbus/domain/robot/@alive/link/n    a liveliness token for each session of a link, declared when it hears all

Connecting: a link dials a router, the first of its addresses that answers within `OPENING_TIME`. Links never dial each
other. With ``listen`` a link's own session is a router; it dials the other routers, and breaks only if one of these
tells it nothing. So does the session of a client whose router tells it nothing (see `tfbus.links.zenoh.neighbours`).

Present: a link is present while the token of its newest known session is seen. A new session of a present link is told
as `Left` and `Joined`, because messages may have been lost between them. The token of an older session means nothing
any more, whenever it goes. The end of a token may overtake messages, because zenoh sends declarations first: a link has
left when its token has gone and no message of it has come for `LAST_WORDS`. When the own session breaks, all links have
left, and join again by the next one. A router notices by end of file that a process has died, and by silence for a
lease that it is cut off or stopped; a link notices the same of its router, by the lease that the router announces.

Bounds: a message has at most `MAX_MESSAGE` bytes; `UNSENT` buffers of 64 KiB wait for the router, what finds no room is
dropped, and no call waits for room longer than zenoh's 50 ms, once each time that the network becomes congested;
`MAX_LINKS` others are present at once; `MAX_CHANNELS` channels have a publisher.

Both kinds of messages have one priority, because zenoh keeps the order only within one.

Access control by a router's rules: a link publishes by ``put`` and ``delete`` on ``tfbus/**``, is announced by
``liveliness_token`` on ``tfbus/**/@alive/**``, and sends to one link by ``put`` on ``tfbus/**/@to/*``.
In zenoh ``**`` stands for no part that begins with ``@``. The id of a sender proves nothing.
"""

import atexit
import math
import os
import re
import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from functools import partial
from random import uniform
from time import monotonic, sleep
from typing import Any, Final

import anyio
import zenoh

from tfbus._aio.loops import LoopWaker
from tfbus.links.seams import MAX_MESSAGE, Hearing, Joined, Left, Receive, Wire
from tfbus.links.zenoh.neighbours import PAUSE_TO_BEGIN, PAUSE_TO_LISTEN, PERIOD, Neighbours, new_id
from tfbus.links.zenoh.sessions import (
    CLOSING_TIME,
    LONGEST_CLOSE,
    LONGEST_NAME,
    THREAD,
    Addresses,
    Settings,
    begin_to_close,
    close_session,
    endpoints,
    open_session,
    os_error,
    session_config,
    use_zenoh,
    wait_until_closed,
)
from tfbus.tf_message import MalformedMessageError

MAX_LINKS: Final = 10_000
MAX_CHANNELS: Final = 128
FIRST_WAIT: Final = 1.0
"""s; `ZenohWire.open` waits so long for a router."""
SETTLED: Final = 1.0
"""s after which a router has told a new publisher who subscribes to it."""
LAST_WORDS: Final = 0.1
"""s without a message after which a link whose token has gone has left."""
PAUSE: Final = (0.2, 0.6)
"""s between two attempts to reach any router; drawn at random, because a router that starts again has many clients."""
NO_ROBOT: Final = "~"

_NAME = re.compile(r"[\w.-]+", re.ASCII)
_TOKEN = re.compile(
    rf"(?P<robot>~|[\w.-]{{1,{LONGEST_NAME}}})/@alive/(?P<link>[0-9a-f]{{32}})/(?P<number>[1-9]\d{{0,8}})", re.ASCII
)
_DROP, _REMOTE = zenoh.CongestionControl.DROP, zenoh.Locality.REMOTE


class ZenohWire(Wire):
    """A `tfbus.links.seams.Wire` over zenoh's routers.

    Parameters
    ----------
    domain : str
        Only links of one domain hear each other.
    robot : str
        The name of the robot; empty for a link without one.
    connect : str or iterable of str, optional
        The addresses of routers, such as ``tcp/192.168.1.5:7447``. They are tried in turn until one answers, and again
        when the session with it breaks. With `listen` the router of this process connects to all of them.
    listen : str or iterable of str, optional
        Run a router in this process that listens there.
    config : mapping of str to any, or str or path, optional
        Settings of zenoh by their path: TLS, access control. Or the name of a file of them, as zenoh's own router
        takes it.
    lease : float, optional
        Seconds of silence after which the other end takes this one for lost; by default `sessions.LEASE`.

    Raises
    ------
    ValueError
        If a name or an address is malformed, there is no address, or zenoh does not take a setting.
    TypeError
        If an argument has another type.
    """

    def __init__(
        self,
        domain: str,
        robot: str = "",
        *,
        connect: Addresses | None = None,
        listen: Addresses | None = None,
        config: Settings | None = None,
        lease: float | None = None,
    ) -> None:
        self.id: str = os.urandom(16).hex()
        self.domain: str = f"tfbus/{domain}"
        self.own: str = f"{self.domain}/{robot or NO_ROBOT}"
        self._addresses = deque(endpoints(connect or ()))
        self.is_router: bool = listen is not None
        if listen is None and not self._addresses:
            raise ValueError(
                "a link over zenoh needs a router: connect='tcp/host:7447' is the address of one, and "
                "listen='tcp/0.0.0.0:7447' makes this process one; the processes of one machine need none, and meet by "
                "the local link"
            )
        self._config = session_config(listen, self._addresses, config, lease)
        self._session: _Session | None = None
        self._sessions = 0
        self._failure: OSError | None = None
        # Set when the thread has something to do.
        self.changed: threading.Event = threading.Event()
        self._stopped = False
        self._thread = threading.Thread(target=self._keep, name=THREAD, daemon=True)

    async def open(self, hears: Sequence[Hearing], receive: Receive, warn: Callable[[Exception], object]) -> None:
        """See `tfbus.links.seams.Wire`. It waits a second for a router, and warns later if there is none.

        Raises
        ------
        OSError
            If it is to listen, and cannot.
        ValueError
            If no robot can have a name that the link means to hear.
        RuntimeError
            If this process was forked from one that uses zenoh.
        """
        self.hears, self.receive, self._warn = tuple(hears), receive, warn
        self._tried = anyio.Event()
        self._waker = LoopWaker(self._tell)
        self._waker.bind()
        use_zenoh()
        # A program that exits without the end of its links has them closed all the same.
        atexit.register(self._stop)
        self._thread.start()
        with anyio.move_on_after(math.inf if self.is_router else FIRST_WAIT):
            await self._tried.wait()
        if self.is_router and self._failure is not None:
            raise self._failure

    async def run(self) -> None:
        """See `tfbus.links.seams.Wire`. A thread of the wire does what takes time, because zenoh's calls block."""
        await anyio.sleep_forever()

    def is_heard(self, channel: str) -> bool:
        """See `tfbus.links.seams.Wire`. It is true for a new channel, until the router has said who hears it."""
        session = self._session
        return session is not None and session.is_heard(channel)

    def publish(self, channel: str, message: bytes) -> None:
        """See `tfbus.links.seams.Wire`."""
        session = self._session
        if session is not None:
            session.publish(channel, message)

    def send(self, link: str, message: bytes) -> bool:
        """See `tfbus.links.seams.Wire`. It is false while no router is connected, and goes in the order of all."""
        session = self._session
        return session is not None and session.send(link, message)

    async def close(self) -> None:
        """See `tfbus.links.seams.Wire`. It warns if zenoh goes on closing in the background."""
        self._stop()
        atexit.unregister(self._stop)
        late = await wait_until_closed([] if self._thread.ident is None else [self._thread])
        if late is not None:
            self._warn(late)

    def _tell(self) -> None:
        """Let `open` return, and warn; on the event loop."""
        self._tried.set()
        # The first failure of a router is raised by `open`.
        if not (self.is_router and self._sessions == 1) and not self._stopped and self._failure is not None:
            failure, self._failure = self._failure, None
            self._warn(failure)

    # The thread that opens and closes sessions, because zenoh's calls block

    def _keep(self) -> None:
        """Have one session after another, until the wire is closed."""
        channels: list[str] = []
        while (session := self._connect(channels)) is not None:
            self._wake()
            while not self._stopped and (pause := session.look(monotonic())) is not None:
                self._wait(pause)
            self._session = None
            channels = session.channels
            if self._stopped:
                close_session(session)
                return
            session.end()
            begin_to_close(session)
            if self.is_router:
                sleep(PAUSE_TO_BEGIN)
            elif not session.broken:
                where = self._addresses[0]
                why = "its session may be closing, or its access rules stop tokens on tfbus/@router/*"
                self._failure = OSError(f"the router at {where} tells nothing, and the link connects again: {why}")
                self._wake()
            self._addresses.rotate(-1)

    def _connect(self, channels: Iterable[str]) -> "_Session | None":
        """Try one router after the other until one answers; None if the wire is closed, or cannot listen."""
        warns_at = monotonic() + (LONGEST_CLOSE if self.is_router else FIRST_WAIT)
        while not self._stopped:
            try:
                return self._connect_once(channels)
            except OSError as error:
                failure = error
            self._addresses.rotate(-1)
            if self.is_router and self._sessions == 1:
                self._failure = failure
                self._wake()
                return None
            if monotonic() > warns_at:
                warns_at = math.inf
                self._failure = self._lasting(failure)
                self._wake()
            # The session of a router before this one may not have freed the address yet.
            self._wait(PAUSE_TO_LISTEN if self.is_router else uniform(*PAUSE) / len(self._addresses))
        return None

    def _lasting(self, failure: OSError) -> OSError:
        if self.is_router:
            # zenoh may never end a session in which it has panicked.
            return OSError(f"this router has no session, and goes on trying; a new process would have one: {failure}")
        where = ", ".join(sorted(self._addresses))
        # zenoh's usual error names the addresses once more, and no reason.
        why = "" if "Unable to connect to any of" in str(failure) else f": {failure}"
        return OSError(f"no router answers at {where}, and the link goes on trying{why}")

    def _connect_once(self, channels: Iterable[str]) -> "_Session":
        self._sessions += 1
        own = {"id": new_id()} if self.is_router else {"connect/endpoints": [self._addresses[0]]}
        session = _Session(self, open_session(self._config, own))
        try:
            for channel in channels:
                session.publisher(channel)
            # The link may send something to another one as soon as that has joined.
            self._session = session
            session.begin(self._sessions)
        except zenoh.ZError as error:
            self._session = None
            session.end()
            # zenoh may not end it, if a client asks for tokens at this moment.
            begin_to_close(session).join(CLOSING_TIME)
            raise os_error(error, "the session with a router broke at once") from error
        return session

    def _wait(self, seconds: float) -> None:
        self.changed.wait(seconds)
        self.changed.clear()

    def _stop(self) -> None:
        self._stopped = True
        self.changed.set()

    def _wake(self) -> None:
        # The event loop may have ended.
        with suppress(RuntimeError):
            self._waker.wake()


class _Session:
    """One session of a wire, with its declarations and publishers, and the links that are present in it.

    zenoh's threads call all that takes something. zenoh's objects hold these methods, so `close` lets go of them.
    """

    def __init__(self, wire: ZenohWire, session: zenoh.Session) -> None:
        self._wire = wire
        self._session = session
        self._sender = bytes.fromhex(wire.id)
        self._publishers: dict[str, tuple[zenoh.Publisher, float]] = {}
        # zenoh refuses to undeclare a publisher by which the event loop is publishing.
        self._publishing = threading.Lock()
        self._declared: list[object] = []
        self._neighbours: Neighbours | None = None
        self.broken = False
        self._lock = threading.Lock()
        self._ended = False
        # The number of the newest session of each link that is present, and which of the wire's `hears` is for it.
        self._present: dict[str, tuple[int, int]] = {}
        # When each link that is present without a token has left.
        self._leaving: dict[str, float] = {}

    # For the wire

    def begin(self, number: int) -> None:
        """Hear others, and then be present; raises `zenoh.ZError`."""
        session, wire, declared = self._session, self._wire, self._declared
        if not wire.is_router:
            declared.append(session.info.declare_transport_events_listener(_directly(self._take_event)))
        self._neighbours = Neighbours(session)
        if wire.is_router:
            self._neighbours.announce()
        declared += self._neighbours.declared
        for index, (robots, channel) in enumerate(wire.hears):
            take = _directly(partial(self._take_published, index))
            key = f"{wire.domain}/{robots_expression(robots)}/{channel}/*"
            declared.append(session.declare_subscriber(key, take, allowed_origin=_REMOTE))
        take = _directly(self._take_sent)
        declared.append(session.declare_subscriber(f"{wire.domain}/@to/{wire.id}", take, allowed_origin=_REMOTE))
        liveliness = session.liveliness()
        for index, (robots, _) in enumerate(wire.hears):
            take = _directly(partial(self._take_token, index))
            key = f"{wire.domain}/{robots_expression(robots)}/@alive/*/*"
            declared.append(liveliness.declare_subscriber(key, take, history=True))
        declared.append(liveliness.declare_token(f"{wire.own}/@alive/{wire.id}/{number}"))
        if not wire.is_router and not session.info.transports():
            # It broke before anybody listened.
            self.broken = True

    def look(self, now: float) -> float | None:
        """Tell of the links that have left by now; the s until the next look, or None to have another session."""
        # A client that is told of other links is told all, and only waits for a token on a busy machine.
        is_told = bool(self._present) and not self._wire.is_router
        if self.broken or (self._neighbours is not None and not is_told and self._neighbours.are_silent(now)):
            return None
        with self._lock:
            for link in [link for link, due in self._leaving.items() if due <= now]:
                self._leave(link)
            return min([PERIOD, *(due - now for due in self._leaving.values())])

    def end(self) -> None:
        """Have all links leave, and take nothing any more; in any thread."""
        with self._lock:
            self._ended = True
            for link in list(self._present):
                self._leave(link)

    def close(self) -> None:
        """Close the session; blocks."""
        with self._publishing:
            for publisher, _ in list(self._publishers.values()):
                # Otherwise zenoh keeps 13 kB of each for ever.
                with suppress(zenoh.ZError):
                    publisher.undeclare()
        try:
            self._session.close()
        finally:
            # The garbage collector does not see through zenoh's objects.
            self._declared.clear()
            self._publishers.clear()
            self._neighbours = None

    # Sending

    @property
    def channels(self) -> list[str]:
        return list(self._publishers)

    def publisher(self, channel: str) -> tuple[zenoh.Publisher, float]:
        """The publisher for a channel, and since when it is there; raises `zenoh.ZError` if it is new."""
        if channel not in self._publishers:
            if len(self._publishers) >= MAX_CHANNELS:
                del self._publishers[next(iter(self._publishers))]
            key = f"{self._wire.own}/{channel}/{self._wire.id}"
            publisher = self._session.declare_publisher(key, congestion_control=_DROP, allowed_destination=_REMOTE)
            self._publishers[channel] = publisher, monotonic()
        return self._publishers[channel]

    def is_heard(self, channel: str) -> bool:
        # The session may just have ended.
        with suppress(zenoh.ZError), self._publishing:
            publisher, since = self.publisher(channel)
            return bool(publisher.matching_status.matching) or monotonic() < since + SETTLED  # type: ignore[attr-defined]
        return False

    def publish(self, channel: str, message: bytes) -> None:
        with suppress(zenoh.ZError), self._publishing:
            self.publisher(channel)[0].put(message)

    def send(self, link: str, message: bytes) -> bool:
        key, sender = f"{self._wire.domain}/@to/{link}", self._sender
        with suppress(zenoh.ZError):
            self._session.put(key, message, attachment=sender, congestion_control=_DROP, allowed_destination=_REMOTE)
            return True
        return False

    # Receiving

    def _take_published(self, index: int, sample: zenoh.Sample) -> None:
        link = str(sample.key_expr).rpartition("/")[2]
        with self._lock:
            known = self._present.get(link)
            if known is not None and known[1] == index:
                if link in self._leaving:
                    self._leaving[link] = monotonic() + LAST_WORDS
                self._wire.receive(link, _content(sample))

    def _take_sent(self, sample: zenoh.Sample) -> None:
        sender = b"" if sample.attachment is None or len(sample.attachment) != 16 else sample.attachment.to_bytes()
        with self._lock:
            if sender and not self._ended:
                self._wire.receive(sender.hex(), _content(sample))

    def _take_token(self, index: int, sample: zenoh.Sample) -> None:
        wire, key = self._wire, str(sample.key_expr)[len(self._wire.domain) + 1 :]
        found = _TOKEN.fullmatch(key)
        if found is None:
            if sample.kind == zenoh.SampleKind.PUT:
                wire.receive("", MalformedMessageError("token", f"no link has the token {key[:100]}"))
            return
        link, number = found["link"], int(found["number"])
        robot = found["robot"] if found["robot"] != NO_ROBOT else ""
        if link == wire.id or index != next((k for k, one in enumerate(wire.hears) if one.matches(robot)), None):
            return
        with self._lock:
            known = self._present.get(link)
            if sample.kind == zenoh.SampleKind.DELETE:
                if known is not None and known[0] == number:
                    self._leaving[link] = monotonic() + LAST_WORDS
                    wire.changed.set()
                return
            if known is None:
                is_news = len(self._present) < MAX_LINKS
            else:
                is_news = number > known[0] or (number == known[0] and link in self._leaving)
            if is_news and not self._ended:
                self._leave(link)
                self._present[link] = number, index
                wire.receive(link, Joined(robot))

    def _take_event(self, event: zenoh.TransportEvent) -> None:
        if event.kind == zenoh.SampleKind.DELETE:
            self.broken = True
            self._wire.changed.set()

    def _leave(self, link: str) -> None:
        if self._present.pop(link, None) is not None:
            self._leaving.pop(link, None)
            self._wire.receive(link, Left())


def _directly(callback: Callable[[Any], object]) -> Any:
    """A handler that zenoh's threads call; it suppresses all errors that a stranger's message may cause."""

    def call(thing: Any) -> None:
        with suppress(Exception):
            callback(thing)

    # Otherwise each subscriber has a thread of its own, and one overtakes the other.
    return zenoh.handlers.Callback(call, indirect=False)


def _content(sample: zenoh.Sample) -> bytes | MalformedMessageError:
    size = len(sample.payload)
    if size > MAX_MESSAGE:
        return MalformedMessageError("oversized", f"{size} bytes, and {MAX_MESSAGE} are allowed")
    return sample.payload.to_bytes()


# Names in keys


def robots_expression(robots: str) -> str:
    """The key expression for the robots of a pattern, in which ``*`` stands for any letters."""
    if not robots:
        return NO_ROBOT
    collapsed = re.sub(r"\*+", "*", robots)
    return collapsed if collapsed == "*" else collapsed.replace("*", "$*")
