"""Everybody who can use a bus, at once and at random.

Every actor does one kind of thing, with random numbers and at moments of its own. Time is simulated, so the same seed
tells nearly the same story again.
"""

import math
import threading
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from random import Random
from typing import Any, Literal, NamedTuple

import anyio
from anyio.abc import TaskGroup
from support.asking import Asked

from tfbus import (
    LATEST,
    SECOND,
    Buffer,
    Bus,
    BusClosedError,
    ClockResetError,
    Event,
    EventStream,
    Hold,
    InvalidTransformError,
    MessageFilter,
    PointStamped,
    SimulatedClock,
    Stream,
    Transform,
    TransformBroadcaster,
    TransformStamped,
    UnknownFrameError,
    from_seconds,
)
from tfbus.bus.queues import Overflow
from tfbus.geometry.stamped import Batch

Ending = Literal["the bus closes", "all is cancelled", "buffers close one by one"]
Actor = Callable[[Random], Awaitable[None]]

DURATION = 6.0
USUAL = {"odom": "map", "base": "odom", "arm": "base", "hand": "arm", "tool": "hand", "lidar": "base", "echo": "base"}
FRAMES = ("map", *USUAL)
ROBOT = "robot/"


class Crowd:
    """One bus, and everybody who uses it until it ends.

    Attributes
    ----------
    over : bool
        Whether those are to stop whom nothing else stops.
    attempted, accepted : int
        Samples that were handed over to be published, and those that the bus has passed on.
    twin : Buffer or None
        One that has joined with the history of `plain`, while both are on the bus.
    raised : int
        Exceptions of subscribers.
    met : Counter of str
        What has happened that a soak must not go without.
    """

    def __init__(self, seed: int, ending: Ending) -> None:
        self.seed = seed
        self.ending = ending
        self.clock = SimulatedClock(1_000 * SECOND)
        self.bus = Bus(self.clock, on_conflict="reject" if seed % 3 == 2 else "last")
        self.plain = Buffer(self.bus)
        self.twin: Buffer | None = None
        self.buffers = [self.plain, Buffer(self.bus, keep=2.0), Buffer(self.bus, prefix=ROBOT, shared={"map"})]
        self.thread = self.bus.threadsafe(capacity=6)
        self.over = False
        self.attempted = self.accepted = 0
        self.raised = 0
        self.met: Counter[str] = Counter()
        self.asked: list[Asked[None]] = []
        self.ledgers: list[Ledger] = []
        self.filters: list[MessageFilter[Any, Any]] = []
        self.every = self.bus.events(capacity=1_000_000, stale_after=None)
        self.some = self.bus.events(capacity=5, stale_after=None)
        self.stale = self.bus.events(capacity=1_000_000, stale_after=0.3)
        self.told: dict[EventStream, list[Event]] = {self.every: [], self.some: [], self.stale: []}
        self.subscriptions = [self.bus.subscribe(self.hear, self.forget), self.bus.subscribe(self.echo)]
        self.jumps = self.clock.on_jump(self.jumped)

    async def run(self, askers: Sequence[Callable[["Crowd", Random], Awaitable[None]]]) -> None:
        """Let everybody loose, with some more who ask; ends when all have ended, without anybody's help."""
        actors: list[Actor] = [
            partial(self.broadcast, authority="a", children=tuple(USUAL)),
            partial(self.broadcast, authority="b", children=tuple(USUAL)),
            partial(self.broadcast, authority="robot", children=("odom", "base", "arm"), prefix=ROBOT),
            partial(self.broadcast, authority="odometry", children=("odom",)),
            partial(self.broadcast, authority="slam", children=("odom",)),
            partial(self.own, authority="left"),
            partial(self.own, authority="right"),
            self.reserve,
            self.remove,
            self.publish_from_thread,
            self.jump_about,
            self.subscribe,
            partial(self.read, capacity=3, overflow="conflate", longest=0.2),
            partial(self.read, capacity=100, overflow="conflate", longest=1.0),
            partial(self.read, capacity=10, overflow="drop_oldest", longest=0.5),
            partial(self.read, capacity=1_000, overflow="drop_oldest", longest=0.05),
            partial(self.listen, events=self.every, longest=0.1),
            partial(self.listen, events=self.some, longest=0.5),
            partial(self.listen, events=self.stale, longest=0.01),
            self.come_and_go,
            *(partial(asker, self) for asker in askers),
        ]
        async with anyio.create_task_group() as tasks:
            actors.append(partial(self.end, tasks=tasks))
            for place, actor in enumerate(actors):
                tasks.start_soon(self.act, partial(actor, Random(f"{self.seed} {place}")))

    async def act(self, actor: Callable[[], Awaitable[None]]) -> None:
        with suppress(BusClosedError):
            await actor()

    async def end(self, rng: Random, tasks: TaskGroup) -> None:
        await self.clock.sleep(DURATION)
        if self.ending == "the bus closes":
            self.bus.close()
        elif self.ending == "all is cancelled":
            tasks.cancel_scope.cancel()
        else:
            self.twin = None
            for buffer in rng.sample(self.buffers, len(self.buffers)):
                buffer.close()
                assert buffer.pending() == ()
                await self.pause(rng, 0.5)
            self.over = True
            # Until nobody sends any more.
            await self.clock.sleep(3.0)
            for ledger in self.ledgers:
                ledger.close()
            self.close_events()

    def close_events(self) -> None:
        """All at once, so that all have heard the same."""
        for events in self.told:
            events.close()

    async def pause(self, rng: Random, longest: float) -> None:
        await self.clock.sleep(rng.uniform(0.01, longest))

    @property
    def going(self) -> bool:
        return not self.over and not self.bus.closed

    # Who publishes

    def sample(self, rng: Random, authority: str, children: tuple[str, ...], prefix: str = "") -> TransformStamped:
        child = rng.choice(children)
        parent = USUAL[child]
        if rng.random() < 0.15:
            parent = rng.choice([frame for frame in FRAMES if frame != child])
        parent, child = (name if name == "map" else prefix + name for name in (parent, child))
        static = rng.random() < (0.9 if child == "lidar" else 0.03)
        # In steps, so that some stamps come twice.
        now = self.clock.now() // 10_000_000 * 10_000_000
        stamp = now - from_seconds(rng.choice((0.0, 0.0, 0.0, 0.05, 0.3, 4.0, -0.1)))
        transform = Transform((rng.uniform(-1.0, 1.0), 0.0, 0.0))
        return TransformStamped(parent, child, stamp, transform, authority, static)

    @contextmanager
    def attempt(self, number: int) -> Iterator[None]:
        """Count samples that are handed over; of a batch that is refused as a whole, those that are to blame."""
        rejected = self.rejected() if number > 1 else 0
        try:
            yield
        except InvalidTransformError:
            number = self.rejected() - rejected if number > 1 else 1
        self.attempted += number

    def rejected(self) -> int:
        return sum(self.bus.statistics().rejected.values())

    async def broadcast(self, rng: Random, authority: str, children: tuple[str, ...], prefix: str = "") -> None:
        broadcaster = TransformBroadcaster(self.bus, authority)
        while self.going:
            batch = [self.sample(rng, authority, children, prefix) for _ in range(rng.choice((1, 1, 1, 3)))]
            if rng.random() < 0.6:
                with self.attempt(len(batch)):
                    broadcaster.send_all(batch)
            else:
                mixed: list[Any] = [*batch, "not a sample"]
                self.bus.publish(mixed, invalid="drop")
                self.attempted += len(mixed)
            await self.pause(rng, 0.1)

    async def own(self, rng: Random, authority: str) -> None:
        broadcaster = TransformBroadcaster(self.bus, authority)
        while self.going:
            await self.pause(rng, 0.5)
            try:
                with broadcaster.owning("tool"):
                    for _ in range(rng.randrange(5)):
                        with self.attempt(1):
                            broadcaster.send("hand", "tool", Transform())
                        await self.pause(rng, 0.2)
            except InvalidTransformError as error:
                assert error.reason == "reserved"
                self.met["owned"] += 1

    async def reserve(self, rng: Random) -> None:
        while self.going:
            await self.pause(rng, 1.0)
            with self.bus.reserve("odom", rng.choice(("odometry", "slam"))):
                await self.pause(rng, 1.0)

    async def remove(self, rng: Random) -> None:
        while self.going:
            await self.pause(rng, 1.0)
            frame = rng.choice(("", ROBOT)) + rng.choice(tuple(USUAL))
            with suppress(UnknownFrameError):
                self.bus.remove_frame(frame)
                self.met["removed"] += 1

    def forget(self, frame: str) -> None:
        """Note that a frame was removed, by `remove`, by an owner who has ended, or for a frame that is reserved."""
        for ledger in self.ledgers:
            if ledger.open and not self.bus.closed:
                ledger.forget(frame)

    async def publish_from_thread(self, rng: Random) -> None:
        """Samples that another thread hands over while the loop stands still, so that it is the same each time."""

        def publish_all() -> None:
            for sample in samples:
                publish(sample)

        with self.thread as publish:
            while self.going:
                drawn = [self.sample(rng, "thread", ("arm", "hand")) for _ in range(rng.randrange(10))]
                samples = [sample.replace(static=False) for sample in drawn]
                thread = threading.Thread(target=publish_all)
                thread.start()
                thread.join()
                self.attempted += len(samples)
                if rng.random() < 0.1:
                    self.jump(rng)
                await self.pause(rng, 0.5)

    # The clock, and the buffers that come and go

    def jump(self, rng: Random) -> None:
        by = rng.choice((-20.0, -1.0, -0.001, 0.0, 0.5, 20.0))
        self.clock.set(self.clock.now() + from_seconds(by))
        if by < 0.0 and self.going:
            assert len(self.thread.queue) == 0
            assert [buffer.pending() for buffer in self.buffers] == [()] * len(self.buffers)

    def jumped(self, before: int, after: int) -> None:
        for ledger in self.ledgers:
            if after < before and ledger.open and not self.bus.closed:
                ledger.discard_moving()

    async def jump_about(self, rng: Random) -> None:
        while self.going:
            await self.pause(rng, 2.0)
            self.jump(rng)

    async def come_and_go(self, rng: Random) -> None:
        await self.pause(rng, DURATION / 2)
        self.twin = Buffer(self.bus, prefill=self.plain)
        self.buffers.append(self.twin)
        await self.pause(rng, DURATION / 4)
        self.buffers[1].close()
        await self.pause(rng, DURATION / 4)
        self.buffers.append(Buffer(self.bus, keep=1.0))

    # Who listens

    def hear(self, batch: Batch) -> None:
        self.accepted += len(batch)
        for ledger in self.ledgers:
            if ledger.open:
                ledger.offer(batch)

    def echo(self, batch: Batch) -> None:
        if any(sample.child == "base" for sample in batch):
            with self.attempt(1):
                TransformBroadcaster(self.bus, "echo").send("base", "echo", Transform())

    async def subscribe(self, rng: Random) -> None:
        def crash(batch: Batch) -> None:  # noqa: ARG001
            if rng.random() < 0.1:
                self.raised += 1
                raise ZeroDivisionError

        while self.going:
            with self.bus.subscribe(crash), self.bus.subscribe(crash):
                await self.pause(rng, 1.0)

    async def read(self, rng: Random, capacity: int, overflow: Overflow, longest: float) -> None:
        while self.going:
            ledger = Ledger(self.bus.stream(capacity, overflow))
            self.ledgers.append(ledger)
            try:
                with self.clock.move_on_after(rng.uniform(1.0, 8.0)):
                    async for batch in ledger.stream:
                        ledger.note(batch)
                        await self.pause(rng, longest)
            finally:
                ledger.close()

    async def listen(self, rng: Random, events: EventStream, longest: float) -> None:
        async for event in events:
            self.told[events].append(event)
            await self.pause(rng, longest)


