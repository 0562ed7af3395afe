"""The speed of tfbus beside its peers: `pytest tests/benchmarks` ends with a table. The default run leaves this out.

Timings on a shared machine drift, so what counts is the ratio of two sides that take turns: the peer has its turn in
the setup of each of pytest-benchmark's rounds. No test asserts a time.
"""

import gc
import tracemalloc
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import asynccontextmanager
from functools import partial
from statistics import median
from time import perf_counter
from typing import Any

import anyio
import anyio.lowlevel
import cases
import pytest
from beside import Ask, Table, build, show
from cases import AUTHORITY, BASE, START, Case, Pass, Vector
from support.both_kernels import COMPILED, tfbus_on

import tfbus
from tfbus import Buffer, Bus, Transform, TransformStamped

pytest_plugins = ["side_by_side"]

ROUNDS = 25
FEW_ROUNDS = 5
HUNDRED = 100
A_SECOND = 100_000
"""The number of samples that a hundred frames have in a second at 1 kHz."""
WAKE_UPS = 200
CROWD = 10_000

Backend = tuple[str, dict[str, Any]]
Run = Callable[[Callable[[], Awaitable[None]]], None]
Calls = Sequence[TransformStamped | Sequence[TransformStamped]]


def publish_all(bus: Bus, calls: Calls) -> float:
    """Seconds in all."""
    return call_with_each(bus.publish, calls)


def call_with_each(call: Callable[[Any], object], calls: Calls) -> float:
    """Seconds in all."""
    start = perf_counter()
    for samples in calls:
        call(samples)
    return perf_counter() - start


def publish_stamped(bus: Bus, parts: list[tuple[int, Transform]], stamped: type[TransformStamped]) -> float:
    """As `publish_all`, with the making of the samples."""
    publish = bus.publish
    start = perf_counter()
    for stamp, transform in parts:
        publish(stamped(BASE, "f0", stamp, transform, AUTHORITY))
    return perf_counter() - start


def insert(kind: str, package: Any = tfbus) -> Pass:
    """One pass on the kernel of this process, or on that of another copy of the package."""
    samples = [build(sample, package) for sample in cases.insertions(kind)]
    parts = [(sample.stamp, sample.transform) for sample in samples]
    calls: Calls = samples
    if kind == "insert batches":
        calls = [samples[i : i + cases.BATCH] for i in range(0, len(samples), cases.BATCH)]

    def one_pass() -> tuple[float, Vector]:
        bus = package.Bus()
        buffer = package.Buffer(bus, cases.KEEP)
        if kind == "insert into the tree":
            tree = package.TransformTree(cases.KEEP)
            return call_with_each(tree.insert, calls) / len(samples), tree.lookup(BASE, "f0").transform.translation
        if kind == "insert stamped":
            seconds = publish_stamped(bus, parts, package.TransformStamped)
        else:
            seconds = publish_all(bus, calls)
        return seconds / len(samples), buffer.lookup_nowait(BASE, "f0").transform.translation

    return one_pass


def lookup(case: Case, package: Any = tfbus) -> Pass:
    """As `insert`."""
    bus = package.Bus()
    buffer = package.Buffer(bus, 2 * cases.KEEP)
    bus.publish(build(sample, package) for sample in cases.history(case.chain))
    stamps = [package.LATEST if case.kind == "lookup latest" else stamp for stamp in cases.questions(case.kind)]
    source = f"f{len(case.chain) - 1}"

    def one_pass() -> tuple[float, Vector]:
        ask = buffer.lookup_nowait
        start = perf_counter()
        for stamp in stamps:
            found = ask(BASE, source, stamp)
        return (perf_counter() - start) / len(stamps), found.transform.translation

    return one_pass


