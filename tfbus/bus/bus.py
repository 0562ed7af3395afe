"""The bus: published samples reach every buffer, stream and subscriber.

`Bus.publish` is a plain function that does its work at once: it judges a batch by the newest edges, inserts it into
every buffer, wakes the lookups that waited for it, then calls the subscribers. The bus owns no task and no loop, so
nothing can be lost between "sent" and "buffered".
"""

from __future__ import annotations

import asyncio
import logging
import os
import threading
from collections.abc import Callable, Iterable, Sized
from contextlib import AbstractContextManager, suppress
from itertools import chain
from threading import get_ident
from types import TracebackType
from typing import Any, SupportsIndex
from weakref import WeakSet

import anyio
import numpy.typing as npt

from tfbus._aio.loops import LoopWaker
from tfbus.bus.event_stream import EventStream
from tfbus.bus.late_buffer import LateBuffer
from tfbus.bus.ownership import OnConflict, Ownership
from tfbus.bus.queues import Overflow, SampleQueue, Stream
from tfbus.bus.subscribers import Announcer, BatchCallback, FrameCallback, OnceLogger, Subscribers
from tfbus.bus.topology import Invalid, Plausibility, Topology, as_invalid, as_max_frames
from tfbus.clock import Clock, SimulatedClock, SystemClock
from tfbus.errors import BusClosedError, UnknownFrameError, loop_text
from tfbus.events import ClockReset, Event, PastLoop
from tfbus.geometry.columns import Names, SampleColumns
from tfbus.geometry.stamped import MAX_TRANSLATION, Batch, TransformStamped, as_batch, check_translations
from tfbus.registration import Registration
from tfbus.stamps import StampLike, StampsLike, format_stamp
from tfbus.statistics import BufferStatistics, BusStatistics
from tfbus.tf2_names import says_ours
from tfbus.tree.forest import Forest, LoopingSample
from tfbus.waiting.live_tree import LiveTree, Share
from tfbus.which_kernel import Intake

_PUBLISH_INSTEAD = "publish with `with bus.threadsafe() as publish`"
_WAIT_INSTEAD = (
    "ask here with `lookup_nowait`, or wait on the loop of the bus, by `anyio.from_thread.run` or "
    "`asyncio.run_coroutine_threadsafe`"
)


class OwnerThread:
    """The thread that may use a bus: its maker's thread, until the first event loop that uses the bus takes it over.

    `fork` copies only the thread that calls it. The child has a copy of the bus, but neither the event loop nor the
    threads of the links, recorders and servers on it, so its samples would reach nobody. Such a bus belongs to no
    thread of the child. A bus without links, recorders and servers is a plain object, and the child may use its copy.

    Parameters
    ----------
    intake : Intake or None
        The intake of the bus, which takes batches from this thread only.

    Attributes
    ----------
    thread : int
        Its identity, as `threading.get_ident` gives it; 0 for none.
    entered : WeakSet
        The links, recorders and servers that were entered on the bus. They work in threads or on the loop of this
        process.
    """

    __slots__ = ("__weakref__", "_intake", "_left_behind", "_on_a_loop", "entered", "thread")

    def __init__(self, intake: Any) -> None:
        self._intake = intake
        self._set(get_ident())
        self._on_a_loop = _runs_a_loop()
        self._left_behind = ""
        self.entered: WeakSet[object] = WeakSet()
        _OWNERS.add(self)

    def is_here(self) -> bool:
        """Whether this thread owns the bus, and has run an event loop with it."""
        return get_ident() == self.thread and self._on_a_loop

    def check(self, instead: str = _PUBLISH_INSTEAD) -> None:
        """Raise `RuntimeError` unless this thread owns the bus, or runs an event loop and may take it over.

        `instead` ends the message: what this thread may do.
        """
        if self.is_here():
            return
        self.check_process()
        thread = get_ident()
        on_a_loop = _runs_a_loop()
        if thread != self.thread:
            if self._on_a_loop or not on_a_loop:
                raise RuntimeError(f"the bus belongs to another thread: {instead}")
            self._set(thread)
        self._on_a_loop = on_a_loop

    def check_process(self) -> None:
        """Raise `RuntimeError` in a child of `fork` whose copy of the bus lacks links or threads."""
        if self._left_behind:
            raise RuntimeError(
                f"this process was forked, and fork has not copied what works for the bus, {self._left_behind}: "
                "make a bus in the child, or start the child with the method 'spawn' of multiprocessing"
            )

    def leave_behind(self) -> None:
        """In a child of `fork`: give the bus to no thread if a link or the like was entered on it."""
        if self.entered:
            self._left_behind = " and ".join(sorted({type(thing).__name__ for thing in self.entered}))
            self._set(0)

    def _set(self, thread: int) -> None:
        self.thread: int = thread
        if self._intake is not None:
            self._intake.thread = thread


