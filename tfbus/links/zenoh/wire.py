"""The wire beyond one machine: each link is one client session of a zenoh router, and another one when it breaks.

Keys, where *robot* is ``~`` for a link without one, *link* is 32 hexadecimal digits that each link draws at random, and
*n* counts the sessions of a link from 1::

    tfbus/domain/robot/channel/link     messages of a link; subscribed by links that hear the channel of the robot
    tfbus/domain/@to/link               messages to a link; subscribed by it alone. The attachment is the sender's
                                        id as 16 bytes
    tfbus/domain/robot/@alive/link/n    a liveliness token for each session of a link, declared when it hears all
    tfbus/@router/zid                   a liveliness token of a router of tfbus, by the id of its session

Connecting: a link dials a router, the first of its addresses that answers within `OPENING_TIME`. Links never dial each
other. With ``listen`` a link's own session is a router, and dials the other routers. A client of zenoh also connects
again by itself, but not for the first time, not to a router that tells it nothing, and not to one that has not noticed
the break: it keeps its id, and is refused until the lease of the old connection ends. So a link whose session has no
router begins another one, with the next address.

Present: a link is present while the token of its newest known session is seen. A new session of a present link is told
as `Left` and `Joined`, because messages may have been lost between them. The token of an older session means nothing
any more, whenever it goes. The end of a token may overtake messages, because zenoh sends declarations first: a link has
left when its token has gone and no message of it has come for `LAST_WORDS`. When the own session breaks, all links have
left, and join again by the next one. A router notices by end of file that a process has died, and by silence for a
lease that it is cut off or stopped; a link notices the same of its router, by the lease that the router announces.

Told nothing: connected zenoh routers tell each other once, when a connection begins, what their clients declare:
subscribers and tokens. Two defects of zenoh 1.10 lose that, until the connection breaks again. In both, one router is
told too little, and keeps what it was told before: links that have gone stay present, and others are never heard.

- Two routers that connect to each other have one transport of two connections. If one router takes all for lost, and
  the other one does not yet, a new connection joins the old transport of that one, which sees no reason to tell
  anything.
- A transport that ends and begins anew within the 100 ms in which a router computes its routes only once is no change.
  Nor is a router that comes in that time after another one has gone, because it gets the place of that one.

So each router of tfbus has an id that shows that it is one, and a token. A router that is connected without its token
is one of these cases, because zenoh tells tokens and subscribers by the same way. The cure is a new session with
another id, which is a new router to all others: it is told everything. Its clients connect again, as after any break.

A link is told nothing if it has connected while the session of the router closed: zenoh 1.10 panics then if it is asked
for tokens, keeps the connection, and reads nothing from it. So a link waits for the token of its router too, unless it
is told of other links, and the cure is the same.

Nothing here heals a third defect, of routers in a ring. A token that ends within some ms of the break of a connection
is not taken back at its other end, because the first router finds no connection any more, and those around do not pass
it on yet. So a link that ended at this moment stays present there, until its router is not reached on any way.

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
from time import monotonic
from typing import Any, Final

import anyio
import anyio.to_thread
import zenoh

from tfbus.links.seams import MAX_MESSAGE, Hearing, Joined, Left, Receive, Wire, first_match
from tfbus.links.zenoh.sessions import (
    CLOSING_TIME,
    LONGEST_CLOSE,
    MAX_LINKS,
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

MAX_CHANNELS: Final = 128
FIRST_WAIT: Final = 1.0
"""s; `ZenohWire.open` waits so long for a router."""
SETTLED: Final = 1.0
"""s after which a router has told a new publisher who subscribes to it."""
LAST_WORDS: Final = 0.1
"""s without a message after which a link whose token has gone has left."""
PAUSE: Final = 0.3, 0.7
"""s between two sessions, or attempts to have one; drawn at random, because a router that starts again has many
clients. A router whose next session comes too soon is no change for other routers."""
PATIENCE: Final = 2.0, 5.0
"""s; so long a router may be connected without its token; drawn at random, so that not both begin anew at once."""
PERIOD: Final = 1.0
"""s between two looks at the connected routers."""
UNTIL_KNOWN: Final = 0.01
"""s from an event of zenoh until its session knows of it too, with some to spare."""
NO_ROBOT: Final = "~"

_TOKEN = re.compile(r"(~|[\w.-]{1,200})/@alive/([0-9a-f]{32})/([1-9]\d{0,8})", re.ASCII)
_ROUTERS: Final = "tfbus/@router/"
_MARK: Final = b"tfbus".hex()
"""The ids of routers of tfbus begin so."""
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
        self.sender: bytes = os.urandom(16)
        self.id: str = self.sender.hex()
        self.domain: str = f"tfbus/{domain}"
        self.own: str = f"{self.domain}/{robot or NO_ROBOT}"
        self.is_router: bool = listen is not None
        own, routers = endpoints(listen or ()), endpoints(connect or ())
        if not (own if self.is_router else routers):
            raise ValueError(
                "a link over zenoh needs a router: connect='tcp/host:7447' is one, and listen='tcp/0.0.0.0:7447' makes "
                "this process one; the processes of one machine need none, and meet by the local link"
            )
        self._config = session_config(own or None, routers, config, lease)
        # Of a client, which dials one of them; the first one is tried, or has answered.
        self.addresses: deque[str] = deque(() if self.is_router else routers)
        self._session: _Session | None = None
        self._sessions = 0
        self._refused: OSError | None = None
        self._tried = threading.Event()
        # Set when the thread has something to do.
        self.changed: threading.Event = threading.Event()
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._keep, name=THREAD, daemon=True)

    async def open(self, hears: Sequence[Hearing], receive: Receive, warn: Callable[[Exception], object]) -> None:
        """See `tfbus.links.seams.Wire`. It waits a second for a router, and warns later if there is none.

        Raises
        ------
        OSError
            If it is to listen, and cannot.
        RuntimeError
            If this process was forked from one that uses zenoh.
        """
        self.hears, self.receive, self.warn = tuple(hears), receive, warn
        use_zenoh()
        # A program that exits without the end of its links has them closed all the same.
        atexit.register(self._stop)
        self._thread.start()
        # With a limit of time, for a worker of asyncio keeps the interpreter.
        longest = LONGEST_CLOSE if self.is_router else FIRST_WAIT
        # The program may have all its worker threads busy.
        own = anyio.CapacityLimiter(1)
        await anyio.to_thread.run_sync(self._tried.wait, longest, abandon_on_cancel=True, limiter=own)
        # The thread warns of all later failures.
        self._tried.set()
        if self._refused is not None:
            raise self._refused

    async def run(self) -> None:
        """See `tfbus.links.seams.Wire`. A thread of the wire does what takes time, because zenoh's calls block."""
        await anyio.sleep_forever()

    def is_heard(self, channel: str) -> bool:
        """See `tfbus.links.seams.Wire`. It is true for a new channel, until the router has said who hears it."""
        session = self._session
        return session is not None and session.is_heard(channel)

    def publish(self, channel: str, message: bytes) -> None:
        """See `tfbus.links.seams.Wire`."""
        if (session := self._session) is not None:
            session.publish(channel, message)

    def send(self, link: str, message: bytes) -> bool:
        """See `tfbus.links.seams.Wire`. It is false while no router is connected, and goes in the order of all."""
        session = self._session
        return session is not None and session.send(link, message)

    async def close(self) -> None:
        """See `tfbus.links.seams.Wire`. It warns if zenoh goes on closing in the background."""
        self._stop()
        atexit.unregister(self._stop)
        if self._thread.ident is not None:
            await wait_until_closed([self._thread], self.warn)

    # The thread that opens and closes sessions, because zenoh's calls block

    def _keep(self) -> None:
        """Have one session after another, until the wire is closed or cannot listen."""
        patience = LONGEST_CLOSE if self.is_router else FIRST_WAIT
        warns_at, failures = monotonic() + patience, 0
        while not self._stopped.is_set():
            try:
                session = self._connect()
            except OSError as failure:
                if self.is_router and not self._tried.is_set():
                    self._refused = failure
                    break
                failures += 1
                is_late = monotonic() > warns_at and failures >= len(self.addresses)
                if is_late and not self._stopped.is_set():
                    warns_at = math.inf
                    self.warn(self._lasting(failure))
            else:
                self._tried.set()
                self._use(session)
                self._finish(session)
                warns_at, failures = monotonic() + patience, 0
            self.addresses.rotate(-1)
            self._stopped.wait(uniform(*PAUSE) / max(1, len(self.addresses)))
        self._tried.set()

    def _use(self, session: "_Session") -> None:
        """Look after a session until it breaks, or the wire is closed."""
        try:
            while not self._stopped.is_set() and (pause := session.look(monotonic())) is not None:
                if self.changed.wait(pause):
                    # zenoh tells of an event before the session knows of it.
                    self._stopped.wait(UNTIL_KNOWN)
                self.changed.clear()
        except BaseException as error:  # noqa: BLE001 - it may panic
            self.warn(os_error(error, "the link connects again, because its session broke"))

    def _finish(self, session: "_Session") -> None:
        """Close a session, and wait for that; a second at most, unless the wire is closed."""
        self._session = None
        if self._stopped.is_set():
            close_session(session.close)
        else:
            # zenoh may never close a session in which it has panicked, or whose router has.
            session.end().join(CLOSING_TIME)

    def _lasting(self, failure: OSError) -> OSError:
        if self.is_router:
            # zenoh may never end a session in which it has panicked.
            return OSError(f"this router has no session, and goes on trying; a new process would have one: {failure}")
        where = ", ".join(sorted(self.addresses))
        # zenoh's usual error names the addresses once more, and no reason.
        why = "" if "Unable to connect to any of" in str(failure) else f": {failure}"
        return OSError(f"no router answers at {where}, and the link goes on trying{why}")

    def _connect(self) -> "_Session":
        self._sessions += 1
        own = {"id": _MARK + os.urandom(11).hex()} if self.is_router else {"connect/endpoints": [self.addresses[0]]}
        # The link may send something to another one as soon as that has joined.
        self._session = session = _Session(self, open_session(self._config, own))
        try:
            session.begin(self._sessions)
        except BaseException as error:  # It may panic.
            self._finish(session)
            raise os_error(error, "the new session broke at once") from error
        return session

    def _stop(self) -> None:
        self._stopped.set()
        self.changed.set()


