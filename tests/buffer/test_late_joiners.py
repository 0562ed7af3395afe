"""A buffer that joins late with another one's history, beside one that was there from the start."""

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from itertools import product
from typing import Any

import anyio
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.asking import Asked, settle
from support.samples import any_samples, moving, over, static, tree_of, x_of

from tfbus import (
    LATEST,
    SECOND,
    Buffer,
    BufferStatistics,
    Bus,
    BusClosedError,
    FutureExtrapolationError,
    InvalidTransformError,
    PastExtrapolationError,
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


# What is taken over


def test_a_prefilled_buffer_has_history_static_samples_and_old_parents() -> None:
    bus = Bus(SimulatedClock())
    first = Buffer(bus)
    bus.publish(
        [*over("map", "a", (10, 20)), moving("odom", "a", 30, 7.0), static("a", "laser", 0.5), moving("m", "b", 5)]
    )
    bus.publish(static("map", "odom", 100.0))
    late = Buffer(bus, prefill=first)
    assert x_of(late.tree, "map", "laser", 15) == 15.5
    assert x_of(late.tree, "map", "laser", 25) == 20.5
    assert x_of(late.tree, "map", "laser", 30) == 107.5
    assert late.tree.edges() == first.tree.edges()


def test_without_prefill_a_late_buffer_has_only_latched_samples() -> None:
    bus = Bus(SimulatedClock())
    bus.publish([moving("map", "a", 10), static("a", "laser")])
    assert Buffer(bus).tree.frames() == ["a", "laser"]


def test_a_prefilled_buffer_has_only_the_samples_inside_its_own_window() -> None:
    bus = Bus(SimulatedClock())
    first = Buffer(bus, 100 * NANO)
    bus.publish([*over("map", "a", range(0, 101, 10)), *over("old", "b", (0, 10)), *over("map", "b", (90, 100))])
    late = Buffer(bus, 20 * NANO, prefill=first)
    assert [(edge.child, edge.oldest, edge.samples) for edge in late.tree.edges()] == [("a", 80, 3), ("b", 90, 2)]
    assert late.tree.frames() == ["a", "b", "map"]
    with pytest.raises(PastExtrapolationError):
        late.lookup_nowait("map", "a", 79)


def test_a_prefilled_buffer_with_a_longer_window_keeps_more_from_then_on() -> None:
    bus = Bus(SimulatedClock())
    first = Buffer(bus, 20 * NANO)
    bus.publish(over("map", "a", range(101)))
    late = Buffer(bus, 1_000 * NANO, prefill=first)
    assert late.tree.edges()[0].oldest == 80
    bus.publish(moving("map", "a", 70, 70.0))
    assert (late.tree.edges()[0].oldest, first.tree.edges()[0].oldest) == (70, 80)
    bus.publish(over("map", "a", range(101, 201)))
    assert (late.tree.edges()[0].oldest, first.tree.edges()[0].oldest) == (70, 180)
    assert x_of(late.tree, "map", "a", 75) == 75.0


def test_a_prefilled_buffer_is_independent_of_the_other() -> None:
    clock = SimulatedClock()
    bus, elsewhere = Bus(clock), Bus(clock)
    first = Buffer(elsewhere)
    elsewhere.publish(over("map", "a", (10, 20)))
    late = Buffer(bus, prefill=first)
    elsewhere.publish([moving("map", "a", 15, 1.0), moving("map", "a", 30, 1.0)])
    assert (x_of(late.tree, "map", "a", 15), late.lookup_nowait("map", "a").stamp) == (15.0, 20)
    bus.publish([moving("map", "a", 12, 2.0), moving("map", "a", 40, 2.0)])
    assert (x_of(first.tree, "map", "a", 10), first.lookup_nowait("map", "a").stamp) == (10.0, 30)
    assert x_of(late.tree, "map", "a", 12) == 2.0


def test_latched_samples_of_the_bus_are_inserted_after_the_prefill() -> None:
    clock = SimulatedClock()
    bus, elsewhere = Bus(clock), Bus(clock)
    other = Buffer(elsewhere)
    elsewhere.publish([static("base", "laser", 1.0), static("base", "imu", 2.0), *over("base", "arm", (10, 20))])
    bus.publish([static("base", "laser", 5.0), static("base", "arm", 6.0)])
    late = Buffer(bus, prefill=other)
    assert [x_of(late.tree, "base", frame, 15) for frame in ("laser", "imu", "arm")] == [5.0, 2.0, 6.0]


def test_a_tree_without_a_bus_can_be_the_prefill() -> None:
    tree = tree_of(*over("map", "a", (10, 20)))
    bus = Bus(SimulatedClock())
    late = Buffer(bus, prefill=tree)
    tree.insert(moving("map", "a", 30))
    assert late.lookup_nowait("map", "a").stamp == 20
    bus.publish(moving("map", "a", 40, 60.0))
    assert x_of(late.tree, "map", "a", 30) == 40.0


def test_a_frame_known_only_from_the_prefill_can_be_removed() -> None:
    bus = Bus(SimulatedClock())
    late = Buffer(bus, prefill=tree_of(*over("map", "a", (10, 20))))
    bus.remove_frame("a")
    assert late.tree.frames() == []


def test_the_counters_of_a_prefilled_buffer_start_with_samples_of_the_bus() -> None:
    bus = Bus(SimulatedClock())
    first = Buffer(bus)
    bus.publish([*over("map", "a", range(10)), static("a", "laser")])
    late = Buffer(bus, prefill=first)
    assert bus.statistics().buffers[1] == BufferStatistics(offered=1, inserted=0, replaced=1, expired=0, waiting=0)
    bus.publish(moving("map", "a", 10))
    assert bus.statistics().buffers[1] == BufferStatistics(offered=2, inserted=1, replaced=1, expired=0, waiting=0)
    assert late.tree.edges() == first.tree.edges()


def test_a_prefill_copies_bus_names_between_buffers_with_prefixes() -> None:
    bus = Bus(SimulatedClock())
    first = Buffer(bus)
    bus.publish([moving("map", "robot1/base", 10, 3.0)])
    late = Buffer(bus, prefix="robot1/", shared={"map"}, prefill=first)
    assert late.lookup_nowait("map", "base").transform.translation == (3.0, 0.0, 0.0)
    again = Buffer(bus, prefill=late)
    assert again.lookup_nowait("map", "robot1/base").stamp == 10


# Joining


async def test_lookups_of_a_prefilled_buffer_use_samples_from_before_and_after() -> None:
    bus = Bus(SimulatedClock())
    first = Buffer(bus)
    bus.publish(moving("map", "a", 1 * SECOND, 1.0))
    late = Buffer(bus, prefill=first)
    async with anyio.create_task_group() as tasks:
        asked = Asked(tasks, lambda: late.lookup("map", "a", 2 * SECOND))
        await settle()
        (pending,) = late.pending()
        assert isinstance(pending.blocked_by, FutureExtrapolationError)
        assert pending.blocked_by.newest == SECOND
        bus.publish(moving("map", "a", 3 * SECOND, 3.0))
        await settle()
        assert asked.answer.transform.translation == (2.0, 0.0, 0.0)


def test_a_buffer_prefilled_in_a_callback_has_the_current_batch_once() -> None:
    bus = Bus(SimulatedClock())
    first = Buffer(bus)
    joined: list[Buffer] = []
    with bus.subscribe(lambda _: joined.append(Buffer(bus, prefill=first))):
        bus.publish(moving("map", "a", 1))
    bus.publish(moving("map", "a", 2))
    assert joined[0].tree.edges()[0].samples == 2
    assert bus.statistics().buffers[1] == BufferStatistics(offered=1, inserted=1, replaced=0, expired=0, waiting=0)


@pytest.mark.parametrize("prefill", [5, "map", [moving("map", "a", 1)]])
def test_a_prefill_that_is_no_buffer_or_tree_is_a_type_error(prefill: Any) -> None:
    bus = Bus(SimulatedClock())
    with pytest.raises(TypeError, match="prefill"):
        Buffer(bus, prefill=prefill)
    assert bus.statistics().buffers == ()


def test_a_buffer_on_a_closed_bus_is_an_error() -> None:
    bus = Bus(SimulatedClock())
    first = Buffer(bus)
    bus.close()
    with pytest.raises(BusClosedError):
        Buffer(bus, prefill=first)
