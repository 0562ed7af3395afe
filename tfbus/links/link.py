"""The half that all links share: it joins a bus to a network for as long as its ``async with`` lasts."""

import math
import threading
from collections import OrderedDict
from collections.abc import Iterator
from itertools import count
from time import monotonic
from types import TracebackType
from typing import Any, Final, Literal, Self, Unpack, overload

import anyio
import anyio.abc

from tfbus._aio.loops import LoopWaker
from tfbus._aio.task_groups import close_task_group
from tfbus._aio.turn_budget import TurnBudget
from tfbus.bus.bus import Bus
from tfbus.bus.queues import check_capacity
from tfbus.clock import SimulatedClock
from tfbus.errors import BusClosedError
from tfbus.geometry.stamped import TransformStamped
from tfbus.links.domain import DomainEnd, DomainOptions, check_name
from tfbus.links.endpoint import Endpoint, HearsTime
from tfbus.links.lookups import BufferServer, RemoteLookups
from tfbus.links.message import RemoteQuestion
from tfbus.links.seams import Left, Received, Wire
from tfbus.registration import AsyncOnly, Registration
from tfbus.stamps import LATEST, AtLike, as_at, as_duration, from_seconds, to_seconds
from tfbus.statistics import LinkStatistics, QueueStatistics
from tfbus.tf_message import MalformedMessageError
from tfbus.tree.lookup import Hold, Options, policy_of
from tfbus.uncertainty import UncertainTransform

_FULL_TURN = 5_000
"""With so many samples and removals, the outbox is sent before the turn of the event loop ends."""
MANY = 100
"""While more moving items wait, an answer overtakes the live messages of its own sender too."""
_MAX_BYTES = 64 * 2**20
_OVERHEAD = 256
"""Bytes that an item takes besides its content."""
FAR: Final = 10.0
"""s; a stamp that is further ahead is a jump, because running all timers up to it would take long."""


class _Options(Options, total=False):
    """The other arguments of `DomainLink.lookup`, for type checkers."""

    robot: str | None
    timeout: float | None
    max_age: float | None


class ReceiveQueue:
    """Holds what threads have received until the event loop reads it.

    Items are read in order, but the urgent ones first: they bring two ends to agree, and on a busy machine the other
    items wait for seconds. The messages of a peer are read before its `Left`, and before its answer, which
    would split batches otherwise. Only while more than `MANY` moving items wait, an answer overtakes them.

    Parameters
    ----------
    capacity : int
        How many moving items may be pending, within 64 MiB for all items together; beyond that the oldest moving items
        are dropped, and when there are none, the oldest of the others, the urgent ones last.
    """

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._lock = threading.Lock()
        # The items by their numbers, in the order in which they are read, and the numbers of those that move.
        self._urgent: OrderedDict[int, Received] = OrderedDict()
        self._others: OrderedDict[int, Received] = OrderedDict()
        self._moving: OrderedDict[int, None] = OrderedDict()
        self._numbers = count()
        self._bytes = 0
        self._dropped = 0

    def __len__(self) -> int:
        return len(self._urgent) + len(self._others)

    def put(self, item: Received) -> None:
        """Append an item, from any thread."""
        with self._lock:
            number = next(self._numbers)
            if isinstance(item.content, Left) or (item.follows and len(self._moving) <= MANY):
                # The waiting items of its sender go before it.
                for earlier in [earlier for earlier, one in self._others.items() if one.sender == item.sender]:
                    self._urgent[earlier] = self._others.pop(earlier)
            (self._urgent if item.urgent else self._others)[number] = item
            if item.moving:
                self._moving[number] = None
            self._bytes += _footprint(item)
            while len(self._moving) > self._capacity or self._bytes > _MAX_BYTES:
                self._take(next(iter(self._moving or self._others or self._urgent)))
                self._dropped += 1

    def get(self) -> Received | None:
        """Remove and return the oldest item; None if the queue is empty."""
        with self._lock:
            queue = self._urgent or self._others
            return self._take(next(iter(queue))) if queue else None

    def discard_moving(self) -> None:
        """Drop all moving items, because the clock has jumped back."""
        with self._lock:
            self._dropped += len(self._moving)
            for number in list(self._moving):
                self._take(number)

    def statistics(self) -> QueueStatistics:
        """The queue's counters, in items."""
        with self._lock:
            return QueueStatistics("link", "drop_oldest", self._capacity, len(self), self._dropped)

    def _take(self, number: int) -> Received:
        item = (self._urgent if number in self._urgent else self._others).pop(number)
        self._moving.pop(number, None)
        self._bytes -= _footprint(item)
        return item