# Those who ask a crowd's buffers: lookups, watches and message filters, at random and cut short at random


class SourceError(Exception):
    """The error that a source of messages raises."""


class Message(NamedTuple):
    number: int
    frame: str
    stamp: int


def policy(rng: Random) -> dict[str, Any]:
    kind = rng.choice(("none", "none", "tolerance", "max_gap", "extrapolate"))
    seconds = rng.uniform(0.0, 0.4)
    return {} if kind == "none" else {kind: Hold(seconds) if kind == "extrapolate" else seconds}


def longest_hold(rng: Random) -> float:
    """In s; now and then there is no end to it."""
    return math.inf if rng.random() < 0.1 else rng.uniform(0.0, 4.0)


async def look_up(crowd: Crowd, rng: Random) -> None:
    buffer = rng.choice(crowd.buffers)
    target, source, fixed = rng.sample(FRAMES, 3)
    if rng.random() < 0.02:
        target = "/" + target
    at, source_at = (crowd.clock.now() + from_seconds(rng.uniform(-2.0, 0.5)) for _ in range(2))
    options = {**policy(rng), "timeout": rng.choice((None, 0.0, 0.2, 2.0))}
    kind = rng.choice(("at", "at", "latest", "travel", "data", "data travel"))
    if kind in ("data", "data travel"):
        point = PointStamped(source, rng.choice((source_at, LATEST)), (1.0, 0.0, 0.0))
        if kind == "data travel":
            options |= {"at": at, "fixed": fixed}
        moved = await buffer.transform(point, target, **options)
        assert moved.frame == target
        return
    if kind == "latest":
        found = await buffer.lookup(target, source, max_age=rng.choice((None, 0.2)), **options)
    else:
        if kind == "travel":
            options |= {"source_at": source_at, "fixed": fixed}
        found = await buffer.lookup(target, source, at, **options)
        assert found.stamp == at
    assert (found.parent, found.child) == (target, source)


