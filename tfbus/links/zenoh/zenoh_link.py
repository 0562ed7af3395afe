"""A bus over zenoh: what is published here arrives at every other bus of the domain, and the other way round.

The keys of a domain, where *link* is 32 hexadecimal digits that a link makes up when it begins::

    tfbus/domain/live/link            all that is published and removed there, a message for each turn of its event loop
    tfbus/domain/static/link/child    the newest sample of a static frame, kept for those who join late
    tfbus/domain/@alive/link          a liveliness token

A static sample thus comes on two ways, in its batch and by itself; `Relay` takes what comes first.
"""

import logging
import math
import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from copy import copy
from types import TracebackType
from typing import Any
from uuid import uuid4

import anyio
import anyio.abc
import anyio.to_thread

try:
    import zenoh
except ImportError:
    raise ImportError('a link over zenoh needs a package more: pip install "tfbus[zenoh]"') from None

from tfbus._aio.loop_waker import LoopWaker
from tfbus._aio.task_groups import close_task_group
from tfbus._log import OnceLogger, SeenKeys
from tfbus.bus.bus import Bus
from tfbus.bus.sample_queue import check_capacity
from tfbus.errors import BusClosedError
from tfbus.events import PeerJoined, PeerLost, PeerRejected
from tfbus.links.inbox import Inbox
from tfbus.links.outbox import MAX_SAMPLES, Outbox
from tfbus.links.peers import MAX_PEERS, Peers
from tfbus.links.receive_queue import Arrival, Arrivals
from tfbus.links.relay import Relay, join, leave
from tfbus.links.zenoh._session import ZenohSession
from tfbus.links.zenoh._settings import Addresses, settings
from tfbus.registration import Registration
from tfbus.statistics import LinkStatistics
from tfbus.tf_message import MalformedMessageError

_AT_A_TIME = 100
_BYTES_AT_A_TIME = 2**16
_LINGER = 5.0
_CLOSING = 1.0
_LONGEST_DOMAIN = 200