def _footprint(item: Received) -> int:
    return item.size + _OVERHEAD


class ClockFollower:
    """Drives a `SimulatedClock` by the stamps that are heard; nothing is polled.

    The clock jumps to the first stamp, to a stamp before the last one, and to a stamp that is more than `FAR` ahead. To
    all other stamps it advances, so that timed tasks run in their order. No other task may advance the clock.

    Parameters
    ----------
    clock : SimulatedClock
    """

    def __init__(self, clock: SimulatedClock) -> None:
        self.clock = clock
        self._newest: int | None = None
        self._heard: anyio.Event | None = None
        self._advancing: anyio.CancelScope | None = None

    def hear(self, stamp: int) -> None:
        """Take the time of the other program, a stamp in ns; a jump is done when this returns."""
        before, self._newest = self._newest, stamp
        if before is None or stamp < before or stamp - before > from_seconds(FAR):
            if self._advancing is not None:
                self._advancing.cancel()
            if stamp != self.clock.now():
                self.clock.set(stamp)
        elif self._heard is not None:
            self._heard.set()

    async def run(self) -> None:
        """Advance the clock to the stamps that are heard, until cancelled.

        Raises
        ------
        RuntimeError
            If another task advances the clock.
        """
        while True:
            ahead = 0 if self._newest is None else self._newest - self.clock.now()
            if ahead > 0:
                with anyio.CancelScope() as self._advancing:
                    await self.clock.advance(to_seconds(ahead))
                self._advancing = None
            else:
                self._heard = anyio.Event()
                await self._heard.wait()


