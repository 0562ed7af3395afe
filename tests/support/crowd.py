"""Everybody who can use a bus, at once and at random.

Every actor does one kind of thing, with random numbers and at moments of its own. Time is simulated, so the same seed
tells nearly the same story again.
"""

import threading
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from random import Random
from typing import Any, Literal

import anyio
from anyio.abc import TaskGroup
from support.asking import Asked
from support.ledger import Ledger

from tfbus import (
    SECOND,
    Buffer,
    Bus,
    BusClosedError,
    Event,
    EventStream,
    InvalidTransformError,
    MessageFilter,
    SimulatedClock,
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