async def ask(crowd: Crowd, rng: Random) -> None:
    async with anyio.create_task_group() as tasks:
        while crowd.going:
            crowd.asked.append(Asked(tasks, partial(look_up, crowd, Random(rng.random()))))
            if rng.random() < 0.3:
                rng.choice(crowd.asked[-20:]).cancel()
            await crowd.pause(rng, 0.15)


async def watch(crowd: Crowd, rng: Random) -> None:
    while crowd.going:
        target, source = rng.sample(FRAMES, 2)
        options = {**policy(rng), "max_age": rng.choice((None, 0.5)), "max_rate": rng.choice((None, 5.0))}
        changes = rng.choice(crowd.buffers).watch(target, source, min_translation=rng.choice((0.0, 0.1)), **options)
        with changes, crowd.clock.move_on_after(longest_hold(rng)):
            for _ in range(3):
                try:
                    async for found in changes:
                        assert (found.parent, found.child) == (target, source)
                        crowd.met["watched"] += 1
                        await crowd.pause(rng, 0.4)
                except ClockResetError:
                    crowd.met["watch reset"] += 1
        await crowd.pause(rng, 0.2)


async def messages(crowd: Crowd, rng: Random, sent: list[Message]) -> AsyncIterator[Message]:
    while True:
        await crowd.pause(rng, 0.1)
        if rng.random() < 0.03:
            raise SourceError
        stamp = crowd.clock.now() + from_seconds(rng.uniform(-2.0, 0.5))
        sent.append(Message(len(sent), rng.choice((*FRAMES, "nobody", "/bad")), stamp))
        yield sent[-1]