class Link(AsyncOnly):
    """Joins a bus to other buses, or to another world: ``async with link``.

    The samples that are published in one turn of the event loop are sent together at its end. Received messages wait in
    a bounded queue, and the event loop publishes them, 1 ms a turn. A large message takes several turns.

    Parameters
    ----------
    end : Endpoint
        The end of the link on its bus.
    capacity : int
        How many live messages may wait for the event loop; beyond that the oldest are dropped and counted.
    clock : SimulatedClock, optional
        Follows the time that a peer tells: it advances, and jumps where that time jumps. The first peer that tells a
        time is followed until it is lost; the time of others is refused and counted.
    tell_clock : bool
        Whether to tell peers the time of the bus's clock, which is a `SimulatedClock`.
    budget : TurnBudget, optional
        The time for which received items keep the event loop.

    Attributes
    ----------
    bus : Bus
    id : str
        The name of this end for its peers.

    Raises
    ------
    ValueError
        If a number is out of range.
    TypeError
        If a number is of another type.
    OSError
        On entering, if there is no connection.
    BusClosedError, RuntimeError
        On entering, if the bus is closed; if it belongs to another thread, another link of it was entered in another
        event loop, the link was entered before, or this process was forked since a link of the bus was made.

    Examples
    --------
    >>> async with LocalLink(Bus(), "example") as link:
    ...     print(link.statistics().peers)
    0
    """

    def __init__(
        self,
        end: Endpoint,
        *,
        capacity: int = 10_000,
        clock: SimulatedClock | HearsTime | None = None,
        tell_clock: bool = False,
        budget: TurnBudget | None = None,
    ) -> None:
        bus = end.bus
        if tell_clock and not isinstance(bus.clock, SimulatedClock):
            raise TypeError(f"to tell the time, the bus needs a SimulatedClock, not {bus.clock!r}")
        check_capacity(capacity)
        check_capacity(end.max_frames, "max_frames")
        self.bus = bus
        self.id: str = end.id
        self._end = end
        end.host = self
        end.follower = ClockFollower(clock) if isinstance(clock, SimulatedClock) else clock
        self._told_clock = bus.clock if tell_clock and isinstance(bus.clock, SimulatedClock) else None
        self._registrations: list[Registration] = []
        self._stirred: anyio.Event | None = None
        self._receive_queue = ReceiveQueue(capacity)
        # The item that is being handled, and the rest of its parts.
        self._whole: Received | None = None
        self._parts: Iterator[Any] = iter(())
        self._budget = TurnBudget() if budget is None else budget
        self._received = LoopWaker(self._handle_received)
        self._turn_ends = LoopWaker(end.send)
        self._attached = False
        self._tasks: anyio.abc.TaskGroup | None = None
        self._warn_unless_entered()

    @property
    def peers(self) -> tuple[str, ...]:
        """The ids of the other ends that are there, sorted."""
        return self._end.present

    def __repr__(self) -> str:
        count = len(self.peers)
        state = f"{count} peer{'' if count == 1 else 's'}" if self._attached else "not joined"
        return f"<{type(self).__name__} {self._end.name!r}: {state}>"

    def statistics(self) -> LinkStatistics:
        """All counters, as they are now.

        Examples
        --------
        >>> import tempfile
        >>> async with LocalLink(Bus(), directory=tempfile.mkdtemp()) as link:
        ...     print(link.statistics().peers)
        0
        """
        end = self._end
        return LinkStatistics(
            peers=len(end.present),
            sent_messages=end.report.messages,
            sent_samples=end.report.samples,
            received_messages=end.messages,
            received_samples=end.samples,
            lost=end.lost,
            duplicates=end.duplicates,
            not_sent=dict(end.report.not_sent),
            rejected=dict(end.rejected),
            queue=self._receive_queue.statistics(),
            clocks=end.clock_statistics(),
        )

    async def __aenter__(self) -> Self:
        if self._attached:
            self._check_loop()
        self.bus._check_thread()
        if self.bus.closed:
            raise BusClosedError
        for other in self.bus._entered:
            if isinstance(other, Link):
                other._check_loop()
        self._enter_once()
        for waker in (self._received, self._turn_ends):
            waker.bind()
        try:
            await self._end.open()
            self._end.relay.attach(self._end)
        except BaseException:
            await self._end.network.close()
            raise
        self._attached = True
        self.bus._entered.add(self)
        self._registrations.append(self.bus.clock.on_jump(self._clock_jumped))
        self._tasks = await anyio.create_task_group().__aenter__()
        self._tasks.start_soon(self._end.network.run)
        self._tasks.start_soon(self._work)
        if isinstance(self._end.follower, ClockFollower):
            self._tasks.start_soon(self._end.follower.run)
        if self._told_clock is not None:
            self._registrations.append(self._told_clock.on_move(self._end.tell_time))
            self._end.tell_time(self._told_clock.now())
        # Items that came before the link was attached are still in the queue.
        self._received.wake()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        assert self._tasks is not None
        self._check_loop()
        for registration in self._registrations:
            registration.close()
        self._attached = False
        self._end.detach()
        self._end.send()
        self._tasks.cancel_scope.cancel()
        try:
            await close_task_group(self._tasks)
        finally:
            self.bus._entered.discard(self)
            await self._end.network.close()

    def _check_loop(self) -> None:
        self.bus._owner.check_process()
        if not self._received.is_here:
            raise RuntimeError(f"{self!r} was entered in another event loop: make a bus and a link for each event loop")

    # For the end: the event loop

    def receive(self, item: Received) -> None:
        """Have an item handled on the event loop; for any thread. Called by the end and its network."""
        self._receive_queue.put(item)
        try:
            self._received.wake()
        except RuntimeError:
            # The event loop has ended without the end of the link, as in a crash.
            return

    def send_soon(self, pending: int) -> None:
        """Send the gathered entries at the end of this turn of the event loop. Called by the end."""
        if pending >= _FULL_TURN:
            self._end.send()
            return
        try:
            self._turn_ends.wake()
        except RuntimeError as error:
            problem = "the event loop in which it was entered has ended, and not the link"
            raise RuntimeError(f"{self!r} sends nothing any more: {problem}") from error

    def is_behind(self) -> bool:
        """Whether items wait to be handled. Called by the end."""
        return self._whole is not None or len(self._receive_queue) > 0

    def stir(self) -> None:
        """Call `Endpoint.work` soon. Called by the end."""
        if self._stirred is not None:
            self._stirred.set()

    async def _work(self) -> None:
        while True:
            due = self._end.work()
            self._stirred = anyio.Event()
            with anyio.move_on_after(due - monotonic()):
                await self._stirred.wait()

    def _handle_received(self) -> None:
        # After other processes have used the caches, the first item takes many times as long as the next ones. The
        # budget leaves it out: on a crowded machine it alone would spend all of it.
        if not (self._attached and self._handle_part()):
            return
        self._budget.begin()
        while self._attached and self._handle_part():
            if self._budget.spent:
                # Other tasks get their turn first.
                self._received.wake()
                return

    def _handle_part(self) -> bool:
        """Handle the next part of a large message that was begun, or else of the next item; False without any."""
        whole, self._whole = self._whole, None
        if whole is None:
            whole = self._receive_queue.get()
            if whole is None:
                return False
            self._parts = self._end.split(whole)
        try:
            part = next(self._parts)
        except StopIteration:
            return True
        except MalformedMessageError as error:
            self._end.handle(whole.sender, error)
            return True
        # A large batch is decoded over several turns, and then handled at once.
        if part is not None:
            self._end.handle(whole.sender, part)
        # Only now, because a part may tell of a jump of the clock, which drops the rest of earlier messages.
        self._whole = whole
        return True

    def _clock_jumped(self, before: int, after: int) -> None:
        if after < before:
            self._receive_queue.discard_moving()
            if self._whole is not None and self._whole.moving:
                self._whole = None
            self._end.relay.clock_jumped_back()


