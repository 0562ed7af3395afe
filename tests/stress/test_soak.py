"""Everything at once and at random, for a while: nothing is left behind, and the counters agree all the way.

Every actor does one kind of thing, with random numbers and at moments of its own. Time is simulated, so the same seed
tells nearly the same story again.
"""

import threading
from collections import Counter
from collections.abc import Awaitable, Callable, Iterable
from contextlib import suppress
from functools import partial
from random import Random
from typing import Any

import anyio
import pytest
from anyio.abc import TaskGroup
from support.asking import Asked
from support.samples import moving

from tfbus import (
    LATEST,
    SECOND,
    AheadError,
    Buffer,
    Bus,
    BusClosedError,
    ClockReset,
    ClockResetError,
    Event,
    GapError,
    Hold,
    InvalidTransformError,
    LookupTimeoutError,
    PastExtrapolationError,
    SampleRejected,
    SimulatedClock,
    SubscriberFailed,
    Transform,
    TransformBroadcaster,
    TransformStamped,
    UnknownFrameError,
    from_seconds,
)
from tfbus.bus.queues import Overflow
from tfbus.geometry.stamped import Batch
from tfbus.testing import simulate

Actor = Callable[[Random], Awaitable[None]]

DURATION = 6.0
USUAL = {"odom": "map", "base": "odom", "arm": "base", "hand": "arm", "tool": "hand", "lidar": "base", "echo": "base"}
FRAMES = ("map", *USUAL)
ENDINGS = ("the bus closes", "all is cancelled", "buffers close one by one")
USUAL_ERRORS = (LookupTimeoutError, PastExtrapolationError, GapError, BusClosedError, ClockResetError)
DOCUMENTED = (*USUAL_ERRORS, AheadError)
"""The ends of a lookup other than an answer; the last one is rare."""
MET = {
    "answered",
    *(error.__name__ for error in USUAL_ERRORS),
    *("cycle", "reserved", "not a sample"),
}
"""The events that all soaks together meet; without them there would be nothing to see."""