async def filter_messages(crowd: Crowd, rng: Random) -> None:
    sent: list[Message] = []
    ended: list[Message] = []

    def drop(message: Message, reason: str, error: Exception | None) -> None:
        assert reason == "queue full" or error is not None or reason == "closed"
        ended.append(message)

    while crowd.going:
        await crowd.pause(rng, 0.2)
        targets: Any = rng.choice(("map", ("map", "base")))
        pairs: MessageFilter[Message, Any] = MessageFilter(
            messages(crowd, rng, sent),
            rng.choice(crowd.buffers),
            targets,
            tolerance=rng.choice((0.0, 0.1)),
            timeout=rng.choice((None, 0.0, 0.2, 1.0)),
            capacity=rng.randint(1, 6),
            overflow=rng.choice(("drop_oldest", "drop_newest", "block")),
            order=rng.choice(("ready", "stamp", "arrival")),
            on_drop=drop,
        )
        crowd.filters.append(pairs)
        try:
            with crowd.clock.move_on_after(longest_hold(rng)):
                async with pairs:
                    async for message, _ in pairs:
                        ended.append(message)
                        if rng.random() < 0.1:
                            pairs.set_target("odom" if targets == "map" else ("odom", "map"))
                        await crowd.pause(rng, 0.3)
        except SourceError:
            crowd.met["source failed"] += 1
        finally:
            assert sorted(ended) == sent
            assert pairs.arrived == pairs.delivered + sum(pairs.dropped.values())
            crowd.met.update(pairs.dropped)
            crowd.met["delivered"] += pairs.delivered
            sent.clear()
            ended.clear()