@pytest.mark.parametrize(
    ("label", "case", "wanted"),
    [
        ("publish 1, built beforehand", Case("insert"), "<= 0.4"),
        ("publish 1, stamped in the timing", Case("insert stamped"), "<= 1.0"),
        ("publish 20, each", Case("insert batches"), "<= 1.0"),
        ("lookup, 1 edge", Case("lookup", "m"), "<= 0.07"),
        ("lookup, 3 edges", Case("lookup", "mmm"), "<= 0.08"),
        ("lookup, 10 edges", Case("lookup", "mmmmmmmmmm"), "<= 0.15"),
        ("lookup, 10 edges, 7 of them static", Case("lookup", "msssmsssms"), ""),
        ("lookup LATEST, 1 edge", Case("lookup latest", "m"), ""),
        ("lookup LATEST, 3 edges", Case("lookup latest", "mmm"), ""),
        ("lookup LATEST, 10 edges", Case("lookup latest", "mmmmmmmmmm"), ""),
    ],
)
def test_beside_tf2(benchmark: Any, table: Table, tf2: Ask | str, label: str, case: Case, wanted: str) -> None:
    if isinstance(tf2, str):
        tf2 = f"no tf2 to measure beside ({tf2}); on Debian: apt-get install python3-tf2-ros"
    beside(benchmark, table, tf2, label, case, wanted)


@pytest.mark.parametrize(
    ("label", "case", "wanted"),
    [
        ("lookup in the newest 0.1 s, 10 edges", Case("lookup newest", "m" * 10), "<= 0.15"),
        ("lookup LATEST, 10 edges", Case("lookup latest", "m" * 10), "<= 0.15"),
        ("insert 1 into a tree", Case("insert into the tree"), "<= 0.4"),
        ("publish 1, built beforehand", Case("insert"), "<= 0.4"),
    ],
)
def test_beside_tf2_of_ros_2(
    benchmark: Any, table: Table, tf2_of_ros_2: Ask | str, label: str, case: Case, wanted: str
) -> None:
    if isinstance(tf2_of_ros_2, str):
        pytest.skip(f"no tf2 of ROS 2 to measure beside: {tf2_of_ros_2}")
    beside(benchmark, table, tf2_of_ros_2, f"ROS 2: {label}", case, wanted)


def beside(benchmark: Any, table: Table, tf2: Ask | str, label: str, case: Case, wanted: str) -> None:
    """Measure a case on both kernels beside a tf2, or say why there is none."""

    def passes_on(package: Any) -> Pass:
        return lookup(case, package) if case.chain else insert(case.kind, package)

    other = "python" if tfbus.kernel == "compiled" else "compiled"
    one_pass = passes_on(tfbus)
    other_pass = passes_on(tfbus_on(other)) if other == "python" or COMPILED is not None else None
    others: list[float] = []
    peer: list[float] = []
    expected: list[Vector] = []

    def peers_turn() -> None:
        if other_pass is not None:
            others.append(other_pass()[0])
        if not isinstance(tf2, str):
            seconds, translation = tf2(case)
            peer.append(seconds)
            expected.append(translation)

    ours: list[float] = []

    def our_turn() -> Vector:
        seconds, translation = one_pass()
        ours.append(seconds)
        return translation

    answer = benchmark.pedantic(our_turn, setup=peers_turn, rounds=ROUNDS)
    if isinstance(tf2, str):
        table.add(label, show(ours, "us"), "no tf2")
    else:
        table.compare(label, ours, "tf2", peer, wanted)
    if others:
        table.compare(f"  on the {other} kernel", others, f"the {tfbus.kernel} one", ours)
    if isinstance(tf2, str):
        pytest.skip(tf2)
    assert answer == pytest.approx(expected[-1], abs=1e-6)


def hundred_frames(package: Any, *, built: bool) -> Callable[[], float]:
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


@pytest.mark.parametrize("built", [True, False])
def test_a_hundred_frames_in_each_batch(table: Table, built: bool) -> None:
    """With the making of the samples it is shown as the share of a core that a hundred frames at 1 kHz take."""
    other = "python" if tfbus.kernel == "compiled" else "compiled"
    sides = [hundred_frames(tfbus, built=built)]
    if other == "python" or COMPILED is not None:
        sides.append(hundred_frames(tfbus_on(other), built=built))
    ours, *others = ([*rounds] for rounds in zip(*([side() for side in sides] for _ in range(ROUNDS)), strict=True))
    if built:
        table.add("publish 100, each", show(ours, "ns"))
    else:
        table.add(
            "100 frames at 1 kHz, built and published", f"{median(ours) * A_SECOND:.1%} of a core", wanted="<= 9 %"
        )
    for rounds in others:
        table.compare(f"  on the {other} kernel", rounds, f"the {tfbus.kernel} one", ours, unit="ns")