class Soak:
    """One bus, and everybody who uses it until it ends."""

    def __init__(self, seed: int, ending: str) -> None:
        self.seed = seed
        self.ending = ending
        self.clock = SimulatedClock(1_000 * SECOND)
        self.bus = Bus(self.clock, on_conflict="reject" if seed % 3 == 2 else "last")
        self.buffers = [Buffer(self.bus), Buffer(self.bus, keep=2.0), Buffer(self.bus, prefix="robot/", shared={"map"})]
        self.thread = self.bus.threadsafe(capacity=6)
        self.over = False
        self.attempted = self.accepted = self.raised = 0
        self.met: Counter[str] = Counter()
        self.asked: list[Asked[TransformStamped]] = []
        self.events = self.bus.events(capacity=1_000_000, stale_after=0.3)
        self.bus.subscribe(self.hear)

    async def run(self) -> None:
        """Let everybody loose; ends when all have ended."""
        actors: list[Actor] = [
            partial(self.broadcast, authority="a"),
            partial(self.broadcast, authority="b"),
            partial(self.broadcast, authority="robot", prefix="robot/"),
            self.own,
            self.own,
            self.remove,
            self.publish_from_thread,
            self.jump_about,
            self.subscribe,
            partial(self.read, capacity=3, overflow="conflate"),
            partial(self.read, capacity=10, overflow="drop_oldest"),
            self.come_and_go,
            *[self.ask] * 3,
        ]
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(self.end, tasks)
            for place, actor in enumerate(actors):
                tasks.start_soon(self.act, partial(actor, Random(f"{self.seed} {place}")))

    async def act(self, actor: Callable[[], Awaitable[None]]) -> None:
        with suppress(BusClosedError):
            await actor()

    async def end(self, tasks: TaskGroup) -> None:
        for _ in range(round(DURATION / 0.25)):
            await self.clock.sleep(0.25)
            self.check_counters()
        if self.ending == "the bus closes":
            self.bus.close()
        elif self.ending == "all is cancelled":
            tasks.cancel_scope.cancel()
        else:
            for buffer in self.buffers:
                buffer.close()
                assert buffer.pending() == ()
                await self.clock.sleep(0.2)
            self.over = True

    def going(self) -> bool:
        return not self.over and not self.bus.closed

    async def pause(self, rng: Random, longest: float) -> None:
        await self.clock.sleep(rng.uniform(0.01, longest))

    # Publishers

    def sample(self, rng: Random, authority: str, prefix: str = "") -> TransformStamped:
        child = rng.choice(tuple(USUAL))
        parent = USUAL[child] if rng.random() < 0.85 else rng.choice([frame for frame in FRAMES if frame != child])
        parent, child = (name if name == "map" else prefix + name for name in (parent, child))
        # In steps, so that some stamps come twice.
        now = self.clock.now() // 10_000_000 * 10_000_000
        stamp = now - from_seconds(rng.choice((0.0, 0.0, 0.0, 0.05, 0.3, 4.0, -0.1)))
        static = rng.random() < (0.9 if child == "lidar" else 0.03)
        return TransformStamped(parent, child, stamp, Transform((rng.random(), 0.0, 0.0)), authority, static)

    async def broadcast(self, rng: Random, authority: str, prefix: str = "") -> None:
        while self.going():
            batch: list[Any] = [self.sample(rng, authority, prefix) for _ in range(rng.choice((1, 1, 1, 3)))]
            if rng.random() < 0.4:
                batch.append("not a sample")
            self.bus.publish(batch, invalid="drop")
            self.attempted += len(batch)
            await self.pause(rng, 0.1)

    async def own(self, rng: Random) -> None:
        broadcaster = TransformBroadcaster(self.bus, f"{rng.random()}")
        while self.going():
            await self.pause(rng, 0.5)
            with suppress(InvalidTransformError), broadcaster.owning("tool"):
                for _ in range(rng.randrange(5)):
                    self.attempted += not self.bus.closed
                    broadcaster.send("hand", "tool", Transform())
                    await self.pause(rng, 0.2)

    async def remove(self, rng: Random) -> None:
        while self.going():
            await self.pause(rng, 1.0)
            with suppress(UnknownFrameError):
                self.bus.remove_frame(rng.choice(("", "robot/")) + rng.choice(tuple(USUAL)))

    async def publish_from_thread(self, rng: Random) -> None:
        """Samples that another thread hands over while the loop stands still, so that it is the same each time."""
        with self.thread as publish:
            while self.going():
                samples = [moving("base", "arm", self.clock.now(), authority="thread")] * rng.randrange(10)
                thread = threading.Thread(target=publish_all, args=(publish, samples))
                thread.start()
                thread.join()
                self.attempted += len(samples)
                await self.pause(rng, 0.5)

    async def jump_about(self, rng: Random) -> None:
        while self.going():
            await self.pause(rng, 2.0)
            by = rng.choice((-20.0, -1.0, -0.001, 0.0, 0.5, 20.0))
            self.clock.set(self.clock.now() + from_seconds(by))
            if by < 0.0 and self.going():
                assert [buffer.pending() for buffer in self.buffers] == [()] * len(self.buffers)

    async def come_and_go(self, rng: Random) -> None:
        await self.pause(rng, DURATION / 2)
        self.buffers.append(Buffer(self.bus, prefill=self.buffers[0]))
        await self.pause(rng, DURATION / 4)
        self.buffers[1].close()

    # Listeners

    def hear(self, batch: Batch) -> None:
        self.accepted += len(batch)
        # A callback may publish.
        if any(sample.child == "base" for sample in batch):
            self.attempted += 1
            self.bus.publish(moving("base", "echo", self.clock.now(), authority="echo"), invalid="drop")

    async def subscribe(self, rng: Random) -> None:
        def crash(batch: Batch) -> None:  # noqa: ARG001
            if rng.random() < 0.1:
                self.raised += 1
                raise ZeroDivisionError

        while self.going():
            with self.bus.subscribe(crash), self.bus.subscribe(crash):
                await self.pause(rng, 1.0)

    async def read(self, rng: Random, capacity: int, overflow: Overflow) -> None:
        """Read slowly; each moving sample that was published meanwhile is read, counted as lost, or still there."""
        while self.going():
            offered = read = 0

            def offer(batch: Batch) -> None:
                nonlocal offered
                offered += sum(not sample.static for sample in batch)

            with self.bus.stream(capacity, overflow) as stream:
                with self.bus.subscribe(offer), self.clock.move_on_after(rng.uniform(1.0, 8.0)):
                    async for batch in stream:
                        read += sum(not sample.static for sample in batch)
                        await self.pause(rng, 0.5)
                left = offered - read - stream.dropped - stream.queue.conflated
                assert 0 <= left <= len(stream.queue)

    async def ask(self, rng: Random) -> None:
        async with anyio.create_task_group() as tasks:
            while self.going():
                target, source, fixed = rng.sample(FRAMES, 3)
                at, source_at = (self.clock.now() + from_seconds(rng.uniform(-2.0, 0.5)) for _ in range(2))
                options = {**policy(rng), "timeout": rng.choice((None, 0.0, 0.2, 2.0))}
                if rng.random() < 0.3:
                    options |= {"source_at": source_at, "fixed": fixed}
                lookup = partial(rng.choice(self.buffers).lookup, target, source, rng.choice((at, LATEST)), **options)
                self.asked.append(Asked(tasks, lookup))
                if rng.random() < 0.3:
                    rng.choice(self.asked[-20:]).cancel()
                await self.pause(rng, 0.15)

    # Checks

    def check_counters(self) -> None:
        counted = self.bus.statistics()
        for its in counted.buffers:
            assert its.offered == its.inserted + its.replaced + its.expired
        assert counted.samples == self.accepted
        # An edge that went to make room for a reserved frame had been accepted.
        judged = counted.samples + sum(counted.rejected.values()) - counted.rejected.get("displaced", 0)
        assert self.attempted == judged + self.thread.queue.dropped
        assert counted.callbacks_failed == self.raised

    def check_lookups(self) -> None:
        """Check that every lookup has ended in an answer or one of the documented errors, or was cancelled."""
        for asked in self.asked:
            if asked.error is not None:
                assert isinstance(asked.error, DOCUMENTED), repr(asked.error)
                self.met[type(asked.error).__name__] += 1
            elif not asked.cancelled:
                assert asked.ended or self.ending == "all is cancelled"
                self.met["answered"] += asked.ended

    async def check_events(self) -> None:
        """Check that the events agree with the counters."""
        self.events.close()
        told: list[Event] = [event async for event in self.events]
        counted = self.bus.statistics()
        rejected = {event.reason for event in told if isinstance(event, SampleRejected)}
        assert rejected == counted.rejected.keys()
        assert sum(isinstance(event, SubscriberFailed) for event in told) == counted.callbacks_failed
        assert sum(isinstance(event, ClockReset) for event in told) == counted.clock_resets
        self.met.update(rejected)

    def check_that_nothing_is_left(self) -> None:
        assert self.bus.statistics().queues == ()
        assert [buffer.pending() for buffer in self.buffers] == [()] * len(self.buffers)
        if not self.bus.closed:
            self.bus.reserve("tool", "somebody else").close()
        self.bus.close()


def publish_all(publish: Callable[[TransformStamped], object], samples: Iterable[TransformStamped]) -> None:
    for sample in samples:
        publish(sample)


def policy(rng: Random) -> dict[str, Any]:
    kind = rng.choice(("none", "none", "tolerance", "max_gap", "extrapolate"))
    seconds = rng.uniform(0.0, 0.4)
    return {} if kind == "none" else {kind: Hold(seconds) if kind == "extrapolate" else seconds}


@pytest.mark.thorough
@pytest.mark.anyio
async def test_soaks_that_end_in_every_way_leave_nothing_behind_and_meet_everything_between_them() -> None:
    met: Counter[str] = Counter()
    for seed, ending in enumerate(ENDINGS * 2):
        soak = Soak(seed, ending)
        before = len(anyio.get_running_tasks())
        await simulate(soak.clock, soak.run)
        assert len(anyio.get_running_tasks()) == before
        soak.check_counters()
        soak.check_lookups()
        await soak.check_events()
        soak.check_that_nothing_is_left()
        met += soak.met
    assert met.keys() >= MET