class ZenohLink:
    """Joins a bus to every other bus of a domain: ``async with ZenohLink(bus) as link``.

    Samples keep their stamps and authorities, and batches stay whole. With no address given, links find each other on
    this machine only, in whatever order they start, and nothing is opened to a network.

    Parameters
    ----------
    bus : Bus
    domain : str
        Only links of the same domain hear each other; words of letters, digits, ``-``, ``_`` and ``.``, with ``/``
        between them.
    listen, connect : str or iterable of str, optional
        zenoh's endpoints, such as ``tcp/192.168.1.5:7447``: where to listen, and where other links or a router listen.
        Links find each other through the ones that they are connected to, and then talk directly; so of any two, one
        has to listen where the other can reach it, or be a client, ``config={"mode": "client"}``, for whom the one
        that it is connected to passes everything on. Links without any address meet at ``tcp/127.0.0.1:17447``; one
        that has an address meets them only if it connects there as well.
    config : mapping of str to any, optional
        Settings of zenoh by their path, laid over those of the link: TLS, access control, routers.
    frames : iterable of str, optional
        Send and take only these children; by default all.
    drop_lost : bool
        Whether the frames of a peer leave the bus when it is lost, those that it was the last to publish.
    lease : float
        Others take this link for lost when it is frozen or cut off for so many s, and this one them by theirs; who
        dies is lost at once.
    max_frames : int
        How many frames one peer may have; samples of others are refused and counted.
    capacity : int
        How many live messages may wait for the event loop; then the oldest are dropped and counted.

    Attributes
    ----------
    bus : Bus
    domain : str
    id : str
        Its own name for itself, as others are told of it.

    Raises
    ------
    ValueError
        If `domain` cannot be part of a key, a number is out of range, or zenoh does not take an address or a setting.
    TypeError
        If `frames` is one name, or a number or an address is of another type.
    OSError
        On entering, if it cannot listen where it should, or as a client reaches nobody.
    BusClosedError, RuntimeError
        On entering, if the bus is closed; if it belongs to another thread, or the link was entered before.
    ImportError
        On import, without the extra: ``pip install "tfbus[zenoh]"``.

    Notes
    -----
    Nothing here blocks the event loop: while the network is congested, live messages are dropped, which the other end
    counts as `lost`; static frames are recovered. Who can reach the link can publish and remove any frame. A removal of
    a moving frame that is lost in the network is not repeated.
    """

    def __init__(
        self,
        bus: Bus,
        domain: str = "tf",
        *,
        listen: Addresses | None = None,
        connect: Addresses | None = None,
        config: Mapping[str, Any] | None = None,
        frames: Iterable[str] | None = None,
        drop_lost: bool = False,
        lease: float = 2.0,
        max_frames: int = 10_000,
        capacity: int = 10_000,
    ) -> None:
        if isinstance(frames, str):
            raise TypeError(f"frames must be several names, not {frames!r}")
        check_capacity(capacity)
        check_capacity(max_frames, "max_frames")
        self.bus = bus
        self.domain = _checked(domain)
        self.id = uuid4().hex
        self._config = settings(listen, connect, config, lease)
        self._frames = None if frames is None else frozenset(frames)
        self._drop_lost = drop_lost
        self._max_frames = max_frames
        self._log = OnceLogger(logging.getLogger("tfbus"))
        self._peers = Peers(self._report)
        self._outbox = Outbox(self._frames, self._gathered, self._cannot_send)
        self._arrivals = Arrivals(capacity)
        self._arrived = LoopWaker(self._take_in)
        self._turn_ends = LoopWaker(self._send)
        self._session: ZenohSession | None = None
        self._relay: Relay | None = None
        self._inbox: Inbox | None = None
        self._tasks: anyio.abc.TaskGroup | None = None
        self._jumps: Registration | None = None
        self._statics_changed = anyio.Event()
        self._met = SeenKeys(MAX_PEERS)
        self._hear_again = False
        self._sent_messages = 0
        self._sent_samples = 0

    @property
    def peers(self) -> tuple[str, ...]:
        """The ids of the other ends that are there, sorted."""
        return self._peers.present

    def statistics(self) -> LinkStatistics:
        """All counters, as they are now."""
        inbox = self._inbox
        return LinkStatistics(
            peers=len(self._peers.present),
            sent_messages=self._sent_messages,
            sent_samples=self._sent_samples,
            received_messages=inbox.messages if inbox else 0,
            received_samples=inbox.samples if inbox else 0,
            lost=inbox.lost if inbox else 0,
            duplicates=inbox.duplicates if inbox else 0,
            not_sent=dict(self._outbox.not_sent),
            rejected=dict(self._peers.rejected),
            queue=self._arrivals.statistics(),
        )

    async def __aenter__(self) -> "ZenohLink":
        if self._session is not None:
            raise RuntimeError("a link is entered once: make another one")
        self.bus._check_thread()
        if self.bus.closed:
            raise BusClosedError
        for bell in (self._arrived, self._turn_ends):
            bell.connect()
        self._session = ZenohSession(self._config, f"tfbus/{self.domain}", self.id, self._receive)
        try:
            # The session closes itself if nobody waits for it any more.
            await anyio.to_thread.run_sync(self._session.open, abandon_on_cancel=True)
            self._relay = join(self.bus, self._outbox)
        except BaseException:
            await self._close(self._session)
            raise
        self._inbox = Inbox(self.bus, self._relay, self._outbox, self._frames, self._max_frames, self._peers)
        self._jumps = self.bus.clock.on_jump(self._clock_jumped)
        self._tasks = await anyio.create_task_group().__aenter__()
        self._tasks.start_soon(self._keep_statics, self._session)
        # What came while there was no inbox.
        self._arrived.ring()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        assert self._tasks is not None
        assert self._session is not None
        assert self._relay is not None
        assert self._jumps is not None
        self._jumps.close()
        leave(self.bus, self._outbox)
        self._send()
        self._inbox = None
        for peer in self._peers.forget_all():
            self._relay.lose(peer, self._outbox, drop=False)
        self._tasks.cancel_scope.cancel()
        try:
            await close_task_group(self._tasks)
        finally:
            await self._close(self._session)

    @staticmethod
    async def _close(session: ZenohSession) -> None:
        # Begun at once: asyncio's own cancel knows no shield, and an open session would not let the program end.
        closing = session.close()
        with anyio.move_on_after(_CLOSING, shield=True):
            await anyio.to_thread.run_sync(closing.join, abandon_on_cancel=True)

    def _gathered(self) -> None:
        if self._outbox.pending >= MAX_SAMPLES:
            self._send()
        else:
            self._turn_ends.ring()

    def _send(self) -> None:
        """End a turn: all that was published since the last one goes out."""
        assert self._session is not None
        for message in self._outbox.flush():
            try:
                self._session.put(message)
            except zenoh.ZError as error:
                self._cannot_send(error)
            else:
                self._sent_messages += 1
                self._sent_samples += message.samples
        if self._outbox.statics:
            self._statics_changed.set()

    async def _keep_statics(self, session: ZenohSession) -> None:
        while True:
            self._statics_changed = anyio.Event()
            if self._hear_again:
                self._hear_again = False
                with suppress(zenoh.ZError):
                    await anyio.to_thread.run_sync(session.hear_again)
            if changes := self._outbox.take_statics(_AT_A_TIME):
                for error in await anyio.to_thread.run_sync(session.statics.apply, changes):
                    self._cannot_send(error)
                continue
            with anyio.move_on_after(_LINGER if session.statics.linger else math.inf):
                await self._statics_changed.wait()
                continue
            await anyio.to_thread.run_sync(session.statics.bury)

    def _cannot_send(self, error: Exception) -> None:
        self._log.warning(str(error), "not sent over the link %s: %s", self.domain, error)

    def _receive(self, arrival: Arrival) -> None:
        self._arrivals.put(arrival)
        try:
            self._arrived.ring()
        except RuntimeError:
            # The event loop has ended without the link's end, as in a crash.
            return

    def _take_in(self) -> None:
        if self._inbox is None:
            return
        taken = 0
        while taken < _BYTES_AT_A_TIME:
            arrival = self._arrivals.get()
            if arrival is None:
                return
            taken += arrival.size + _BYTES_AT_A_TIME // _AT_A_TIME
            try:
                self._handle(self._inbox, arrival)
            except Exception as error:  # noqa: BLE001 - no peer, and no subscriber, may end the event loop
                self._peers.reject(arrival.sender, "not published", error)
        # Others have their turn first.
        self._arrived.ring()

    def _handle(self, inbox: Inbox, arrival: Arrival) -> None:
        sender, content = arrival.sender, arrival.content
        if isinstance(content, bool):
            self._note_presence(sender, content)
        elif isinstance(content, MalformedMessageError):
            self._peers.reject(sender, content.reason, content)
        else:
            payload, attachment = content
            inbox.receive(sender, payload, attachment)

    def _note_presence(self, sender: str, present: bool) -> None:
        assert self._relay is not None
        if present:
            stranger = self._peers.make_room(sender)
            if stranger is not None:
                self._relay.lose(stranger, self._outbox, drop=False)
            peer = self._peers.find(sender)
            if peer is not None and not peer.present:
                peer.present = True
                if not self._met.first(sender):
                    # It was lost, and zenoh does not bring again what it has brought before.
                    self._hear_again = True
                    self._statics_changed.set()
                self.bus._announce(PeerJoined(self.bus.clock.now(), self.domain, sender))
            return
        peer = self._peers.forget(sender)
        if peer is not None:
            frames = self._relay.lose(peer, self._outbox, self._drop_lost)
            authorities = tuple(sorted(peer.authorities))
            self.bus._announce(PeerLost(self.bus.clock.now(), self.domain, sender, authorities, frames))

    def _report(self, sender: str, reason: str, error: Exception) -> None:
        self._log.warning(
            (sender, reason), "refused what peer %s sent over the link %s: %s", sender, self.domain, error
        )
        # A copy has no traceback that would keep the message.
        self.bus._announce(PeerRejected(self.bus.clock.now(), self.domain, sender, reason, copy(error)))

    def _clock_jumped(self, before: int, after: int) -> None:
        if after < before:
            self._arrivals.discard_moving()


def _checked(domain: str) -> str:
    if domain.endswith("/static"):
        raise ValueError(f"the domain {domain!r} would hear the static frames of {domain.removesuffix('/static')!r}")
    if len(domain) > _LONGEST_DOMAIN or not re.fullmatch(r"[\w.-]+(/[\w.-]+)*", domain, re.ASCII):
        raise ValueError(
            "a domain is made of letters, digits, '-', '_' and '.', with '/' between them, "
            f"{_LONGEST_DOMAIN} at most, not {domain!r}"
        )
    return domain