# The samples that a stream was offered, and the fate of each


class Ledger:
    """The samples that a stream was offered while it was open, and the fate of each moving one.

    What a conflating stream gives up for something newer of the same child is `superseded` here, and `pending` is what
    such a stream must hold.
    """

    def __init__(self, stream: Stream) -> None:
        self.stream = stream
        self.conflates = stream.queue.overflow == "conflate"
        self.open = True
        self.offered = self.read = self.lost = self.superseded = 0
        self.pending: dict[str, TransformStamped] = {}
        self.statics: dict[str, TransformStamped] = {}
        self.statics_read: dict[str, TransformStamped] = {}

    def offer(self, batch: Batch) -> None:
        for sample in batch:
            if sample.static:
                self.statics[sample.child] = sample
            else:
                self.offered += 1
            if self.conflates:
                self._conflate(sample)
        while len(self.pending) > self.stream.queue.capacity:
            self._lose(next(iter(self.pending)))

    def forget(self, child: str) -> None:
        self.statics.pop(child, None)
        self._lose(child)

    def discard_moving(self) -> None:
        for child in tuple(self.pending):
            self._lose(child)

    def note(self, batch: Batch) -> None:
        moving = [sample for sample in batch if not sample.static]
        self.read += len(moving)
        self.statics_read.update((sample.child, sample) for sample in batch if sample.static)
        if self.conflates:
            assert [id(sample) for sample in moving] == [id(sample) for sample in self.pending.values()]
            self.pending.clear()

    def check(self) -> None:
        left = self.offered - self.read - self.stream.dropped - self.stream.queue.conflated
        assert 0 <= left <= len(self.stream.queue)
        if self.conflates:
            assert (left, self.stream.dropped) == (len(self.pending), self.lost)
        assert self.stream.queue.conflated == self.superseded

    async def check_to_the_end(self) -> None:
        """Read what the reader has left behind when it went."""
        async for batch in self.stream:
            self.note(batch)
        self.check()
        assert self.offered == self.read + self.stream.dropped + self.superseded
        for child, sample in self.statics.items():
            assert self.statics_read.get(child) is sample, "the newest static sample is never dropped"

    def close(self) -> None:
        self.open = False
        self.stream.close()

    def _conflate(self, sample: TransformStamped) -> None:
        before = self.pending.get(sample.child)
        self.superseded += before is not None
        if not sample.static:
            self.statics.pop(sample.child, None)
        if sample.static or before is None or before.stamp <= sample.stamp:
            self.pending.pop(sample.child, None)
            if not sample.static:
                self.pending[sample.child] = sample

    def _lose(self, child: str) -> None:
        self.lost += self.pending.pop(child, None) is not None