class _Session:
    """One session of a wire, with its declarations and publishers, and the links that are present in it.

    zenoh's threads call all that takes something, until the session is closed.
    """

    def __init__(self, wire: ZenohWire, session: zenoh.Session) -> None:
        self._wire = wire
        self._session = session
        self._publishers: dict[str, tuple[zenoh.Publisher, float]] = {}
        self._tokens: list[zenoh.LivelinessToken] = []
        self._lock = threading.Lock()
        self._ended = False
        # The number of the newest session of each link that is present, and which of the wire's `hears` is for it.
        self._present: dict[str, tuple[int, Hearing]] = {}
        # When each link that is present without a token has left.
        self._leaving: dict[str, float] = {}
        # The routers of tfbus that have a token, and since when each connected one has none.
        self._announced: set[str] = set()
        self._silent: dict[str, float] = {}
        self._patience = uniform(*PATIENCE)

    # For the wire

    def begin(self, number: int) -> None:
        """Hear others, and then be present; raises `zenoh.ZError`."""
        session, wire = self._session, self._wire
        if not wire.is_router and not session.info.routers_zid():
            raise zenoh.ZError("what has answered is no router")
        session.info.declare_transport_events_listener(_directly(lambda _: wire.changed.set()))
        self._watch(f"{_ROUTERS}*", self._take_router)
        if wire.is_router:
            self._announce(f"{_ROUTERS}{session.info.zid()}")
        self._hear(f"{wire.domain}/@to/{wire.id}", self._take_sent)
        for hearing in wire.hears:
            links = f"{wire.domain}/{robots_expression(hearing.robots)}"
            self._hear(f"{links}/{hearing.channel}/*", partial(self._take_published, hearing))
            self._watch(f"{links}/@alive/*/*", partial(self._take_token, hearing))
        self._announce(f"{wire.own}/@alive/{wire.id}/{number}")

    def look(self, now: float) -> float | None:
        """Tell of the links that have left by now; the s until the next look, or None to have another session."""
        routers = {str(zid) for zid in self._session.info.routers_zid()}
        is_broken = not self._wire.is_router and not routers
        if is_broken or self._is_told_nothing(routers, now):
            return None
        with self._lock:
            for link in [link for link, due in self._leaving.items() if due <= now]:
                self._leave(link)
            return min([PERIOD, *(due - now for due in self._leaving.values())])

    def end(self) -> threading.Thread:
        """Have all links leave, take nothing any more, and close the session in the thread that is returned."""
        with self._lock:
            self._ended = True
            for link in list(self._present):
                self._leave(link)
        return begin_to_close(self.close)

    def close(self) -> None:
        """Close the session; blocks."""
        # zenoh keeps a kB for ever of each publisher that is freed later than its session is closed.
        self._publishers = {}
        self._session.close()

    # Declaring

    def _hear(self, key: str, take: Callable[[zenoh.Sample], None]) -> None:
        self._session.declare_subscriber(key, _directly(take), allowed_origin=_REMOTE)

    def _watch(self, key: str, take: Callable[[zenoh.Sample], None]) -> None:
        self._session.liveliness().declare_subscriber(key, _directly(take), history=True)

    def _announce(self, key: str) -> None:
        self._tokens.append(self._session.liveliness().declare_token(key))

    # Routers

    def _take_router(self, sample: zenoh.Sample) -> None:
        router = str(sample.key_expr).removeprefix(_ROUTERS)
        with self._lock:
            if sample.kind == zenoh.SampleKind.DELETE:
                self._announced.discard(router)
            elif router.startswith(_MARK) and len(self._announced) < MAX_LINKS:
                self._announced.add(router)

    def _is_told_nothing(self, routers: Iterable[str], now: float) -> bool:
        """Whether one of the connected routers is of tfbus, and has had no token for too long."""
        with self._lock:
            silent = {router for router in routers if router.startswith(_MARK)} - self._announced
        self._silent = {router: self._silent.get(router, now) for router in silent}
        if not any(now - since >= self._patience for since in self._silent.values()):
            return False
        if self._wire.is_router:
            return True
        # A client that is told of other links is told all, and only waits for a token on a busy machine.
        if self._present:
            return False
        where = self._wire.addresses[0]
        why = "its session may be closing, or its access rules stop tokens on tfbus/@router/*"
        self._wire.warn(OSError(f"the router at {where} tells nothing, and the link connects again: {why}"))
        return True

    # Sending

    def _publisher(self, channel: str) -> tuple[zenoh.Publisher, float]:
        """The publisher for a channel, and since when it is there; raises `zenoh.ZError` if it is new."""
        # The thread of the wire may forget all of them meanwhile.
        publishers = self._publishers
        if channel not in publishers:
            if len(publishers) >= MAX_CHANNELS:
                del publishers[next(iter(publishers))]
            key = f"{self._wire.own}/{channel}/{self._wire.id}"
            publisher = self._session.declare_publisher(key, congestion_control=_DROP, allowed_destination=_REMOTE)
            publishers[channel] = publisher, monotonic()
        return publishers[channel]

    def is_heard(self, channel: str) -> bool:
        # The session may just have ended.
        with suppress(zenoh.ZError):
            publisher, since = self._publisher(channel)
            return bool(publisher.matching_status.matching) or monotonic() < since + SETTLED  # type: ignore[attr-defined]
        return False

    def publish(self, channel: str, message: bytes) -> None:
        with suppress(zenoh.ZError):
            self._publisher(channel)[0].put(message)

    def send(self, link: str, message: bytes) -> bool:
        key, sender = f"{self._wire.domain}/@to/{link}", self._wire.sender
        with suppress(zenoh.ZError):
            self._session.put(key, message, attachment=sender, congestion_control=_DROP, allowed_destination=_REMOTE)
            return True
        return False

    # Receiving

    def _take_published(self, hearing: Hearing, sample: zenoh.Sample) -> None:
        link = str(sample.key_expr).rpartition("/")[2]
        with self._lock:
            known = self._present.get(link)
            if known is not None and known[1] is hearing:
                if link in self._leaving:
                    self._leaving[link] = monotonic() + LAST_WORDS
                self._wire.receive(link, _content(sample))

    def _take_sent(self, sample: zenoh.Sample) -> None:
        sender = sample.attachment
        if sender is None or len(sender) != len(self._wire.sender):
            return
        with self._lock:
            if not self._ended:
                self._wire.receive(sender.to_bytes().hex(), _content(sample))

    def _take_token(self, hearing: Hearing, sample: zenoh.Sample) -> None:
        wire, key = self._wire, str(sample.key_expr)[len(self._wire.domain) + 1 :]
        found = _TOKEN.fullmatch(key)
        if found is None:
            if sample.kind == zenoh.SampleKind.PUT:
                wire.receive("", MalformedMessageError("token", f"no link has the token {key[:100]}"))
            return
        robot, link, number = found[1].replace(NO_ROBOT, ""), found[2], int(found[3])
        if link == wire.id or first_match(wire.hears, robot) is not hearing:
            return
        with self._lock:
            newest = self._present[link][0] if link in self._present else 0
            if sample.kind == zenoh.SampleKind.DELETE:
                if number == newest:
                    self._leaving[link] = monotonic() + LAST_WORDS
                    wire.changed.set()
            elif number > newest or (number == newest and link in self._leaving):
                self._leave(link)
                if len(self._present) < MAX_LINKS and not self._ended:
                    self._present[link] = number, hearing
                    wire.receive(link, Joined(robot))

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
    if robots and not robots.strip("*"):
        return "*"
    return re.sub(r"\*+", "$*", robots) or NO_ROBOT
