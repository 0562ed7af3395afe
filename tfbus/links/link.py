"""The half that all links share: it joins a bus to a carrier for as long as its ``async with`` lasts."""

import logging
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from time import monotonic
from types import TracebackType
from typing import Any, Self
from weakref import finalize

import anyio
import anyio.abc

from tfbus._aio.loops import LoopWaker
from tfbus._aio.task_groups import close_task_group
from tfbus._aio.turn_budget import TurnBudget
from tfbus.bus.bus import Bus
from tfbus.bus.queues import check_capacity
from tfbus.bus.subscribers import OnceLogger
from tfbus.clock import SimulatedClock
from tfbus.errors import BusClosedError
from tfbus.links._carrier import Carrier, SendReport, SplittingCarrier
from tfbus.links._clock_follower import ClockFollower, HearsTime
from tfbus.links._endpoint import Endpoint
from tfbus.links._history import LONGEST_HISTORY
from tfbus.links._receive_queue import Received, ReceiveQueue
from tfbus.registration import Registration
from tfbus.stamps import as_duration
from tfbus.statistics import LinkStatistics
from tfbus.tf_message import MalformedMessageError

_FULL_TURN = 5_000
"""So many samples and removals are sent at once, before the turn of the event loop ends."""


def warn_unless_entered(thing: object) -> "finalize[..., Any]":
    """Have a line logged when something ends that nobody has entered; to enter it is to `detach` this."""
    return finalize(thing, _warn_never_entered, type(thing).__name__, os.getpid())


def _warn_never_entered(name: str, process: int) -> None:
    # A child made by `fork` has copies of what its parent is about to enter.
    if os.getpid() == process:
        logging.getLogger("tfbus").warning(
            "a %s was made and never entered, so it has done nothing: write `async with %s(...)`", name, name
        )