def loop_name(backend: Backend) -> str:
    return "uvloop" if backend[1] else backend[0]


def moving(child: str, count: int) -> list[TransformStamped]:
    return [TransformStamped(BASE, child, START + i * cases.PERIOD, Transform(), AUTHORITY) for i in range(count)]


async def wake_up(
    wait: Callable[[], Awaitable[object]], waiting: Callable[[], object], wake: Callable[[], object]
) -> float:
    """Seconds from the call of `wake` to the line after `wait`, in a task that was `waiting` by then."""
    woken = 0.0
    done = anyio.Event()

    async def waiter() -> None:
        nonlocal woken
        await wait()
        woken = perf_counter()
        done.set()

    async with anyio.create_task_group() as group:
        group.start_soon(waiter)
        while not waiting():
            await anyio.lowlevel.checkpoint()
        start = perf_counter()
        wake()
        await done.wait()
    return woken - start


WANTED = {"asyncio": ("<= 2.0", "<= 2.3"), "uvloop": ("<= 2.4", "<= 2.8"), "trio": ("<= 2.0", "<= 2.3")}
"""The ratios of a wake-up without and with a timeout."""


@pytest.mark.every_loop
@pytest.mark.parametrize("timeout", [None, 60.0])
def test_wake_up(table: Table, run: Run, anyio_backend: Backend, timeout: float | None) -> None:
    bus = Bus()
    buffer = Buffer(bus)
    samples = iter(moving("a", 1 + ROUNDS * WAKE_UPS))
    bus.publish(next(samples))

    async def by_lookup() -> float:
        sample = next(samples)
        wait = partial(buffer.lookup, BASE, "a", sample.stamp, timeout=timeout)
        return await wake_up(wait, buffer.pending, partial(bus.publish, sample))

    async def by_event() -> float:
        event = anyio.Event()
        return await wake_up(event.wait, lambda: event.statistics().tasks_waiting, event.set)

    lookups: list[float] = []
    events: list[float] = []

    async def take_turns() -> None:
        for _ in range(ROUNDS):
            pairs = [(await by_lookup(), await by_event()) for _ in range(WAKE_UPS)]
            lookups.append(median(ours for ours, _ in pairs))
            events.append(median(peer for _, peer in pairs))

    run(take_turns)
    name = loop_name(anyio_backend)
    with_timeout = timeout is not None
    label = f"wake-up, {name}{', with a timeout' if with_timeout else ''}"
    table.compare(label, lookups, "Event", events, WANTED[name][with_timeout])


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
    samples = moving("b", 1 + ROUNDS * 2_000)
    chunks = (samples[first : first + 2_000] for first in range(1, len(samples), 2_000))
    for bus in buses:
        bus.publish([*moving("a", 1), samples[0]])
    crowded: list[float] = []
    empty: list[float] = []

    async def take_turns() -> None:
        async with crowd(partial(look_up_a, buffer)):
            assert len(buffer.pending()) == CROWD
            for chunk in chunks:
                with_crowd, without = (publish_all(bus, chunk) / len(chunk) for bus in buses)
                crowded.append(with_crowd)
                empty.append(without)

    anyio.run(take_turns)
    table.compare("publish on B while 10,000 wait on A", crowded, "none", empty, "<= 1.1")


@pytest.mark.every_loop
def test_cancelling(table: Table, run: Run, anyio_backend: Backend) -> None:
    bus = Bus()
    buffer = Buffer(bus)
    bus.publish(moving("a", 1))
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
    table.compare(f"cancel 10,000 waiters, {loop_name(anyio_backend)}", lookups, "sleep", sleepers, unit="ms")


def test_memory(table: Table) -> None:
    chain = "m" * 20
    bus = Bus()
    buffer = Buffer(bus)
    tracemalloc.start()
    bus.publish(build(sample) for sample in cases.history(chain))
    gc.collect()
    size, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(buffer.tree.frames()) == len(chain) + 1
    table.add("memory a sample, 1,000 an edge", f"{size / len(chain) / 1_000:.0f} B")