_OWNERS: WeakSet[OwnerThread] = WeakSet()


def _leave_behind() -> None:
    for owner in tuple(_OWNERS):
        owner.leave_behind()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_leave_behind)


def _runs_a_loop() -> bool:
    """Whether this thread runs an event loop. In a bare asyncio callback only asyncio knows."""
    for probe in (asyncio.get_running_loop, anyio.get_current_task):
        try:
            probe()
        except RuntimeError:
            continue
        return True
    return False


@says_ours
class Bus:
    """Broadcasts stamped transforms inside one process.

    Parameters
    ----------
    clock : Clock, optional
        The source of stamps, and the clock of timeouts and timed tasks; by default a `SystemClock`.
    on_conflict : {"last", "reject"}
        The fate of samples of a child that another authority has published before: the bus accepts and reports them, or
        refuses them until the frame is removed, across jumps of the clock. The empty authority ``""`` counts like any
        other.
    max_translation : float
        The greatest magnitude of a translation, in m, at most 1e100; a longer one is refused as not physical.
    max_ahead : float or None
        How far, in s, the stamp of a moving sample may be ahead of the clock. A sample further ahead is announced as
        `StampAhead`, logged once for each authority and frame, and counted. None, for any distance, suits a bus with
        recorded stamps; a `Player` does not need it. No stamp is ahead of a `SimulatedClock` that nobody has set yet
        (at 0, without a jump).
    max_behind : float or None
        How far, in s, the stamp of a moving sample may be behind the clock. A sample further behind is accepted, but
        announced as `StampBehind`, logged once for each authority and frame, and counted; so is a sample that expires
        in a buffer. None, for any distance, also keeps expired samples from being reported.
    reject_ahead : bool
        Whether a sample that is further ahead is refused. Otherwise it is accepted. Until the clock has reached its
        stamp, correct samples of its frame are older, and expire if they are older than a buffer's window.
    max_frames : int or None
        The greatest number of frames, children and parents of the newest edges, for a bus on which strangers publish. A
        sample that would add a frame beyond this number is refused. A removed frame frees its place, and so does a
        parent without children. None for any number.

    Raises
    ------
    TypeError, ValueError
        If an argument has another type or value, or `reject_ahead` comes without a `max_ahead`.

    Notes
    -----
    You can make a bus before an event loop runs. It belongs to the thread that made it, until the first event loop that
    awaits a lookup, reads a stream or enters `threadsafe` takes it over. Other threads publish through `threadsafe`. A
    child made by ``fork`` may use its copy of a bus only if no link, recorder, view, server or `threadsafe` was entered
    on it, because these work in the parent.

    Examples
    --------
    >>> with Bus(SimulatedClock()) as bus, Buffer(bus) as buffer:
    ...     bus.publish(TransformStamped("map", "base_link", 0, Transform((1.0, 2.0, 0.0))))
    ...     buffer.can_transform("map", "base_link")
    True
    """

    def __init__(
        self,
        clock: Clock | None = None,
        on_conflict: OnConflict = "last",
        *,
        max_translation: float = MAX_TRANSLATION,
        max_ahead: float | None = 1.0,
        max_behind: float | None = 10.0,
        reject_ahead: bool = False,
        max_frames: int | None = None,
    ) -> None:
        self.clock: Clock = SystemClock() if clock is None else clock
        self._closed = False
        self._log = OnceLogger(logging.getLogger("tfbus"))
        self._events: list[EventStream] = []
        self._announcer = Announcer(self.clock.now, self._events)
        self._plausibility = Plausibility(self.clock, max_translation, max_ahead, reject_ahead, max_behind)
        self._topology = Topology(
            self._log,
            Ownership(on_conflict),
            self._plausibility,
            self._announcer,
            self._remove_if_known,
            as_max_frames(max_frames),
        )
        self._subscribers = Subscribers(self._log, self._announcer)
        # The shares of all buffers; and their trees, each with the moment at which another buffer would have the same.
        self._buffers: dict[Share, None] = {}
        self._trees: dict[LiveTree, tuple[int, int] | None] = {}
        self._late: dict[LiveTree, LateBuffer] = {}
        self._streams: list[Stream] = []
        # The listeners beside the buffers, by kind, each with the function that gives them a batch.
        self._listeners: tuple[tuple[Sized, Callable[[Batch], object]], ...] = (
            (self._streams, self._put_into_streams),
            (self._events, self._note_in_events),
            (self._subscribers.callbacks, self._subscribers.deliver),
        )
        self._threads: list[ThreadPublisher] = []
        self._published = 0
        self._intake: Any = None
        self._take: Callable[[object, object], bool | None] = _take_nothing
        if Intake is not None:
            busy = self._subscribers.calling, self._late
            listeners = tuple(chain.from_iterable(self._listeners))
            self._intake = Intake(self._topology.judge, TransformStamped, listeners, busy)
            self._take = self._intake.take
        self._owner = OwnerThread(self._intake)
        # Whether this thread owns the bus, and has run an event loop with it. Called by buffers.
        self._is_here = self._owner.is_here
        self._resets = 0
        self._removals = 0
        # The links of this bus share a relay, and keep it here; the bus itself knows nothing of it.
        self._relay: object = None
        # Links know the clock that stamps a frame; they name it in words.
        self._clock_namers: list[Callable[[str], str]] = []
        # Links, recorders and the like; a child made by `fork` has them no more.
        self._entered = self._owner.entered
        self._jumps = self.clock.on_jump(self._clock_jumped)
        self._moves: Registration | None = None
        if isinstance(self.clock, SimulatedClock):
            self._moves = self.clock.on_move(self._topology.clock_moved)

    @property
    def closed(self) -> bool:
        """Whether `close` was called."""
        return self._closed

    @property
    def max_translation(self) -> float:
        """The greatest magnitude of a translation, in m."""
        return self._plausibility.max_translation

    @property
    def max_frames(self) -> int | None:
        """The greatest number of frames; None for any number."""
        return self._topology.max_frames

    def publish(self, samples: TransformStamped | Iterable[TransformStamped], invalid: Invalid = "raise") -> None:
        """Send one sample, or a batch: readers see all of a batch or nothing.

        When this returns, every buffer has the samples and the lookups that waited for them have been woken.

        Parameters
        ----------
        samples : TransformStamped or iterable of them
        invalid : {"raise", "drop"}
            The fate of a sample that the bus refuses: raise an error and store nothing of the batch; or leave that
            sample out, count it, and log it once for each reason, frame and authority. ``"drop"`` is for programs that
            pass on the samples of others, or must survive contradicting edges of others.

        Raises
        ------
        InvalidTransformError
            If a sample would close a loop of parents, its child is reserved for another authority, or comes from
            another one with ``on_conflict="reject"``; if its translation is not finite or longer than
            `max_translation`; with ``reject_ahead=True``, if its stamp is ahead of the clock. Nothing is stored.
        TooManyFramesError
            If the bus would have more than `max_frames` frames; an `InvalidTransformError`. Nothing is stored.
        TypeError
            If something in it is not a `TransformStamped`.
        BusClosedError
            If the bus is closed.
        RuntimeError
            If this is not the bus's thread, or this process was forked and has the bus without its links; if
            subscribers that publish have queued more than 1,000 batches.

        Examples
        --------
        >>> bus = Bus(SimulatedClock())
        >>> with Buffer(bus) as buffer:
        ...     bus.publish(TransformStamped("map", "cart", 0, Transform((1.0, 2.0, 0.0)), "odometry"))
        ...     print(buffer.can_transform("map", "cart"))
        True
        """
        # The usual case: samples only continue known edges.
        taken = self._take(samples, invalid)
        if taken:
            return
        if get_ident() != self._owner.thread:
            self._check_thread()
        if self._closed:
            raise BusClosedError
        if invalid != "raise" and invalid != "drop":
            as_invalid(invalid)
        if type(samples) is TransformStamped:
            batch: Batch = (samples,)
        elif invalid == "raise":
            batch = as_batch(samples)
        else:
            batch = self._well_typed(samples)
        self._subscribers.check_backlog()
        batch = self._topology.accept(batch, invalid, judged=taken is None)
        if not batch:
            return
        self._published += len(batch)
        error = self._insert(batch)
        self._tell(batch)
        if error is not None:
            raise error

    def publish_columns(
        self,
        parents: Names,
        children: Names,
        stamps: StampLike | StampsLike,
        translations: npt.ArrayLike,
        rotations: npt.ArrayLike,
        authority: str = "",
        *,
        static: bool = False,
        invalid: Invalid = "raise",
    ) -> None:
        """Send the samples in some arrays as one batch, as `publish` does with objects, but ten times as fast.

        Parameters
        ----------
        parents, children : str, or sequence of n str
            One name for all rows, such as one frame's at many stamps, or a name for each row.
        stamps : int, or integer array of shape (n,)
            ns. One stamp for all rows, such as many frames' at once, or a stamp for each row.
        translations : array of shape (n, 3)
            In m; each maps the origin of the child into its parent.
        rotations : array of shape (n, 4)
            Unit quaternions (x, y, z, w). A norm within 1 % of one is normalised; the sign stays as given.
        authority : str
            The sender of all rows.
        static : bool
            Whether the rows hold at every stamp.
        invalid : {"raise", "drop"}
            As `publish`; a row that cannot be a sample is refused like one that the bus refuses.

        Raises
        ------
        InvalidTransformError
            If a row cannot be a sample, which the message then names by its index, or as `publish`. Nothing is stored.
        TypeError, ValueError
            If a column has not one value for all rows or for each, or something in it has another type.
        BusClosedError, RuntimeError
            As `publish`.

        Examples
        --------
        >>> with Bus(SimulatedClock()) as bus, Buffer(bus) as buffer:
        ...     moves = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
        ...     bus.publish_columns("map", ["left", "right"], 100, moves, [[0.0, 0.0, 0.0, 1.0]] * 2, "tracker")
        ...     buffer.lookup_nowait("left", "right", 100).transform.translation
        (1.0, 0.0, 0.0)
        """
        if get_ident() != self._owner.thread or self._closed:
            self._check_usable()
        refuse = self._topology.drop if invalid == "drop" else None
        bound = self._plausibility.max_translation
        columns = SampleColumns(parents, children, stamps, translations, rotations, authority, static, bound)
        if columns.plain is None or not self._take(columns.plain, invalid):
            self.publish(columns.samples(refuse), invalid)

    def _check_thread(self) -> None:
        """Raise `RuntimeError` unless this thread may use the bus. Called by buffers, message filters and links.

        The first event loop to use a bus that another thread has made takes it over.
        """
        self._owner.check()

    def _check_waiter(self) -> None:
        """As `_check_thread`, for a task that is about to wait. Called by lookups and watches."""
        self._owner.check(_WAIT_INSTEAD)

    def subscribe(self, callback: BatchCallback, removed: FrameCallback | None = None) -> Registration:
        """Call `callback` with each batch, a tuple of samples, until the registration is closed.

        `publish` calls it, so it should be quick; batches that it publishes are delivered after the current one. If it
        raises an `Exception`, that is logged once and counted, and no other subscriber is affected. The latched samples
        are delivered at once.

        `removed` is called with each frame that `remove_frame` removes, between the batches before and after it.

        Raises
        ------
        BusClosedError

        Examples
        --------
        >>> bus = Bus(SimulatedClock())
        >>> with bus.subscribe(lambda batch: print([sample.child for sample in batch])):
        ...     bus.publish(TransformStamped("map", "cart", 0, Transform()))
        ['cart']
        """
        self._check_usable()
        return self._subscribers.subscribe(callback, tuple(self._topology.latched.samples.values()), removed)

    def stream(self, capacity: int = 1_000, overflow: Overflow = "conflate") -> Stream:
        """The batches as an async iterator: ``with bus.stream() as batches: async for batch in batches``.

        Parameters
        ----------
        capacity : int
            How many moving samples may wait for the reader; with ``"conflate"``, of how many children.
        overflow : {"conflate", "drop_oldest"}
            Keep the newest sample of each child, or the newest whole batches. Static samples are never dropped.

        Raises
        ------
        BusClosedError

        Examples
        --------
        >>> bus = Bus(SimulatedClock())
        >>> with bus.stream(capacity=100) as batches:
        ...     bus.publish(TransformStamped("map", "cart", 0, Transform()))
        ...     async for batch in batches:
        ...         print(batch[0].child)
        ...         break
        cart
        """
        self._check_usable()
        stream = Stream(capacity, overflow, self._check_thread, self._detach_stream)
        latched = tuple(self._topology.latched.samples.values())
        if latched:
            stream.queue.put(latched)
        self._streams.append(stream)
        return stream

    def events(self, capacity: int = 1_000, stale_after: float | None = 1.0) -> EventStream:
        """Everything that happens besides samples: ``with bus.events() as events: async for event in events``.

        It begins with a `FrameAdded` for each frame that has a parent by now. Each failure of a subscriber is an event.
        A rejected sample is an event once for each frame, authority and reason. A conflict about a frame is an event
        once for each pair of authorities, and then once for each parent and kind that one of them claims. This starts
        anew when the frame is removed or the clock jumps back. The counters count every case.

        Parameters
        ----------
        capacity : int
            How many events may wait for the reader; then the oldest are dropped and counted. The events of the frames
            at the beginning, and of stale and live frames, are never dropped.
        stale_after : float or None
            A moving frame is stale when its newest stamp is more than this many s behind the clock, and live again when
            it is not; None for no such events. The stream checks this while a task reads, without a timer of its own.

        Raises
        ------
        ValueError
            If `capacity` is less than one, or `stale_after` negative.
        BusClosedError

        Examples
        --------
        >>> bus = Bus(SimulatedClock())
        >>> with bus.events() as events:
        ...     bus.publish(TransformStamped("map", "cart", 0, Transform()))
        ...     async for event in events:
        ...         print(event)
        ...         break
        0.000 s: moving frame 'cart' is new under 'map', from ''
        """
        self._check_usable()
        events = EventStream(capacity, stale_after, self._topology, self.clock, self._check_thread, self._detach_events)
        self._events.append(events)
        return events

    def _announce(self, event: Event) -> None:
        """Announce an event from outside of the bus. Called by links and recorders."""
        self._check_thread()
        self._announcer.announce(event)

    def _announce_past_loop(self, found: LoopingSample) -> None:
        """Log and announce a loop of parents at a past stamp. Called by buffers, which alone have the history."""
        sample, (at, loop) = found
        frames = loop_text(loop)
        key = ("past loop", sample.child, sample.parent, sample.authority)
        self._log.warning(
            key, "the frames %s form a loop at %s, with late data of %r", frames, format_stamp(at), sample.authority
        )
        if self._announcer.has_listeners:
            self._announcer.announce(
                PastLoop(self._announcer.now(), sample.child, sample.parent, sample.authority, at, loop)
            )

    def reserve(self, frame: str, authority: str) -> Registration:
        """Let only `authority` publish a frame, for any `on_conflict`, until the registration is closed.

        Earlier samples of another authority stay; later ones are refused with ``reason="reserved"``. One authority may
        reserve a frame several times.

        No edge of another authority can displace the frame. An edge that would put an ancestor of the frame below it is
        refused. If such an edge was there before the frame had its parent, the bus removes its child when `authority`
        publishes, unless the sender of that edge has reserved this child.

        Raises
        ------
        InvalidTransformError
            If another authority has reserved it, or the name cannot be the name of a frame.
        BusClosedError

        Examples
        --------
        >>> bus = Bus(SimulatedClock())
        >>> with bus.reserve("tool", "gripper"):
        ...     bus.publish(TransformStamped("flange", "tool", 0, Transform(), "stranger"), invalid="drop")
        >>> dict(bus.statistics().rejected)
        {'reserved': 1}
        """
        self._check_usable()
        return self._topology.reserve(frame, authority)

    def threadsafe(self, capacity: int = 10_000) -> ThreadPublisher:
        """A function to publish from other threads: ``with bus.threadsafe() as publish``, entered on the event loop.

        ``publish(samples)`` may then be called from any thread. The bus publishes the queued batches with
        ``invalid="drop"``. When more than `capacity` moving samples are queued, the oldest batches are dropped and
        counted. ``TransformBroadcaster(publish, "driver")`` is a broadcaster for any thread.

        Raises
        ------
        BusClosedError

        Examples
        --------
        >>> from threading import Thread
        >>> bus, sample = Bus(SimulatedClock()), TransformStamped("map", "cart", 0, Transform())
        >>> async def drive() -> None:
        ...     with Buffer(bus) as buffer, bus.threadsafe() as publish:
        ...         Thread(target=publish, args=(sample,)).start()
        ...         print((await buffer.lookup("map", "cart", timeout=5.0)).child)
        >>> await drive()
        cart
        """
        self._check_usable()
        return ThreadPublisher(self, capacity)

    def _attach(self, window: int | None, prefill: Forest | LiveTree | None) -> Share:
        """A share of a live tree, which gets the latched samples, and from now on all that are published.

        Called by `Buffer`.

        Parameters
        ----------
        window : int or None
            ns.
        prefill : Forest or LiveTree or None
            A forest with some history; or the tree of another buffer of this bus, to be shared. Without either, the
            tree is shared with buffers that have joined since the last sample or removal.
        """
        self._check_usable()
        samples = self._samples()
        if isinstance(prefill, LiveTree):
            live, before = prefill, prefill.statistics(samples)
        else:
            moment = samples, self._removals + self._resets
            before = BufferStatistics(samples - len(self._topology.latched.samples), 0, 0, 0, 0)
            trees = self._trees.items() if prefill is None else ()
            known = next((live for live, since in trees if since == moment and live.forest.window == window), None)
            live = known or LiveTree(prefill or Forest(window), self._announce_past_loop)
            if known is None:
                self._fill(live, prefilled=prefill is not None)
                self._trees[live] = moment if prefill is None else None
                self._connect_feeds()
        share = Share(live, before)
        self._buffers[share] = None
        return share

    def _fill(self, live: LiveTree, *, prefilled: bool) -> None:
        """Give a new tree the latched samples."""
        late = LateBuffer(live, self._topology)
        live.tell_expired = self._topology.expired
        latched = self._topology.latched
        if not prefilled:
            live.forest.share(latched)
        elif latched.samples:
            late.insert(tuple(latched.samples.values()))
        if not late.has_caught_up:
            self._late[live] = late

    def _detach(self, share: Share) -> bool:
        """Take a buffer off the bus, if it is on it; whether other buffers share its tree. Called by `Buffer`."""
        if share.has_waiters:
            self._check_thread()
        if share not in self._buffers:
            return False
        del self._buffers[share]
        if any(other.live is share.live for other in self._buffers):
            return True
        del self._trees[share.live]
        self._late.pop(share.live, None)
        self._connect_feeds()
        return False

    def remove_frame(self, frame: str) -> None:
        """Remove a frame from every buffer and from pending batches, and do not give it to later subscribers.

        Frames below it stay, as a tree of their own.

        Raises
        ------
        UnknownFrameError
            If neither the bus nor a buffer knows the frame.

        Examples
        --------
        >>> bus = Bus(SimulatedClock())
        >>> with Buffer(bus) as buffer:
        ...     bus.publish(TransformStamped("map", "cart", 0, Transform()))
        ...     bus.remove_frame("cart")
        ...     print("cart" in buffer.tree)
        False
        """
        self._check_usable()
        topology = self._topology
        known = frame in topology or frame in topology.names
        if not known and not any(frame in live.forest.names for live in self._trees):
            raise UnknownFrameError(frame=frame, known=self._topology.names.some())
        self._removals += 1
        self._topology.remove(frame)
        self._subscribers.forget(frame)
        for publisher in self._threads:
            publisher.forget(frame)
        for stream in self._streams:
            stream.queue.forget(frame)
        for live in self._trees:
            live.remove_frame(frame)
        for late in self._late.values():
            late.forget(frame)
        self._subscribers.notify_removed(frame)

    def statistics(self) -> BusStatistics:
        """All counters, as they are now.

        Examples
        --------
        >>> bus = Bus(SimulatedClock())
        >>> bus.publish(TransformStamped("map", "cart", 0, Transform()))
        >>> bus.statistics().samples
        1
        """
        samples = self._samples()
        return BusStatistics(
            samples=samples,
            rejected=dict(self._topology.rejected),
            reparented=self._topology.reparented,
            kind_changes=self._topology.kind_changes,
            authority_conflicts=self._topology.conflicts,
            clock_resets=self._resets,
            callbacks_failed=self._subscribers.failures,
            frames=len(self._topology),
            buffers=tuple(share.statistics(samples) for share in self._buffers),
            queues=(
                *(stream.queue.statistics("stream") for stream in self._streams),
                *(publisher.queue.statistics("threadsafe") for publisher in self._threads),
                *(events.queue.statistics() for events in self._events),
            ),
            ahead=self._topology.ahead,
            behind=self._topology.judge.behind,
        )

    def __repr__(self) -> str:
        state = f"{len(self._buffers)} buffers, {len(self._streams)} streams"
        frames = len(self._topology)
        return f"<Bus of {frames:,} child frame{'' if frames == 1 else 's'}, {'closed' if self._closed else state}>"

    def close(self) -> None:
        """End every stream and every waiting lookup; buffers go on answering what they can.

        A second call does nothing.

        Examples
        --------
        >>> bus = Bus(SimulatedClock())
        >>> bus.close()
        >>> bus
        <Bus of 0 child frames, closed>
        """
        if self._closed:
            return
        readers: list[Stream | EventStream] = [*self._streams, *self._events]
        if any(reader.waiting for reader in readers) or any(share.has_waiters for share in self._buffers):
            self._check_thread()
        self._closed = True
        if self._intake is not None:
            self._intake.open = False
        self._jumps.close()
        if self._moves is not None:
            self._moves.close()
        for publisher in self._threads:
            publisher.end()
            publisher.discard()
        for reader in readers:
            reader.end()
        shares = tuple(self._buffers)
        for share in shares:
            share.end("the bus is closed")
        # These run foreign code, so only after every waiter has been woken.
        for share in shares:
            share.call_end_callbacks()

    def __reduce_ex__(self, protocol: SupportsIndex) -> str | tuple[Any, ...]:
        raise TypeError("a bus belongs to its program and cannot be copied or pickled: use Buffer(bus).tree.copy()")

    def __enter__(self) -> Bus:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _connect_feeds(self) -> None:
        if self._intake is not None:
            self._intake.feeds = tuple((live.feed, live.insert_closely) for live in self._trees)

    def _samples(self) -> int:
        """Number of samples that were published."""
        return self._published + (0 if self._intake is None else int(self._intake.samples))

    def _check_usable(self) -> None:
        self._check_thread()
        if self._closed:
            raise BusClosedError

    def _detach_stream(self, stream: Stream) -> None:
        if stream in self._streams:
            self._streams.remove(stream)

    def _detach_events(self, events: EventStream) -> None:
        if events in self._events:
            self._events.remove(events)

    def _insert(self, batch: Batch) -> BaseException | None:
        """Insert a batch into all trees, even if one of them raises; return the first error, or None."""
        first = None
        for live in self._trees:
            late = self._late.get(live) if self._late else None
            try:
                if late is None:
                    live.insert(batch)
                    continue
                late.insert(batch)
                if late.has_caught_up:
                    # A wake-up that publishes may have removed it already.
                    self._late.pop(live, None)
            except BaseException as error:  # noqa: BLE001 - it is raised after all have the batch
                first = first or error
        return first

    def _tell(self, batch: Batch) -> None:
        """Give an accepted batch to everybody but the buffers."""
        for listeners, give in self._listeners:
            if listeners:
                give(batch)

    def _put_into_streams(self, batch: Batch) -> None:
        for stream in self._streams:
            stream.queue.put(batch)
            stream.wake()

    def _note_in_events(self, batch: Batch) -> None:
        for events in self._events:
            events.arrived(batch)

    def _remove_if_known(self, frame: str) -> None:
        with suppress(UnknownFrameError):
            self.remove_frame(frame)

    def _newest_plausible(self) -> int:
        """The greatest stamp, in ns, that is not ahead of the clock now. Called by buffers."""
        return self._plausibility.newest_plausible()

    def _recorded_time(self) -> AbstractContextManager[None]:
        """A ``with`` for samples whose stamps are of another clock. Called by players."""
        return self._topology.recorded_time()

    def _kept_samples(self) -> AbstractContextManager[None]:
        """A ``with`` for samples that were kept for late joiners, and may be old. Called by links."""
        return self._topology.kept_samples()

    def _well_typed(self, samples: object) -> Batch:
        """The samples in a batch; anything else in it is counted as rejected."""
        things = tuple(samples) if isinstance(samples, Iterable) else (samples,)
        if all(issubclass(kind, TransformStamped) for kind in set(map(type, things))):
            return things
        for thing in things:
            if not isinstance(thing, TransformStamped):
                self._topology.reject("not a sample", TypeError(f"expected a TransformStamped, not {thing!r}"))
        return tuple(thing for thing in things if isinstance(thing, TransformStamped))

    def _clock_jumped(self, before: int, after: int) -> None:
        self._topology.clock_moved(after)
        if after >= before:
            for events in self._events:
                events.wake()
            return
        self._check_thread()
        self._resets += 1
        self._log.warning(("clock", before, after), "the clock jumped back: moving samples are dropped")
        self._topology.clear_moving()
        self._announcer.announce(ClockReset(after, before))
        self._subscribers.discard_moving()
        for publisher in self._threads:
            publisher.discard()
        for stream in self._streams:
            stream.queue.discard_moving()
        for live in self._trees:
            live.reset(before, after)
        for late in self._late.values():
            late.clear_moving()


