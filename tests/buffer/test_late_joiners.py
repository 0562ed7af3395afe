"""A buffer that joins late with another one's history, beside one that was there from the start."""

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import anyio
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from support.samples import any_samples, moving, over, static, tree_of, x_of

from tfbus import (
    LATEST,
    SECOND,
    Buffer,
    BufferStatistics,
    Bus,
    BusClosedError,
    InvalidTransformError,
    SimulatedClock,
    TransformLookupError,
    TransformStamped,
    TransformTree,
    UnknownFrameError,
)

pytestmark = pytest.mark.anyio

NANO = 1e-9
FRAMES = "abcd"


@dataclass(frozen=True)
class Publish:
    batch: tuple[TransformStamped, ...]


@dataclass(frozen=True)
class Remove:
    frame: str


@dataclass(frozen=True)
class JumpBack:
    pass


Happening = Publish | Remove | JumpBack

happenings = st.lists(
    st.one_of(
        *[st.builds(Publish, st.lists(any_samples(FRAMES, 12), min_size=1, max_size=4).map(tuple))] * 6,
        st.builds(Remove, st.sampled_from(FRAMES)),
        st.just(JumpBack()),
    ),
    min_size=1,
    max_size=12,
)


def happen(bus: Bus, clock: SimulatedClock, happening: Happening) -> None:
    if isinstance(happening, Publish):
        with suppress(InvalidTransformError):
            bus.publish(happening.batch)
    elif isinstance(happening, Remove):
        with suppress(UnknownFrameError):
            bus.remove_frame(happening.frame)
    else:
        clock.set(clock.now() - 1)


def everything(tree: TransformTree) -> Iterable[object]:
    """All that a tree over the frames can tell."""
    yield tree.frames()
    yield tree.edges()
    for target, source, at in product((*FRAMES, "nobody"), FRAMES, (LATEST, *range(-1, 14))):
        try:
            yield tree.lookup(target, source, at)
        except TransformLookupError as error:
            yield type(error), str(error), str(error.__cause__)


@given(
    happenings,
    happenings,
    st.none() | st.integers(0, 12),
    st.integers(0, 12),
    st.sampled_from(["buffer", "closed buffer", "tree", "late joiner"]),
)
def test_a_late_buffer_with_prefill_answers_as_an_early_one(
    before: list[Happening], after: list[Happening], keep: int | None, further: int, kind: str
) -> None:
    clock = SimulatedClock(1_000)
    bus = Bus(clock)
    seconds = None if keep is None else keep * NANO
    there = Buffer(bus, seconds)
    other = Buffer(bus, None if keep is None else (keep + further) * NANO)
    for happening in before:
        happen(bus, clock, happening)
    prefill: Buffer | TransformTree = other
    if kind == "closed buffer":
        other.close()
    elif kind == "tree":
        prefill = other.tree.copy()
    elif kind == "late joiner":
        prefill = Buffer(bus, other.tree.keep, prefill=other)
    late = Buffer(bus, seconds, prefill=prefill)
    assert list(everything(late.tree)) == list(everything(there.tree))
    for happening in after:
        happen(bus, clock, happening)
    assert list(everything(late.tree)) == list(everything(there.tree))
    counted = bus.statistics().buffers[-1]
    assert counted.offered == counted.inserted + counted.replaced + counted.expired


# Buffers that share a tree


@dataclass(frozen=True)
class Join:
    """A buffer joins: with the history of an earlier one, or with a new one."""

    keep: int
    prefill: int | None


@dataclass(frozen=True)
class Close:
    buffer: int


Step = Happening | Join | Close
steps = st.lists(
    st.one_of(
        st.builds(Publish, st.lists(any_samples(FRAMES, 12), min_size=1, max_size=4).map(tuple)),
        st.builds(Join, st.integers(2, 3), st.none() | st.integers(0, 7)),
        st.builds(Join, st.just(3), st.none()),
        st.builds(Close, st.integers(0, 7)),
        st.builds(Remove, st.sampled_from(FRAMES)),
        st.just(JumpBack()),
    ),
    max_size=24,
)


class Alone:
    """A buffer that is the only one of its bus, on which everything happens as on another bus."""

    def __init__(self, before: list[Happening], keep: int) -> None:
        self.keep = keep
        # All that had happened when the first buffer of the same history joined.
        self.before = before
        self.clock = SimulatedClock(1_000)
        self.bus = Bus(self.clock)
        for happening in before:
            happen(self.bus, self.clock, happening)
        self.buffer = Buffer(self.bus, keep * NANO)

    def catch_up(self, happenings: list[Happening]) -> None:
        for happening in happenings[len(self.before) :]:
            happen(self.bus, self.clock, happening)


