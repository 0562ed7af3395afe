"""The speed of tfbus beside its peers: `pytest tests/benchmarks` ends with a table. The default run leaves this out.

Timings on a shared machine drift, so what counts is the ratio of two sides that take turns. No test asserts a time.
"""

from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from functools import partial
from itertools import count, pairwise
from statistics import median
from time import perf_counter, thread_time
from typing import Any

import anyio
import anyio.lowlevel
import cases
import numpy as np
import pytest
from beside import ROUNDS, Ask, Table, Turn, build, last_of, name_of, samples_of, show, take_turns, timed
from cases import AUTHORITY, BASE, START, Case, Pass, Vector

import tfbus
from tfbus import Buffer, Bus, Transform, TransformStamped
from tfbus.tree.history import FrameHistory

pytest_plugins = ["side_by_side"]

FEW_ROUNDS = 5
HUNDRED = 100
A_SECOND = 100_000
"""The number of samples that a hundred frames have in a second at 1 kHz."""
CROWD = 10_000

Backend = tuple[str, dict[str, Any]]
Run = Callable[[Callable[[], Awaitable[None]]], None]


def call_with_each(call: Callable[[Any], object], arguments: list[Any]) -> float:
    """Seconds in all."""
    start = perf_counter()
    for argument in arguments:
        call(argument)
    return perf_counter() - start


def insert(kind: str, package: Any) -> Pass:
    samples = build(cases.insertions(kind), package)
    calls: list[Any] = samples
    if kind == "insert batches":
        calls = [samples[i : i + cases.BATCH] for i in range(0, len(samples), cases.BATCH)]
    elif kind == "insert stamped":
        calls = [(sample.stamp, sample.transform) for sample in samples]
    stamped = package.TransformStamped

    def one_pass() -> tuple[float, Vector]:
        bus = package.Bus()
        buffer = package.Buffer(bus, cases.KEEP)
        tree = buffer.tree
        if kind == "insert into the tree":
            tree = package.TransformTree(cases.KEEP)
            seconds = call_with_each(tree.insert, calls)
        elif kind == "insert stamped":
            publish = bus.publish
            start = perf_counter()
            for stamp, transform in calls:
                publish(stamped(BASE, "f0", stamp, transform, AUTHORITY))
            seconds = perf_counter() - start
        else:
            # The first tells of stamps far behind the clock, once for each frame.
            bus.publish(calls[0])
            seconds = call_with_each(bus.publish, calls[1:])
        return seconds / len(samples), tree.lookup(BASE, "f0").transform.translation

    return one_pass


def lookup(case: Case, package: Any) -> Pass:
    bus = package.Bus()
    buffer = package.Buffer(bus, 2 * cases.KEEP)
    bus.publish(build(cases.history(case.chain), package))
    stamps = [package.LATEST if case.kind == "lookup latest" else stamp for stamp in cases.questions(case.kind)]
    source = last_of(case.chain)

    def one_pass() -> tuple[float, Vector]:
        ask = buffer.lookup_nowait
        start = perf_counter()
        for stamp in stamps:
            found = ask(BASE, source, stamp)
        return (perf_counter() - start) / len(stamps), found.transform.translation

    return one_pass


def passes(case: Case, package: Any) -> Pass:
    return lookup(case, package) if case.chain else insert(case.kind, package)


