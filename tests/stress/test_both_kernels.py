"""Whole buses on both kernels: random traffic leaves the same state, the same wake-ups and the same errors."""

import math
import random
import struct
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import anyio
import pytest
from anyio.abc import TaskGroup
from support.asking import Asked, settle
from support.both_kernels import needs_both, tfbus_on

from tfbus.stamps import STAMP_MAX, STAMP_MIN

FRAMES = ("map", "odom", "base", "arm", "r1/base", "r1/arm", "x")
EDGES = (("map", "odom"), ("odom", "base"), ("base", "arm"), ("map", "r1/base"), ("r1/base", "r1/arm"))
LIMITS = (STAMP_MIN, STAMP_MIN + 1, -(2**62), 2**53 + 1, 2**62, STAMP_MAX - 1, STAMP_MAX)


def bits_of(sample: Any) -> tuple[object, ...]:
    row = struct.pack("7d", *sample.transform.translation, *sample.transform.rotation)
    return sample.parent, sample.child, sample.stamp, sample.authority, sample.static, row


def error_of(error: BaseException) -> object:
    return type(error).__name__, str(error)


class World:
    """A bus on one kernel, with some buffers and with lookups that wait."""

    def __init__(self, kernel: str, rng: random.Random, limits: float, tasks: TaskGroup) -> None:
        self.tfbus = tfbus_on(kernel)
        self.tasks = tasks
        self.rng = rng
        # Of its own, so that a seed draws the same traffic as before there were policies.
        self.rng_of_policies = random.Random(0)
        self.limits = limits
        self.now = 1_000
        self.clock = self.tfbus.SimulatedClock(self.now)
        options: dict[str, Any] = {"max_ahead": None} if rng.random() < 0.5 else {"max_ahead": 1e-6}
        if options["max_ahead"] is not None:
            options["reject_ahead"] = rng.random() < 0.3
        self.bus = self.tfbus.Bus(self.clock, rng.choice(["last", "last", "reject"]), max_translation=50.0, **options)
        self.said: list[object] = []
        self.asked: list[Asked[Any]] = []
        self.waiting: list[Asked[Any]] = []
        self.open: list[Any] = []
        self.buffers: list[Any] = []
        self.add_buffer()

    def say(self, call: Callable[[], object]) -> None:
        """Note what a call returns or raises."""
        try:
            self.said.append(call())
        except (self.tfbus.TransformError, TypeError, ValueError, RuntimeError) as error:
            self.said.append(error_of(error))

    # Drawn things

    def stamp(self) -> int:
        rng = self.rng
        if rng.random() < self.limits:
            return rng.choice(LIMITS)
        return self.now + rng.randrange(-400, 3) if rng.random() < 0.2 else self.now

    def sample(self) -> Any:
        rng, tfbus = self.rng, self.tfbus
        parent, child = rng.choice(EDGES)
        if rng.random() < 0.02:
            parent, child = rng.sample(FRAMES, 2)
        x = 1_000.0 if rng.random() < 0.005 else rng.uniform(-9.0, 9.0)
        transform = tfbus.Transform((x, -0.0, 1.0))
        if rng.random() < 0.5:
            quaternion = [rng.uniform(-1.0, 1.0) for _ in range(4)]
            norm = math.hypot(*quaternion)
            transform = tfbus.Transform((x, 1.0, 0.0), tuple(part / norm for part in quaternion))
        authority = "you" if rng.random() < 0.01 else "me"
        return tfbus.TransformStamped(parent, child, self.stamp(), transform, authority, rng.random() < 0.01)

    # Steps

    def publish(self) -> None:
        rng = self.rng
        self.now += rng.choice([1, 1, 1, 10, 100, 0])
        samples = [self.sample() for _ in range(rng.choice([1, 1, 1, 1, 2, 3, 5, 70]))]
        kinds: list[Callable[[Any], Any]] = [list, tuple, iter]
        batch = samples[0] if len(samples) == 1 else rng.choice(kinds)(samples)
        if rng.random() < 0.01:
            batch = rng.choice([(*samples, 5), 5, (), [], None])
        invalid = rng.choice(["raise", "drop", "drop", "drop"])
        self.said.append([bits_of(sample) for sample in samples])
        self.say(lambda: self.bus.publish(batch, invalid))

    def step_each_edge(self) -> None:
        self.now += self.rng.choice([1, 5, 50])
        for parent, child in EDGES:
            transform = self.tfbus.Transform((self.now % 7, 2.0, 3.0))
            sample = self.tfbus.TransformStamped(parent, child, self.now, transform, "me")
            self.say(lambda sample=sample: self.bus.publish(sample, "drop"))  # type: ignore[misc]

    def remove(self) -> None:
        frame = self.rng.choice(FRAMES)
        self.say(lambda: self.bus.remove_frame(frame))

    def move_clock(self) -> None:
        rng = self.rng
        self.now += rng.choice([-300, 0, 0, 500])
        self.say(lambda: self.clock.set(self.now))

    def add_buffer(self) -> None:
        rng = self.rng
        keep = rng.choice([None, 0.0, 1e-7, 1e-6, 10.0])
        options: Any = rng.choice([{}, {}, {"prefix": "r1"}, {"prefix": "r1", "shared": {"map"}}])
        if len(self.buffers) < 4:
            self.buffers.append(self.tfbus.Buffer(self.bus, keep, **options))

    def close_buffer(self) -> None:
        if len(self.buffers) > 1:
            self.buffers.pop(self.rng.randrange(len(self.buffers))).close()

    def listen(self) -> None:
        if self.open:
            self.open.pop().close()
            return
        rng, bus = self.rng, self.bus
        if rng.random() < 0.5:
            self.open.append(bus.subscribe(lambda batch: self.said.append([bits_of(sample) for sample in batch])))
        else:
            frame = rng.choice(FRAMES)
            self.say(lambda: self.open.append(bus.reserve(frame, rng.choice(["me", "me", "you"]))))

    def question(self) -> tuple[str, str, Any]:
        rng, tfbus = self.rng, self.tfbus
        target, source = rng.sample(FRAMES, 2)
        if rng.random() < 0.7:
            target, source = rng.choice([("map", "base"), ("map", "arm"), ("odom", "r1/arm"), ("base", "arm")])
        at = rng.choice([tfbus.LATEST, self.stamp(), self.now + rng.randrange(60), self.now + rng.randrange(9)])
        return target, source, at

    def options(self) -> dict[str, Any]:
        rng, hold = self.rng_of_policies, self.tfbus.Hold
        drawn = {
            "tolerance": rng.choice([0.0, 0.0, 5e-9, 1e-7, math.inf]),
            "max_gap": rng.choice([None, 0.0, 5e-9, 5e-8]),
            "extrapolate": rng.choice([None, hold(0.0), hold(5e-8), hold(math.inf)]),
            "max_age": rng.choice([None, None, None, 1e-7]),
        }
        return {name: drawn[name] for name in rng.sample(list(drawn), rng.randrange(1, 4))}

    def look_up(self) -> None:
        buffer, question = self.rng.choice(self.buffers), self.question()
        self.say(lambda: bits_of(buffer.lookup_nowait(*question)))
        for options in (self.options(), self.options()):

            def limited(options: Any = options) -> object:
                found = buffer.lookup_nowait(*question, **options)
                return bits_of(found), found.extrapolated_by, found.gap

            self.say(limited)
        stamps = [self.stamp() for _ in range(self.rng.choice([1, 2, 9]))]

        def many() -> object:
            found = buffer.tree.lookup_many(*question[:2], stamps)
            # Numpy rounds otherwise, and adds 0.0 to -0.0.
            return [(part.round(9) + 0.0).tolist() for part in (found.translations, found.rotations)]

        self.say(many)

    def wait(self) -> None:
        self.asked.append(Asked(self.tasks, partial(self.rng.choice(self.buffers).lookup, *self.question())))
        self.waiting.append(self.asked[-1])

    def note_waits(self) -> None:
        """Note how the lookups that have ended did so."""
        for asked in [asked for asked in self.waiting if asked.ended]:
            self.waiting.remove(asked)
            self.said.append(("ended", self.asked.index(asked), asked.cancelled))
            if not asked.cancelled:
                self.say(lambda asked=asked: bits_of(asked.answer))  # type: ignore[misc]

    def cancel(self) -> None:
        if self.asked:
            self.rng.choice(self.asked[-9:]).cancel()

    def step(self) -> None:
        common = (self.publish, self.publish, self.step_each_edge, self.step_each_edge, self.wait, self.look_up)
        rare = (self.remove, self.move_clock, self.add_buffer, self.close_buffer, self.listen, self.cancel)
        self.rng.choice(common if self.rng.random() < 0.9 else rare)()

    def state(self) -> object:
        """Everything that can be seen."""
        trees = [
            (
                [str(pending) for pending in buffer.pending()],
                [(edge.child, edge.parent, edge.samples, edge.oldest, edge.newest) for edge in buffer.tree.edges()],
                [buffer.tree.samples_around(edge.child, self.now)[0] is None for edge in buffer.tree.edges()],
            )
            for buffer in self.buffers
        ]
        return trees, [buffer.tree.to_yaml() for buffer in self.buffers], repr(self.bus.statistics())


def run(seed: int, steps: int, limits: float = 0.01) -> None:
    anyio.run(play, seed, steps, limits)


async def play(seed: int, steps: int, limits: float) -> None:
    async with anyio.create_task_group() as tasks:
        worlds = [World(kernel, random.Random(seed), limits, tasks) for kernel in ("compiled", "python")]
        for number in range(steps + 1):
            for world in worlds:
                world.step() if number < steps else world.bus.close()
            await settle()
            for world in worlds:
                world.note_waits()
            ours, theirs = worlds
            assert ours.said == theirs.said, (seed, number)
            assert ours.state() == theirs.state(), (seed, number)
            ours.said.clear()
            theirs.said.clear()
        assert not ours.waiting


@needs_both
@pytest.mark.parametrize("seeds", [[3025], pytest.param(range(10), marks=pytest.mark.thorough)])
def test_random_traffic_does_the_same_on_both_kernels(seeds: Iterable[int]) -> None:
    for seed in seeds:
        run(seed, 250)


@needs_both
@pytest.mark.thorough
def test_traffic_at_the_first_and_the_last_stamps_does_the_same_on_both_kernels() -> None:
    for seed in range(10_000, 10_010):
        run(seed, 150, limits=0.5)