# A closed buffer keeps a frame that is removed for those which it shared it with.
@example([Join(3, None), Join(3, None), Publish((moving("a", "b", 1),)), Close(0), Remove("b")])
@given(steps)
def test_buffers_that_share_a_tree_answer_as_each_would_alone(steps: list[Step]) -> None:
    clock = SimulatedClock(1_000)
    bus = Bus(clock)
    happened: list[Happening] = []
    joined: list[tuple[Buffer, Alone]] = []
    open_ones: list[tuple[Buffer, Alone]] = []
    for step in steps:
        if isinstance(step, Join):
            if step.prefill is None or not open_ones:
                pair = Buffer(bus, step.keep * NANO), Alone(list(happened), step.keep)
            else:
                buffer, alone = open_ones[step.prefill % len(open_ones)]
                pair = Buffer(bus, alone.keep * NANO, prefill=buffer), Alone(alone.before, alone.keep)
                pair[1].catch_up(happened)
            joined.append(pair)
            open_ones.append(pair)
        elif isinstance(step, Close):
            if open_ones:
                buffer, alone = open_ones.pop(step.buffer % len(open_ones))
                buffer.close()
                alone.buffer.close()
        else:
            happened.append(step)
            happen(bus, clock, step)
            for _, alone in joined:
                happen(alone.bus, alone.clock, step)
    for buffer, alone in joined:
        assert list(everything(buffer.tree)) == list(everything(alone.buffer.tree))


async def test_buffers_with_prefixes_share_their_samples_and_each_has_its_names_waits_and_end() -> None:
    bus = Bus(SimulatedClock(1_000))
    one, two = (Buffer(bus, prefix=f"r{number}/", shared={"map"}) for number in (1, 2))
    async with anyio.create_task_group() as tasks:
        found: dict[str, TransformStamped] = {}

        async def ask(name: str, buffer: Buffer) -> None:
            with suppress(BusClosedError):
                found[name] = await buffer.lookup("map", "base", 5)

        tasks.start_soon(ask, "one", one)
        tasks.start_soon(ask, "two", two)
        await anyio.wait_all_tasks_blocked()
        assert [len(buffer.pending()) for buffer in (one, two)] == [1, 1]
        assert [counted.waiting for counted in bus.statistics().buffers] == [1, 1]
        two.close()
        await anyio.wait_all_tasks_blocked()
        assert [len(buffer.pending()) for buffer in (one, two)] == [1, 0]
        bus.publish([moving("map", "r1/base", 5, 1.0), moving("map", "r2/base", 5, 2.0)])
    assert {name: answer.child for name, answer in found.items()} == {"one": "base"}
    assert one.lookup_nowait("map", "base").transform.translation == (1.0, 0.0, 0.0)
    assert two.tree.frames() == [], "it was closed before"


# The prefill and the samples of the bus


def test_latched_samples_of_the_bus_are_inserted_after_the_prefill() -> None:
    clock = SimulatedClock()
    bus, elsewhere = Bus(clock), Bus(clock)
    other = Buffer(elsewhere)
    elsewhere.publish([static("base", "laser", 1.0), static("base", "imu", 2.0), *over("base", "arm", (10, 20))])
    bus.publish([static("base", "laser", 5.0), static("base", "arm", 6.0)])
    late = Buffer(bus, prefill=other)
    assert [x_of(late.tree, "base", frame, 15) for frame in ("laser", "imu", "arm")] == [5.0, 2.0, 6.0]


@pytest.mark.parametrize("keep", [10.0, 20.0])
def test_the_counters_of_a_prefilled_buffer_start_with_samples_of_the_bus(bus: Bus, keep: float) -> None:
    first = Buffer(bus)
    bus.publish([*over("map", "a", range(10)), static("a", "laser")])
    late = Buffer(bus, keep, prefill=first)
    # A copy gets the latched samples once more.
    latched = 0 if keep == first.tree.keep else 1
    expected = BufferStatistics(offered=latched, inserted=0, replaced=latched, expired=0, waiting=0)
    assert bus.statistics().buffers[1] == expected
    bus.publish(moving("map", "a", 10))
    assert bus.statistics().buffers[1] == replace(expected, offered=latched + 1, inserted=1)
    assert late.tree.edges() == first.tree.edges()


def test_a_prefill_copies_bus_names_between_buffers_with_prefixes(bus: Bus) -> None:
    first = Buffer(bus)
    bus.publish([moving("map", "robot1/base", 10, 3.0)])
    late = Buffer(bus, prefix="robot1/", shared={"map"}, prefill=first)
    assert late.lookup_nowait("map", "base").transform.translation == (3.0, 0.0, 0.0)
    again = Buffer(bus, prefill=late)
    assert again.lookup_nowait("map", "robot1/base").stamp == 10