@pytest.mark.parametrize(
    ("label", "case", "wanted"),
    [
        ("publish 1, built beforehand", Case("insert"), "<= 0.4"),
        ("publish 1, stamped in the timing", Case("insert stamped"), "<= 1.0"),
        ("publish 20, each", Case("insert batches"), "<= 1.0"),
        ("insert 1 into a tree", Case("insert into the tree"), "<= 0.4"),
        ("lookup, 1 edge", Case("lookup", "m"), "<= 0.07"),
        ("lookup, 3 edges", Case("lookup", "mmm"), "<= 0.08"),
        ("lookup, 10 edges", Case("lookup", "m" * 10), "<= 0.15"),
        ("lookup, 10 edges, 7 of them static", Case("lookup", "msssmsssms"), ""),
        ("lookup in the newest 0.1 s, 10 edges", Case("lookup newest", "m" * 10), "<= 0.15"),
        ("lookup LATEST, 1 edge", Case("lookup latest", "m"), ""),
        ("lookup LATEST, 3 edges", Case("lookup latest", "mmm"), ""),
        ("lookup LATEST, 10 edges", Case("lookup latest", "m" * 10), "<= 0.15"),
        ("lookup LATEST, 30 edges", Case("lookup latest", "m" * 30), ""),
        ("lookup LATEST, 1 static edge", Case("lookup latest", "s"), ""),
        ("lookup LATEST, 30 static edges", Case("lookup latest", "s" * 30), ""),
    ],
)
def test_beside_tf2(table: Table, tf2: Ask | None, label: str, case: Case, wanted: str) -> None:
    def on(package: Any) -> Turn:
        one_pass = passes(case, package)
        assert tf2 is None or one_pass()[1] == pytest.approx(tf2(case)[1], abs=1e-6)
        return lambda: one_pass()[0]

    table.measure(label, on, "tf2", None if tf2 is None else lambda: tf2(case)[0], wanted)


@pytest.mark.parametrize("depth", [1, 3, 10])
def test_a_prefix(table: Table, depth: int) -> None:
    """The same question to a buffer with a prefix and to one without."""
    bus = Bus(max_behind=None)
    plain, local = Buffer(bus, 2 * cases.KEEP), Buffer(bus, 2 * cases.KEEP, prefix="r/")
    frames = [f"f{i}" for i in range(depth + 1)]
    for parent, child in pairwise(frames):
        bus.publish(samples_of(tfbus, f"r/{child}", HUNDRED, f"r/{parent}"))
    stamps = [START + i * cases.PERIOD + 1 for i in range(HUNDRED - 1)]

    def asking(buffer: Buffer, prefix: str) -> Turn:
        ask, target, source = buffer.lookup_nowait, prefix + frames[0], prefix + frames[-1]
        return timed(lambda: [ask(target, source, stamp) for stamp in stamps], len(stamps))

    ours, theirs = take_turns(asking(local, ""), asking(plain, "r/"))
    table.compare(f"lookup with a prefix, depth {depth}", ours, "without", theirs, "<= 1.3", "ns")


INSIDE = START + 500 * cases.PERIOD + 333
BEYOND = START + 10_000 * cases.PERIOD
Calls = Callable[[Any, Any, str], Callable[[], object]]
"""Makes a call from the package, a buffer and the last frame of its chain."""


def refused(call: Callable[[], object], error: type[Exception]) -> None:
    try:
        call()
    except error:
        return
    raise AssertionError("it has an answer")


@pytest.mark.parametrize("depth", [1, 3, 10])
@pytest.mark.parametrize(
    ("label", "calls", "wanted"),
    [
        ("lookup at a stamp", lambda _p, b, f: partial(b.lookup_nowait, BASE, f, INSIDE), ""),
        ("lookup, max_age", lambda _p, b, f: partial(b.lookup_nowait, BASE, f, max_age=9e8), "<= 3 plain"),
        ("lookup, not_before", lambda _p, b, f: partial(b.tree.lookup, BASE, f, not_before=START), "<= 3 plain"),
        (
            "time travel",
            lambda _p, b, f: partial(b.lookup_nowait, BASE, f, INSIDE, source_at=START + 10**8, fixed=BASE),
            "",
        ),
        ("lookup, tolerance", lambda _p, b, f: partial(b.lookup_nowait, BASE, f, INSIDE, tolerance=0.1), "<= 8 plain"),
        ("lookup, max_gap", lambda _p, b, f: partial(b.lookup_nowait, BASE, f, INSIDE, max_gap=1.0), "<= 8 plain"),
        (
            "lookup, hold",
            lambda p, b, f: partial(b.lookup_nowait, BASE, f, INSIDE, extrapolate=p.Hold(1.0)),
            "<= 8 plain",
        ),
        ("can_transform, False", lambda _p, b, f: partial(b.can_transform, BASE, f, BEYOND), "<= 0.5 us"),
        (
            "a future lookup, caught",
            lambda p, b, f: partial(refused, partial(b.lookup_nowait, BASE, f, BEYOND), p.TransformLookupError),
            "<= 1.9 us",
        ),
        (
            "an unknown frame, caught",
            lambda p, b, _f: partial(refused, partial(b.lookup_nowait, BASE, "nobody"), p.TransformLookupError),
            "<= 1.9 us",
        ),
    ],
)
def test_questions_that_are_not_plain(table: Table, depth: int, label: str, calls: Calls, wanted: str) -> None:
    def on(package: Any) -> Turn:
        bus = package.Bus(package.SimulatedClock(START + 1_000 * cases.PERIOD))
        buffer = package.Buffer(bus, 2 * cases.KEEP)
        bus.publish(build(cases.history("m" * depth), package))
        call = calls(package, buffer, last_of("m" * depth))
        return timed(lambda: [call() for _ in range(HUNDRED)], HUNDRED)

    table.measure(f"{label}, depth {depth}", on, "", None, wanted, "ns")


