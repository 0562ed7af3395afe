"""Everything at once and at random, for a while: nothing is left behind, and the books balance all the way."""

from collections import Counter
from collections.abc import Awaitable, Callable
from random import Random

import anyio
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from support.crowd import FRAMES, Crowd, Ending, ask, filter_messages, watch

from tfbus import (
    AheadError,
    AuthorityConflict,
    Buffer,
    BusClosedError,
    ClockReset,
    ClockResetError,
    FrameLive,
    FrameRemoved,
    FrameStale,
    GapError,
    KindChanged,
    LookupTimeoutError,
    PastExtrapolationError,
    Reparented,
    SampleRejected,
    SubscriberFailed,
    UnknownFrameError,
)
from tfbus.testing import simulate

Run = Callable[[Callable[[], Awaitable[None]]], None]

ENDINGS: tuple[Ending, ...] = ("the bus closes", "all is cancelled", "buffers close one by one")
USUAL = (LookupTimeoutError, PastExtrapolationError, GapError, BusClosedError, ClockResetError, UnknownFrameError)
DOCUMENTED = (*USUAL, AheadError)
"""The ends of a lookup other than an answer; the last one is rare."""

MET = {
    "answered",
    "cancelled",
    *(error.__name__ for error in USUAL),
    *("watched", "watch reset", "source failed", "delivered", "removed", "owned"),
    *("too old", "queue full", "timed out", "unknown frame", "clock reset", "closed"),
    *("cycle", "reserved", "not a sample"),
    *("AuthorityConflict", "ClockReset", "SubscriberFailed", "FrameRemoved", "Reparented", "KindChanged"),
    *("FrameStale", "FrameLive"),
}
"""The events that a few soaks meet between them; without them there would be nothing to see."""


async def audit(crowd: Crowd) -> None:
    """Check all books at many moments, until all is over."""
    rng = Random(crowd.seed)
    while True:
        await crowd.pause(rng, 0.5)
        check_books(crowd)


def check_books(crowd: Crowd) -> None:
    """The invariants of every moment."""
    counted = crowd.bus.statistics()
    for its in counted.buffers:
        assert its.offered == its.inserted + its.replaced + its.expired
    assert counted.samples == crowd.accepted
    assert len(crowd.thread.queue) == 0, "what another thread has handed over is published at once"
    # An edge that went to make room for a protected frame had been accepted.
    judged = counted.samples + sum(counted.rejected.values()) - counted.rejected.get("displaced", 0)
    assert crowd.attempted == judged + crowd.thread.queue.dropped
    assert counted.callbacks_failed == crowd.raised
    for ledger in crowd.ledgers:
        ledger.check()
    for pairs in crowd.filters:
        assert pairs.arrived == pairs.delivered + sum(pairs.dropped.values()) + pairs.pending
    if crowd.twin is not None:
        assert crowd.twin.tree.edges() == crowd.plain.tree.edges(), "as if it had been there all along"
    for buffer in crowd.buffers:
        assert buffer.describe()
        assert str(buffer.explain("map", "hand"))


def check_lookups(crowd: Crowd) -> None:
    """Every lookup has ended in an answer or one of the documented errors, or was cancelled."""
    for asked in crowd.asked:
        if isinstance(asked.error, UnknownFrameError):
            assert asked.error.frame.startswith("/"), "any other name may still come"
        if asked.error is not None:
            assert isinstance(asked.error, DOCUMENTED), repr(asked.error)
            crowd.met[type(asked.error).__name__] += 1
        elif asked.cancelled or not asked.ended:
            assert asked.ended or crowd.ending == "all is cancelled"
            crowd.met["cancelled"] += 1
        else:
            crowd.met["answered"] += 1