class Link:
    """Joins a bus to other buses, or to another world: ``async with link``.

    What is published in one turn of the event loop goes out together at its end. What comes in waits in a bounded queue
    and is published on the event loop, 1 ms a turn. A carrier may split a large message, so that it takes several.

    Parameters
    ----------
    bus : Bus
    name : str
        How events and log lines call the link.
    carrier : Carrier
        Connects to the network, and writes and reads its messages.
    frames : iterable of str, optional
        Send and take only these children; by default all.
    drop_lost : bool
        Whether the frames of a peer leave the bus when it is lost, those that it was the last to publish.
    max_frames : int
        How many frames one peer may have; samples of others are refused and counted.
    capacity : int
        How many live messages may wait for the event loop; beyond that the oldest are dropped and counted.
    history : float, optional
        Ask each new peer once for the last so many seconds of its moving frames, if the carrier can.
    clock : SimulatedClock, optional
        Follows the time that a peer tells: it advances, and jumps where that time jumps. The first peer that tells a
        time is followed until it is lost; the time of others is refused and counted.
    tell_clock : bool
        Whether to tell peers the time of the bus's clock, which is a `SimulatedClock`.
    now : callable, optional
        The monotonic clock, in s, by which a turn ends.

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
        If `frames` is one name, or a number is of another type.
    OSError
        On entering, if the carrier cannot connect.
    BusClosedError, RuntimeError
        On entering, if the bus is closed; if it belongs to another thread, or the link was entered before.
    """

    def __init__(
        self,
        bus: Bus,
        name: str,
        carrier: Carrier,
        *,
        frames: Iterable[str] | None = None,
        drop_lost: bool = False,
        max_frames: int = 10_000,
        capacity: int = 10_000,
        history: float | None = None,
        clock: SimulatedClock | HearsTime | None = None,
        tell_clock: bool = False,
        now: Callable[[], float] = monotonic,
    ) -> None:
        if tell_clock and not isinstance(bus.clock, SimulatedClock):
            raise TypeError(f"to tell the time, the bus needs a SimulatedClock, not {bus.clock!r}")
        if isinstance(frames, str):
            raise TypeError(f"frames must be several names, not {frames!r}")
        check_capacity(capacity)
        check_capacity(max_frames, "max_frames")
        if history is not None and not 0 < as_duration(history, "history") <= LONGEST_HISTORY:
            raise ValueError(f"history must be a time that passes, {LONGEST_HISTORY:g} s at most, got {history}")
        self.bus = bus
        self.id = carrier.id
        self._name = name
        self._carrier = carrier
        self._log = OnceLogger(logging.getLogger("tfbus"))
        follower = ClockFollower(clock) if isinstance(clock, SimulatedClock) else clock
        self._follower = follower if isinstance(follower, ClockFollower) else None
        self._endpoint = Endpoint(
            bus,
            name,
            carrier,
            self._schedule_send,
            frames=None if frames is None else frozenset(frames),
            drop_lost=drop_lost,
            max_frames=max_frames,
            wake=self._stir,
            history=history,
            follower=follower,
        )
        self._told_clock = bus.clock if tell_clock and isinstance(bus.clock, SimulatedClock) else None
        self._moves: Registration | None = None
        self._stirred: anyio.Event | None = None
        self._send_report = SendReport(self._warn_not_sent)
        self._receive_queue = ReceiveQueue(capacity)
        self._split = carrier.split if isinstance(carrier, SplittingCarrier) else None
        # The rest of a large message, and the item that has brought it.
        self._parts: Iterator[Any] = iter(())
        self._whole: Received | None = None
        self._budget = TurnBudget(now=now)
        self._received = LoopWaker(self._handle_received)
        self._turn_ends = LoopWaker(self._endpoint.send)
        self._entered = False
        self._attached = False
        self._tasks: anyio.abc.TaskGroup | None = None
        self._jumps: Registration | None = None
        self._never_entered = warn_unless_entered(self)

    @property
    def peers(self) -> tuple[str, ...]:
        """The ids of the other ends that are there, sorted."""
        return self._endpoint.peers.present

    def __repr__(self) -> str:
        count = len(self.peers)
        state = f"{count} peer{'' if count == 1 else 's'}" if self._attached else "not joined"
        return f"<{type(self).__name__} {self._name!r}: {state}>"

    def statistics(self) -> LinkStatistics:
        """All counters, as they are now."""
        endpoint, report = self._endpoint, self._send_report
        return LinkStatistics(
            peers=len(endpoint.peers.present),
            sent_messages=report.messages,
            sent_samples=report.samples,
            received_messages=endpoint.inbox.messages,
            received_samples=endpoint.inbox.samples,
            lost=endpoint.inbox.lost,
            duplicates=endpoint.inbox.duplicates,
            not_sent=dict(report.not_sent),
            rejected=dict(endpoint.peers.rejected),
            queue=self._receive_queue.statistics(),
        )

    async def __aenter__(self) -> Self:
        if self._entered:
            raise RuntimeError("a link is entered once: make another one")
        self.bus._check_thread()
        if self.bus.closed:
            raise BusClosedError
        self._entered = True
        self._never_entered.detach()
        for waker in (self._received, self._turn_ends):
            waker.bind()
        try:
            await self._carrier.open(self._receive, self._send_report)
            self._endpoint.attach()
        except BaseException:
            await self._carrier.close()
            raise
        self._attached = True
        self.bus._entered.add(self)
        self._jumps = self.bus.clock.on_jump(self._clock_jumped)
        self._tasks = await anyio.create_task_group().__aenter__()
        self._tasks.start_soon(self._carrier.run)
        self._tasks.start_soon(self._keep_agreed)
        if self._follower is not None:
            self._tasks.start_soon(self._follower.run)
        if self._told_clock is not None:
            self._moves = self._told_clock.on_move(self._endpoint.tell_time)
            self._endpoint.tell_time(self._told_clock.now())
        # Items that came before the link was attached are still in the queue.
        self._received.wake()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        assert self._tasks is not None
        assert self._jumps is not None
        self._jumps.close()
        if self._moves is not None:
            self._moves.close()
        self._attached = False
        self._endpoint.detach()
        self._endpoint.send()
        self._tasks.cancel_scope.cancel()
        try:
            await close_task_group(self._tasks)
        finally:
            self.bus._entered.discard(self)
            await self._carrier.close()

    async def _keep_agreed(self) -> None:
        """Ask peers for what was missed, and claim the own state now and then."""
        while True:
            due = self._endpoint.reconcile()
            self._stirred = anyio.Event()
            with anyio.move_on_after(due - monotonic()):
                await self._stirred.wait()

    def _stir(self) -> None:
        if self._stirred is not None:
            self._stirred.set()

    def _schedule_send(self) -> None:
        if self._endpoint.outbox.pending >= _FULL_TURN:
            self._endpoint.send()
        else:
            self._turn_ends.wake()

    def _warn_not_sent(self, error: Exception) -> None:
        self._log.warning(str(error), "not sent over the link %s: %s", self._name, error)

    def _receive(self, item: Received) -> None:
        self._receive_queue.put(item)
        try:
            self._received.wake()
        except RuntimeError:
            # The event loop has ended without the end of the link, as in a crash.
            return

    def _handle_received(self) -> None:
        self._budget.begin()
        while self._attached:
            item = self._next_item()
            if item is None:
                return
            # A large batch is decoded over several turns, and then handled at once.
            if item.content is not None:
                self._endpoint.handle(item)
            if self._budget.spent:
                # Other tasks get their turn first.
                self._received.wake()
                return

    def _next_item(self) -> Received | None:
        """The next part of a large message that was begun, or else the next item of the queue."""
        while True:
            if self._whole is not None:
                try:
                    return replace(self._whole, content=next(self._parts))
                except StopIteration:
                    self._whole = None
                except MalformedMessageError as error:
                    whole, self._whole = self._whole, None
                    return replace(whole, content=error)
            item = self._receive_queue.get()
            if item is None or self._split is None:
                return item
            self._parts, self._whole = self._split(item.content), item

    def _clock_jumped(self, before: int, after: int) -> None:
        if after < before:
            self._receive_queue.discard_moving()
            if self._whole is not None and self._whole.moving:
                self._whole = None
            self._endpoint.clock_jumped_back()