@pytest.mark.parametrize(
    ("label", "call", "wanted"),
    [
        ("a @ b", lambda _p, a, _m: lambda: a @ a, "<= 250"),
        ("inverse", lambda _p, a, _m: a.inverse, "<= 200"),
        ("apply, a point", lambda _p, a, _m: partial(a.apply, (1.0, 2.0, 3.0)), "<= 250"),
        ("matrix", lambda _p, a, _m: a.matrix, "<= 300"),
        ("from_matrix", lambda p, _a, m: partial(p.Transform.from_matrix, m), "<= 2,000"),
        ("do_transform, a point", lambda p, a, _m: moved(p, p.PointStamped("f", 0, (1.0, 2.0, 3.0)), a), "<= 1,050"),
        ("do_transform, a pose", lambda p, a, _m: moved(p, p.PoseStamped("f", 0, a), a), "<= 2,000"),
    ],
)
def test_arithmetic(table: Table, label: str, call: Any, wanted: str) -> None:
    def on(package: Any) -> Turn:
        transform = package.Transform((1.0, 2.0, 3.0), Transform.from_axis_angle((1.0, 2.0, 3.0), 0.7).rotation)
        made = call(package, transform, transform.matrix())
        return timed(lambda: [made() for _ in range(HUNDRED)], HUNDRED)

    table.measure(label, on, "", None, wanted, "ns")


def moved(package: Any, data: Any, transform: Any) -> Callable[[], object]:
    return partial(package.do_transform, data, package.TransformStamped(BASE, "f", START, transform))


CLOUDS = [(100, np.float64, "<= 2.5"), (1_000, np.float64, "<= 1.4"), (100_000, np.float32, "<= 1.5")]