def _take_nothing(_samples: object, _invalid: object) -> bool:
    """Without the compiled kernel every batch goes the ordinary way."""
    return False


class ThreadPublisher:
    """The result of `Bus.threadsafe`: inside its ``with``, a function that any thread may call.

    Samples are queued here and published on the event loop, with one wake-up of the loop for all that has gathered.
    `TransformBroadcaster` takes it in place of a bus.

    Parameters
    ----------
    bus : Bus
    capacity : int
        How many moving samples may be pending; beyond that the oldest batches are dropped and counted.

    Attributes
    ----------
    bus : Bus

    Examples
    --------
    >>> bus = Bus(SimulatedClock())
    >>> async def drive() -> None:
    ...     with Buffer(bus) as buffer, bus.threadsafe(capacity=100) as publish:
    ...         publish(TransformStamped("map", "cart", 0, Transform()))
    ...         print((await buffer.lookup("map", "cart", timeout=5.0)).child)
    >>> await drive()
    cart
    """

    def __init__(self, bus: Bus, capacity: int) -> None:
        self.queue: SampleQueue = SampleQueue(capacity, "drop_oldest")
        self.bus = bus
        self._lock = threading.Lock()
        self._waker = LoopWaker(self._drain)
        self._ended = False

    def __enter__(self) -> ThreadPublisher:
        self._waker.bind()
        try:
            self.bus._check_usable()
            self.bus._entered.add(self)
            self.bus._threads.append(self)
        except BaseException:
            self.end()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.end()
        self._drain()
        self.bus._entered.discard(self)
        self.bus._threads.remove(self)

    def __call__(self, samples: TransformStamped | Iterable[TransformStamped]) -> None:
        """Hand over one sample or a batch; the order within a thread is kept.

        Raises
        ------
        TypeError
            If something in it is not a `TransformStamped`.
        InvalidTransformError
            If a translation is not finite, or longer than the `max_translation` of the bus.
        BusClosedError
            If the ``with`` has ended, or the bus or the event loop is closed.
        RuntimeError
            If the ``with`` has not begun.

        Notes
        -----
        A sample that only the bus can judge, such as one that closes a loop of parents or is ahead of the clock, is
        dropped and counted there.
        """
        batch = as_batch(samples)
        self.bus._owner.check_process()
        check_translations(batch, self.bus.max_translation)
        if not self._waker.bound:
            raise RuntimeError("enter the `with` of bus.threadsafe() on the event loop first")
        with self._lock:
            if self._ended:
                raise BusClosedError("the bus takes no more samples from this thread: its `with` has ended")
            self.queue.put(batch)
        try:
            self._waker.wake()
        except RuntimeError as error:
            self.end()
            raise BusClosedError("the event loop of the bus has ended") from error

    def publish(self, samples: TransformStamped | Iterable[TransformStamped], invalid: Invalid = "drop") -> None:  # noqa: ARG002
        """Hand samples over as a call does; for `invalid`, as the bus has it, there is no choice here.

        Examples
        --------
        >>> bus = Bus(SimulatedClock())
        >>> with Buffer(bus) as buffer, bus.threadsafe() as publisher:
        ...     publisher.publish(TransformStamped("map", "cart", 0, Transform()))
        ...     print((await buffer.lookup("map", "cart")).stamp)
        0
        """
        self(samples)

    def publish_columns(
        self,
        parents: Names,
        children: Names,
        stamps: StampLike | StampsLike,
        translations: npt.ArrayLike,
        rotations: npt.ArrayLike,
        authority: str = "",
        *,
        static: bool = False,
        invalid: Invalid = "drop",  # noqa: ARG002
    ) -> None:
        """Hand over the samples in some arrays; see `Bus.publish_columns`. A row that is no sample raises its error.

        Examples
        --------
        >>> bus = Bus(SimulatedClock())
        >>> places, turns = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0)], [(0.0, 0.0, 0.0, 1.0)] * 2
        >>> with Buffer(bus) as buffer, bus.threadsafe() as publisher:
        ...     publisher.publish_columns("map", "cart", [0, 10], places, turns)
        ...     print((await buffer.lookup("map", "cart", 5)).transform.translation)
        (0.5, 0.0, 0.0)
        """
        bound = self.bus.max_translation
        columns = SampleColumns(parents, children, stamps, translations, rotations, authority, static, bound)
        self(columns.samples())

    def end(self) -> None:
        """Take no more samples."""
        with self._lock:
            self._ended = True

    def discard(self) -> None:
        """Drop the moving samples that were queued before the clock jumped back."""
        with self._lock:
            self.queue.discard_moving()

    def forget(self, child: str) -> None:
        """Drop the queued samples of a removed frame."""
        with self._lock:
            self.queue.forget(child)

    def _drain(self) -> None:
        with self._lock:
            pending = len(self.queue)
        # One by one: a batch may make the clock jump, and that discards the rest.
        for _ in range(pending):
            with self._lock:
                batch = self.queue.get()
            if batch is None:
                return
            if not self.bus.closed:
                self.bus.publish(batch, invalid="drop")