# Joining


def test_a_buffer_prefilled_in_a_callback_has_the_current_batch_once(bus: Bus) -> None:
    first = Buffer(bus)
    joined: list[Buffer] = []
    with bus.subscribe(lambda _: joined.append(Buffer(bus, prefill=first))):
        bus.publish(moving("map", "a", 1))
    bus.publish(moving("map", "a", 2))
    assert joined[0].tree.edges()[0].samples == 2
    assert bus.statistics().buffers[1] == BufferStatistics(offered=1, inserted=1, replaced=0, expired=0, waiting=0)


@pytest.mark.parametrize("prefill", [5, "map", [moving("map", "a", 1)]])
def test_a_prefill_that_is_no_buffer_or_tree_is_a_type_error(bus: Bus, prefill: Any) -> None:
    with pytest.raises(TypeError, match="prefill"):
        Buffer(bus, prefill=prefill)
    assert bus.statistics().buffers == ()


def bus_with(*batches: list[TransformStamped]) -> Bus:
    bus = Bus(SimulatedClock(100 * SECOND))
    for batch in batches:
        bus.publish(batch)
    return bus


# Latched samples


def test_buffers_that_begin_with_the_same_latched_samples_go_on_each_by_itself() -> None:
    clock = SimulatedClock(100 * SECOND)
    bus = Bus(clock)
    bus.publish([static("base", "laser", 1.0), static("base", "imu", 2.0)])
    closed, short, long = (Buffer(bus, keep) for keep in (1.0, 2.0, 3.0))
    copied = short.tree.copy()
    closed.close()
    assert short.lookup_nowait("laser", "imu").transform.translation == (1.0, 0.0, 0.0)
    bus.publish([static("base", "laser", 5.0), *over("base", "imu", (90 * SECOND, 92 * SECOND, 93 * SECOND))])
    late = Buffer(bus, 1.0)
    assert [x_of(tree.tree, "base", "laser") for tree in (closed, short, long, late)] == [1.0, 5.0, 5.0, 5.0]
    assert x_of(copied, "base", "laser") == 1.0
    assert [tree.edges()[0].samples for tree in (closed.tree, short.tree, long.tree)] == [1, 2, 3]
    assert (closed.tree.parent("imu"), late.tree.frames()) == ("base", ["base", "laser"])
    clock.set(0)
    bus.remove_frame("laser")
    assert (late.tree.frames(), Buffer(bus).tree.frames(), short.tree.frames()) == ([], [], ["base", "imu"])
    assert x_of(closed.tree, "base", "laser") == 1.0


# Superseded samples


def test_a_late_sample_with_an_old_parent_is_not_the_newest_of_a_buffer_that_missed_the_new_one() -> None:
    bus = Bus(SimulatedClock(100 * SECOND))
    early = Buffer(bus)
    bus.publish(moving("a", "x", 5 * SECOND))
    late = Buffer(bus)
    bus.publish(moving("x", "b", 6 * SECOND))
    bus.publish(moving("b", "x", 4 * SECOND, 7.0))
    assert x_of(early.tree, "b", "x") == 0.0
    assert x_of(late.tree, "b", "x") == 0.0
    counted = bus.statistics().buffers[1]
    assert (counted.offered, counted.inserted, counted.expired, counted.superseded) == (2, 1, 1, 1)


def test_a_late_sample_with_the_newest_parent_is_stored_and_so_is_every_sample_after_the_newest() -> None:
    bus = bus_with([moving("a", "x", 50)])
    late = Buffer(bus)
    bus.publish([moving("a", "x", 40, 4.0), moving("old", "x", 45)])
    assert x_of(late.tree, "a", "x", 40) == 4.0
    assert late.tree.frames() == ["a", "x"]
    bus.publish([moving("a", "x", 50, 5.0), moving("old", "x", 45, 1.0)])
    assert (late.tree.parent("x", 45), late.tree.parent("x")) == ("old", "a")
    assert bus.statistics().buffers[0].superseded == 1


@pytest.mark.parametrize("newer", [moving("b", "x", 60), static("b", "x")])
def test_a_new_parent_ends_the_waiting_for_the_sample_that_was_missed(newer: TransformStamped) -> None:
    bus = bus_with([moving("a", "x", 50)])
    late = Buffer(bus)
    bus.publish([newer, moving("c", "x", 45)])
    assert bus.statistics().buffers[0].superseded == 0
    assert late.tree.parent("x") == ("b" if not newer.static else "c")