@pytest.mark.parametrize(("points", "kind", "wanted"), CLOUDS)
def test_clouds(table: Table, points: int, kind: Any, wanted: str) -> None:
    positions = np.random.default_rng(1).normal(size=(points, 3)).astype(kind)
    calls = max(1, 10_000 // points)

    def on(package: Any) -> Turn:
        call = moved(package, package.PointCloud("f", 0, positions), package.Transform((1.0, 2.0, 3.0)))
        return timed(lambda: [call() for _ in range(calls)], calls)

    turn, shift = np.eye(3, dtype=kind), np.array((1.0, 2.0, 3.0), kind)
    alone = timed(lambda: [positions @ turn + shift for _ in range(calls)], calls)
    table.measure(f"do_transform, a cloud of {points:,}", on, "numpy", alone, wanted)


def test_scan(table: Table) -> None:
    ranges, angles = np.full(360, 3.0), -3.0 + 0.0166 * np.arange(360)

    def on(package: Any) -> Turn:
        scan = package.LaserScan("f", 0, ranges, angle_min=-3.0, angle_increment=0.0166)
        return timed(lambda: [scan.to_points() for _ in range(HUNDRED)], HUNDRED)

    def by_numpy() -> Any:
        return np.stack((ranges * np.cos(angles), ranges * np.sin(angles), np.zeros(360)), 1)

    alone = timed(lambda: [by_numpy() for _ in range(HUNDRED)], HUNDRED)
    table.measure("LaserScan.to_points, 360 rays", on, "numpy", alone, "<= 1.6")


def test_a_chain_of_ten_thousand_frames(table: Table) -> None:
    depth, steps = 10_000, count(START + 2)
    tree = tfbus.TransformTree()
    names = [f"f{i}" for i in range(depth + 1)]
    tree.insert_many(TransformStamped(*pair, START + i, Transform()) for i in range(2) for pair in pairwise(names))
    describing, reparenting = take_turns(
        timed(tree.describe),
        timed(
            lambda: tree.insert(TransformStamped(names[-2 - (stamp := next(steps)) % 2], names[-1], stamp, Transform()))
        ),
        rounds=FEW_ROUNDS,
    )
    table.add("describe a chain of 10,000 frames", show(describing, "ms"))
    table.add("reparent the leaf at its end", show(reparenting, "us"), wanted="<= 100 us")


@pytest.mark.parametrize("frames", [10_000, 100_000])
def test_many_frames_at_once(table: Table, frames: int) -> None:
    """Each is one call, so the event loop does nothing else meanwhile."""
    children = [f"f{i}" for i in range(frames)]
    parents = [f"p{i // 10}" for i in range(frames)]
    poses = np.zeros((frames, 3)), np.tile(Transform().rotation, (frames, 1))
    clock = tfbus.SimulatedClock(START)
    with Bus(clock, max_behind=None) as fixed, Bus(clock) as moving, Buffer(moving):
        fixed.publish_columns(parents, children, START, *poses, AUTHORITY, static=True)

        def closed_after(call: Callable[[], Any]) -> float:
            start = perf_counter()
            opened = call()
            seconds = perf_counter() - start
            opened.close()
            return seconds

        def jump_back() -> float:
            clock.set(START)
            moving.publish_columns(parents, children, START, *poses, AUTHORITY)
            start = perf_counter()
            clock.set(START - 1)
            return perf_counter() - start

        sides = (lambda: closed_after(lambda: Buffer(fixed)), jump_back, lambda: closed_after(fixed.events))
        joining, jumping, opening = take_turns(*sides, rounds=FEW_ROUNDS)
    for label, seconds in (
        (f"a buffer joins {frames:,} static frames", joining),
        (f"the clock of {frames:,} moving frames jumps back", jumping),
        (f"events() of {frames:,} frames opens", opening),
    ):
        table.add(label, show(seconds, "ms"), wanted="<= 20 ms")


ROBOTS, PARTS = 64, 20


def test_a_buffer_with_a_prefix_for_each_robot(table: Table) -> None:
    """Each buffer has a history of each robot, so both figures grow with the number of robots."""
    poses = np.tile(Transform().rotation, (PARTS, 1))

    def fleet(buffers: int) -> tuple[Turn, Callable[[], int]]:
        bus = Bus(max_behind=None)
        kept = [Buffer(bus, prefix=f"r{robot}/") for robot in range(buffers)]
        names = [[f"r{robot}/p{part}" for part in range(PARTS)] for robot in range(ROBOTS)]
        ticks = count(START, cases.PERIOD)

        def one_turn() -> float:
            stamp = next(ticks)
            start = perf_counter()
            for robot in names:
                bus.publish_columns(BASE, robot, stamp, np.zeros((PARTS, 3)), poses, AUTHORITY)
            return (perf_counter() - start) / ROBOTS / PARTS

        return one_turn, lambda: sum(buffer.tree.inserted for buffer in kept)

    (one, _), (each, inserted) = fleet(1), fleet(ROBOTS)
    ours, theirs = take_turns(each, one, rounds=FEW_ROUNDS)
    assert inserted() == FEW_ROUNDS * ROBOTS * PARTS * ROBOTS
    table.compare(f"publish to {ROBOTS} buffers with prefixes", ours, "to one", theirs, "<= 0.6 us")


A_LONG_HISTORY = 1_000_000


@pytest.mark.parametrize("keep", [None, A_LONG_HISTORY])
def test_the_longest_pause_of_an_append(table: Table, keep: int | None) -> None:
    """In the time of the processor, because another program may have it for longer. `keep` in ns."""
    edge = FrameHistory("f0", BASE, static=False, keep=keep)
    row = (1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0)
    edge.insert(BASE, 0, row, "")
    longest = 0.0
    for stamp in range(1, 2 * A_LONG_HISTORY):
        start = thread_time()
        edge.append(BASE, stamp, row, "")
        longest = max(longest, thread_time() - start)
    kind = "keep=None" if keep is None else "a window of a million"
    table.add(f"longest append, {kind}", f"{longest * 1e3:.2f} ms", wanted="<= 3 ms")


def hundred_frames(package: Any, *, built: bool) -> Turn:
    """Publishes batches of one sample for each of a hundred frames, `built` before or not: seconds a sample."""
    frames = [f"f{i}" for i in range(HUNDRED)]
    stamps = range(START, START + 20 * cases.PERIOD // 10, cases.PERIOD // 10)
    rotation = Transform.from_axis_angle((1.0, 2.0, 3.0), 0.7).rotation

    def batch(stamp: int) -> list[TransformStamped]:
        stamped, transform = package.TransformStamped, package.Transform
        return [stamped(BASE, frame, stamp, transform((1.0, 2.0, 3.0), rotation), AUTHORITY) for frame in frames]

    ready = [batch(stamp) for stamp in stamps]

    def one_pass() -> float:
        bus = package.Bus()
        buffer = package.Buffer(bus)
        bus.publish(batch(START - 1))
        start = perf_counter()
        for stamp, samples in zip(stamps, ready, strict=True):
            bus.publish(samples if built else batch(stamp))
        seconds = perf_counter() - start
        assert buffer.tree.latest_common_stamp(BASE, frames[-1]) == stamps[-1]
        return seconds / len(stamps) / HUNDRED

    return one_pass


def test_a_hundred_frames_in_each_batch(table: Table) -> None:
    built, whole = take_turns(hundred_frames(tfbus, built=True), hundred_frames(tfbus, built=False))
    table.add("publish 100, each", show(built, "ns"))
    share = f"{median(whole) * A_SECOND:.1%} of a core"
    table.add("100 frames at 1 kHz, built and published", share, wanted="<= 9 %")


@asynccontextmanager
async def crowd(wait: Callable[[int], Any]) -> AsyncIterator[None]:
    """Ten thousand tasks that wait, until the end of the block cancels them."""
    async with anyio.create_task_group() as group:
        for i in range(CROWD):
            group.start_soon(wait, START + 1 + i)
        await anyio.wait_all_tasks_blocked()
        yield
        group.cancel_scope.cancel()


def look_up_a(buffer: Buffer, at: int) -> Awaitable[object]:
    return buffer.lookup(BASE, "a", at, timeout=60.0)


def test_publishing_past_waiters(table: Table) -> None:
    buses = Bus(), Bus()
    buffer, _ = (Buffer(bus) for bus in buses)
    samples = samples_of(tfbus, "b", 1 + ROUNDS * 2_000)
    for bus in buses:
        bus.publish([*samples_of(tfbus, "a", 1), samples[0]])
    rounds: list[list[float]] = []

    async def take_turns() -> None:
        async with crowd(partial(look_up_a, buffer)):
            assert len(buffer.pending()) == CROWD
            for first in range(1, len(samples), 2_000):
                chunk = samples[first : first + 2_000]
                rounds.append([call_with_each(bus.publish, chunk) / len(chunk) for bus in buses])

    anyio.run(take_turns)
    crowded, empty = ([*seconds] for seconds in zip(*rounds, strict=True))
    table.compare("publish on B while 10,000 wait on A", crowded, "none", empty, "<= 1.1")


@pytest.mark.every_loop
def test_cancelling(table: Table, run: Run, anyio_backend: Backend) -> None:
    bus = Bus()
    buffer = Buffer(bus)
    bus.publish(samples_of(tfbus, "a", 1))
    lookups: list[float] = []
    sleepers: list[float] = []

    async def cancel(wait: Callable[[int], Any]) -> float:
        async with crowd(wait):
            start = perf_counter()
        return perf_counter() - start

    async def take_turns() -> None:
        for _ in range(FEW_ROUNDS):
            lookups.append(await cancel(partial(look_up_a, buffer)))
            assert not buffer.pending()
            sleepers.append(await cancel(lambda _: anyio.sleep_forever()))

    run(take_turns)
    table.compare(f"cancel 10,000 waiters, {name_of(anyio_backend)}", lookups, "sleep", sleepers, unit="ms")