class DomainLink(Link):
    """Joins a bus to the other buses of a domain; what all links of tfbus have in common.

    Parameters
    ----------
    bus : Bus
    domain : str
        Links hear each other if they have the same one.
    wire : Wire
        The network.
    robot : str, optional
        The robot whose frames this link brings: letters, digits, ``-``, ``_`` and ``.``.
    robots : iterable of str, or mapping of str to float, optional
        Hear only the links of these robots; ``*`` in a name stands for any letters. Other links send nothing to this
        link, and are no peers of it. By default, it hears all links, with and without a robot. A mapping gives a rate
        in Hz for each: a robot with a finite rate sends its static frames and the newest sample of each moving frame,
        at most at this rate and at the `slow_rate` of its links. `math.inf` is for everything, and 0 for nothing but
        answers to lookups.
    slow_rate : float
        How often this link sends the newest sample of each moving frame to links that hear it at a finite rate, in Hz.
    frames : iterable of str, optional
        Send and take only these children; by default all. Peers send this link no others, while the names take less
        than 64 kB and a peer has at most a hundred different filters to serve; beyond that they send all.
    drop_lost : bool
        Whether this bus removes the frames of a bus that it does not reach any more, because that process has ended or
        was cut off. Otherwise they stay until a program removes them, also on buses that join later.
    max_frames : int
        How many frames one bus may have; samples of others are refused and counted.
    capacity : int
        How many live messages may wait for the event loop; then the oldest are dropped and counted.
    history : float, optional
        Ask each peer once, when it is met, for the last so many seconds of its moving frames, as far as buffers on its
        bus hold them: 2,000 samples of each frame at most. They are published before the live samples of the
        peer, so lookups at stamps before the joining can be answered.
    clock : SimulatedClock, optional
        Follows the time that a peer tells: it advances, and jumps where that time jumps. The first peer that tells a
        time is followed until it is lost; the time of others is refused and counted.
    tell_clock : bool
        Whether to tell peers the time of the bus's clock, which is a `SimulatedClock`.
    max_offset : float
        A peer's clock may be so many s ahead of the bus's clock or behind it; beyond that, `ClockOffset` tells of it.
    correct_clocks : bool
        Whether the stamps of other buses are moved to the clock of this one as they arrive, by the measured offset; the
        guide's page on clocks tells when that helps.

    Attributes
    ----------
    bus : Bus
    domain : str
    robot : str or None
    id : str
        The name of this end for its peers.

    Raises
    ------
    ValueError
        If the name of a robot is malformed, or a number is out of range.
    TypeError
        If `frames` or `robots` is one name, or a number is of another type.
    OSError
        On entering, if there is no network.
    BusClosedError, RuntimeError
        On entering, if the bus is closed; if it belongs to another thread, another link of it was entered in another
        event loop, the link was entered before, or this process was forked since a link of the bus was made.

    Notes
    -----
    Nothing here blocks the event loop: while the network is congested, live messages are dropped, which the other end
    counts as `lost`. Static frames, removals and the newest sample of each moving frame are recovered, as the guide's
    page on the protocol of links tells. A program that can reach the link can publish and remove any frame.

    Examples
    --------
    >>> here, there = Bus(), Bus()
    >>> async with LocalLink(here, "examples"), LocalLink(there, "examples"):
    ...     with there.stream() as samples:
    ...         here.publish(TransformStamped("map", "cart", 0, Transform(), static=True))
    ...         print((await anext(aiter(samples)))[0].child)
    cart
    """

    def __init__(
        self,
        bus: Bus,
        domain: str,
        wire: Wire,
        **options: Unpack[DomainOptions],
    ) -> None:
        self.domain: str = check_domain(domain)
        self.robot: str | None = options.get("robot")
        self._domain_end = DomainEnd(bus, domain, wire, **options)
        clock, tell_clock = options.get("clock"), options.get("tell_clock", False)
        super().__init__(self._domain_end, capacity=options.get("capacity", 10_000), clock=clock, tell_clock=tell_clock)

    @property
    def lookups(self) -> RemoteLookups:
        """For a `BufferServer`: the lookups of the link; raises `RuntimeError` unless it is entered in this loop."""
        if not self._attached:
            self.bus._check_thread()
            raise RuntimeError("the link is not entered")
        self._check_loop()
        return self._domain_end.lookups

    def serve(self, server: BufferServer | None) -> None:
        """Say to all peers whether this link serves a buffer. Called by a `BufferServer`."""
        self._domain_end.lookups.server = server
        self._domain_end.sign_soon()

    @overload
    async def lookup(
        self, target: str, source: str, at: AtLike = ..., *, covariance: Literal[True], **options: Unpack[_Options]
    ) -> UncertainTransform: ...

    @overload
    async def lookup(
        self, target: str, source: str, at: AtLike = ..., *, covariance: bool = ..., **options: Unpack[_Options]
    ) -> TransformStamped: ...

    async def lookup(
        self,
        target: str,
        source: str,
        at: AtLike = LATEST,
        *,
        robot: str | None = None,
        timeout: float | None = None,
        max_age: float | None = None,
        source_at: AtLike | None = None,
        fixed: str | None = None,
        tolerance: float = 0.0,
        max_gap: float | None = None,
        extrapolate: Hold | None = None,
        covariance: bool = False,
    ) -> TransformStamped:
        """The transform from `source` to `target` in the buffer of another process, as soon as it is known there.

        Parameters
        ----------
        target, source, at, max_age, source_at, fixed, tolerance, max_gap, extrapolate
            As those of `tfbus.Buffer.lookup`.
        robot : str, optional
            The robot whose buffer is asked; by default, that of a link without a robot. A `BufferServer` offers it.
        timeout : float, optional
            In s on the clock of the other bus, and on this machine's; None waits for as long as there is a server.
        covariance : bool
            As `tfbus.Buffer.lookup`. The edges of the answer come with it, so `tfbus.joint` takes it beside others,
            local ones too. They have to fit one message: it holds more than 50 moving edges.

        Returns
        -------
        TransformStamped

        Raises
        ------
        RemoteLookupError
            If there is no server for 3 s, or within the timeout if that is shorter; if it goes, is too busy, or does
            not answer.
        TransformLookupError, BusClosedError, ClockResetError, TypeError, ValueError
            As `tfbus.Buffer.lookup` there: the same error, with its facts. `ValueError` too for a way whose edges with
            their covariances are more than a message holds.
        RuntimeError
            If 10,000 lookups wait already, or the link is not entered in this event loop.

        Examples
        --------
        >>> import tempfile
        >>> from tfbus.links import BufferServer
        >>> robot, folder = Bus(), tempfile.mkdtemp()
        >>> async with LocalLink(robot, directory=folder) as link, BufferServer(Buffer(robot), link) as server:
        ...     robot.publish(TransformStamped("map", "cart", 0, Transform((2.0, 0.0, 0.0)), static=True))
        ...     async with LocalLink(Bus(), directory=folder) as asker:
        ...         print((await asker.lookup("map", "cart", timeout=5.0)).transform.translation)
        (2.0, 0.0, 0.0)
        """
        policy_of(tolerance, max_gap, extrapolate)
        limit = math.inf if timeout is None else as_duration(timeout, "timeout")
        question = RemoteQuestion(
            target=target,
            source=source,
            at=as_at(at),
            max_age=None if max_age is None else as_duration(max_age, "max_age"),
            source_at=as_at(source_at),
            fixed=fixed,
            tolerance=float(tolerance),
            max_gap=None if max_gap is None else float(max_gap),
            hold=None if extrapolate is None else float(extrapolate.max_age),
            covariance=bool(covariance),
        )
        return await self.lookups.ask(question, robot, limit)


def check_domain(domain: str) -> str:
    """Return the name of a domain; raises `ValueError` if it is malformed."""
    return check_name(
        "a domain", domain, r"[\w.-]+(/[\w.-]+)*", "letters, digits, '-', '_' and '.', with '/' between them"
    )