def test_a_removed_frame_and_a_jump_back_of_the_clock_supersede_nothing() -> None:
    clock = SimulatedClock(100 * SECOND)
    bus = Bus(clock)
    bus.publish([moving("a", "x", 50), moving("a", "y", 50)])
    late = Buffer(bus)
    bus.remove_frame("x")
    bus.publish(moving("b", "x", 40))
    clock.set(0)
    bus.publish(moving("b", "y", 40))
    assert (late.tree.parent("x"), late.tree.parent("y")) == ("b", "b")
    assert bus.statistics().buffers[0].superseded == 0


# Contradictions between a prefill and the bus


def test_a_prefilled_frame_with_another_newest_parent_than_on_the_bus_is_left_out() -> None:
    bus = bus_with([moving("a", "x", 50), moving("a", "y", 50)])
    late = Buffer(bus, prefill=tree_of(moving("b", "x", 60), moving("a", "y", 40, 3.0), static("b", "z")))
    assert late.tree.frames() == ["a", "b", "y", "z"]
    assert x_of(late.tree, "a", "y", 40) == 3.0
    bus.publish(moving("b", "y", 45))
    assert late.tree.parent("y") == "a"


@pytest.mark.parametrize(("held", "superseded"), [(49, 1), (50, 0), (51, 0)])
def test_a_prefill_with_the_newest_sample_of_the_bus_has_missed_nothing(held: int, superseded: int) -> None:
    bus = bus_with([moving("a", "x", 50)])
    late = Buffer(bus, prefill=tree_of(moving("a", "x", held)))
    bus.publish(moving("old", "x", 45))
    assert late.tree.frames() == (["a", "x"] if superseded else ["a", "old", "x"])
    assert bus.statistics().buffers[0].superseded == superseded


def test_a_prefilled_edge_that_closes_a_loop_with_the_bus_is_removed() -> None:
    bus = bus_with([moving("a", "x", 50), static("x", "y")])
    late = Buffer(bus, prefill=tree_of(moving("y", "a", 40), moving("y", "z", 40)))
    assert [(edge.parent, edge.child) for edge in late.tree.edges()] == [("x", "y"), ("y", "z")]
    bus.publish(moving("z", "p", 60))
    bus.publish(moving("p", "y", 60))
    assert [(edge.parent, edge.child) for edge in late.tree.edges()] == [("z", "p"), ("p", "y")]


def test_a_prefilled_edge_gives_way_to_a_frame_that_is_back_after_a_jump_of_the_clock() -> None:
    clock = SimulatedClock(10)
    bus = Bus(clock)
    bus.publish([moving("c", "b", 5), static("b", "e")])
    late = Buffer(bus, prefill=tree_of(static("d", "c")))
    bus.publish(moving("c", "b", 6))
    clock.set(0)
    bus.publish(moving("e", "d", 1))
    held = {(edge.parent, edge.child) for edge in late.tree.edges() if edge.samples}
    assert held == {("b", "e"), ("d", "c"), ("e", "d")}
    # Under the same parent as before, but a loop by now.
    bus.publish(moving("c", "b", 2))
    held = {(edge.parent, edge.child) for edge in late.tree.edges() if edge.samples}
    assert held == {("b", "e"), ("c", "b"), ("e", "d")}


def test_only_the_prefilled_edges_in_the_loop_are_removed() -> None:
    bus = bus_with()
    late = Buffer(
        bus, prefill=tree_of(*[moving(p, c, 40) for p, c in (("a", "b"), ("b", "c"), ("b", "d"), ("r", "a"))])
    )
    bus.publish(moving("c", "b", 60))
    assert [(edge.parent, edge.child) for edge in late.tree.edges()] == [("r", "a"), ("c", "b"), ("b", "d")]
    # One that the bus has as well keeps its later samples.
    bus = bus_with([moving("a", "b", 50)])
    late = Buffer(bus, prefill=tree_of(moving("a", "b", 90), moving("c", "a", 40)))
    bus.publish(moving("b", "c", 60))
    assert [(edge.parent, edge.child) for edge in late.tree.edges()] == [("a", "b"), ("b", "c")]


@pytest.mark.parametrize("heard", [89, 90, 91])
def test_samples_of_a_prefill_stay_when_the_bus_reparents_later_than_them(heard: int) -> None:
    bus = bus_with([moving("a", "x", 50)])
    late = Buffer(bus, prefill=tree_of(*over("a", "x", (50, 90)), keep=None))
    bus.publish(moving("a", "x", heard))
    bus.publish(moving("b", "x", 95))
    assert [late.tree.parent("x", stamp) for stamp in (50, 94, 95)] == ["a", "a", "b"]
    assert late.tree.edges()[0].samples == len({50, 90, 95, heard})


# Any history