def check_events(crowd: Crowd) -> None:
    """The streams of events agree with the counters, and with each other."""
    counted = crowd.bus.statistics()
    every, some, stale = (crowd.told[events] for events in (crowd.every, crowd.some, crowd.stale))
    told = Counter(type(event) for event in every)
    rejected = Counter(event.reason for event in every if isinstance(event, SampleRejected))
    assert rejected.keys() == counted.rejected.keys()
    assert rejected <= Counter(counted.rejected), "told no more often than it was counted"
    assert told[SubscriberFailed] == counted.callbacks_failed
    assert told[ClockReset] == counted.clock_resets
    for kind, number in (
        (Reparented, counted.reparented),
        (KindChanged, counted.kind_changes),
        (AuthorityConflict, counted.authority_conflicts),
    ):
        assert told[kind] <= number
        assert (told[kind] > 0) == (number > 0)
    assert len(some) + crowd.some.dropped == len(every)
    there = iter(every)
    assert all(any(event is other for other in there) for event in some)
    crowd.met.update(counted.rejected)
    crowd.met.update(kind.__name__ for kind in map(type, (*every, *stale)))
    gone: set[str] = set()
    for event in stale:
        if isinstance(event, FrameStale):
            assert event.frame not in gone
            gone.add(event.frame)
        elif isinstance(event, FrameLive):
            gone.remove(event.frame)
        elif isinstance(event, FrameRemoved):
            gone.discard(event.frame)
        elif isinstance(event, ClockReset):
            gone.clear()


def check_that_nothing_is_left(crowd: Crowd) -> None:
    """Nobody waits, and nothing remembers anybody who did."""
    counted = crowd.bus.statistics()
    assert counted.queues == ()
    # One was closed on the way.
    assert len(counted.buffers) == (0 if crowd.over else len(crowd.buffers) - 1)
    for buffer in crowd.buffers:
        check_that_nobody_waits(buffer)
    if not crowd.bus.closed:
        for frame in FRAMES:
            crowd.bus.reserve(frame, "somebody else").close()
    crowd.bus.close()
    crowd.jumps.close()
    # No statistics tell of these.
    assert crowd.clock._timers == []
    assert crowd.clock._callbacks == {}


def check_that_nobody_waits(buffer: Buffer) -> None:
    assert buffer.pending() == ()
    # Nor of these.
    live = buffer._live
    assert live.waiting.by_frame == {}
    assert (len(live.watching), live.watching.by_frame) == (0, {})
    assert live._end_callbacks == {}


async def soak(seed: int, ending: Ending) -> Crowd:
    crowd = Crowd(seed, ending)
    before = len(anyio.get_running_tasks())

    async def run() -> None:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(audit, crowd)
            await crowd.run([*[ask] * 3, *[watch] * 3, *[filter_messages] * 3])
            tasks.cancel_scope.cancel()

    await simulate(crowd.clock, run)
    crowd.close_events()
    assert len(anyio.get_running_tasks()) == before
    for ledger in crowd.ledgers:
        await ledger.check_to_the_end()
    for events, told in crowd.told.items():
        told += [event async for event in events]
    check_books(crowd)
    check_lookups(crowd)
    check_events(crowd)
    check_that_nothing_is_left(crowd)
    return crowd


@pytest.mark.anyio
@pytest.mark.thorough
async def test_a_soak_leaves_nothing_behind_and_its_books_balance() -> None:
    await soak(0, "buffers close one by one")


@pytest.mark.thorough
@pytest.mark.anyio
async def test_soaks_that_end_in_every_way_meet_everything_between_them() -> None:
    met = Counter[str]()
    for seed, ending in enumerate(ENDINGS):
        met.update((await soak(seed, ending)).met)
    assert met.keys() >= MET


@pytest.mark.thorough
@settings(
    max_examples=3,
    phases=(Phase.explicit, Phase.reuse, Phase.generate),
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(seed=st.integers(0, 2**32), ending=st.sampled_from(ENDINGS))
def test_a_soak_with_any_seed_balances_its_books(run: Run, seed: int, ending: Ending) -> None:
    async def play() -> None:
        await soak(seed, ending)

    run(play)
