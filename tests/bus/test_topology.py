"""Translations that are too long, and stamps that are ahead of the clock or behind it."""

import logging
import math
import re
from typing import Any, TypeVar

import numpy as np
import pytest
from support.samples import moving, static

from tfbus import (
    LATEST,
    SECOND,
    AheadError,
    Buffer,
    Bus,
    FutureExtrapolationError,
    Hold,
    InvalidTransformError,
    PastExtrapolationError,
    PointStamped,
    SimulatedClock,
    StampAhead,
    StampBehind,
    SystemClock,
    Transform,
    TransformStamped,
    TransformTree,
    do_transform,
)
from tfbus.stamps import STAMP_MAX

pytestmark = pytest.mark.anyio

T = TypeVar("T")

HOUR = 3600 * SECOND
NOW = 100 * SECOND


@pytest.fixture
def clock() -> SimulatedClock:
    return SimulatedClock(NOW)


def bus_at(now: int = NOW, **options: Any) -> Bus:
    return Bus(SimulatedClock(now), **options)


def told(kind: type[T], bus: Bus, *samples: TransformStamped) -> list[T]:
    """The events of a kind that a new stream has, with those of samples that are then published one by one."""
    with bus.events() as events:
        for sample in samples:
            bus.publish(sample)
        return [event for event in iter(events.queue.get, None) if isinstance(event, kind)]


# Translations


@pytest.mark.parametrize("known", [False, True])
def test_a_translation_beyond_the_bound_is_refused_at_the_door_of_a_bus(bus: Bus, buffer: Buffer, known: bool) -> None:
    if known:
        bus.publish(moving("a", "b", NOW, 1e12))
    for far in ((1.1e12, 0.0, 0.0), (0.0, -1.1e12, 0.0), (0.0, 0.0, 1e308)):
        with pytest.raises(InvalidTransformError, match="not physical") as caught:
            bus.publish([moving("a", "b", NOW + 1, 1.0), TransformStamped("a", "b", NOW + 2, Transform(far), "peer")])
    assert str(caught.value) == (
        "the translation of 'b' in 'a' is 1e+308 m long, which is not physical (at most 1e+12 m), from 'peer'"
    )
    bus.publish([moving("a", "b", NOW + 3, 2e12), moving("a", "b", NOW + 4, 5.0)], invalid="drop")
    assert bus.statistics().rejected == {"not physical": 4}
    assert buffer.lookup_nowait("a", "b", NOW + 4).transform.translation == (5.0, 0.0, 0.0)
    assert buffer.tree.edges()[0].samples == 1 + known


def test_a_tree_and_its_copy_refuse_what_is_not_physical() -> None:
    tree = TransformTree(max_translation=5.0)
    for each in (tree, tree.copy()):
        with pytest.raises(InvalidTransformError, match="not physical"):
            each.insert_many([moving("a", "b", 0), moving("a", "b", 1, 6.0)])
        assert each.frames() == []
        each.insert(moving("a", "b", 0, 5.0))


def test_every_answer_is_finite_for_a_long_chain_of_edges_at_the_greatest_bound() -> None:
    tree = TransformTree(max_translation=1e100)
    for stamp, sign in ((0, 1.0), (1, -1.0)):
        turned = Transform.from_axis_angle((1.0, 2.0, 3.0), sign * 3.0, (sign * 5e99, 5e99, -5e99))
        tree.insert_many([TransformStamped(f"f{k}", f"f{k + 1}", stamp, turned) for k in range(500)])
    answer = tree.lookup("f0", "f500", 1)
    many = tree.lookup_many("f500", "f0", np.array([0, 1]))
    twist = tree.twist("f500", "f0", 1)
    moved = do_transform(PointStamped("f500", 1, (1e100, -1e100, 1e100)), answer).point
    numbers = (*answer.transform.translation, *many.translations.ravel(), *twist.linear, *twist.angular, *moved)
    assert all(map(math.isfinite, numbers))


# Stamps


def test_a_stamp_ahead_of_the_clock_is_announced_logged_once_and_counted(caplog: pytest.LogCaptureFixture) -> None:
    bus = bus_at()
    assert told(StampAhead, bus, moving("map", "base", NOW + SECOND, authority="odometry")) == []
    assert bus.statistics().ahead == 0
    ahead = [moving("map", "base", NOW + HOUR + k, authority="peer") for k in range(3)]
    assert told(StampAhead, bus, *ahead) == [StampAhead(NOW, "base", NOW + HOUR, "peer")]
    assert bus.statistics().ahead == 3
    assert [record.getMessage() for record in caplog.records if "ahead" in record.getMessage()] == [
        "frame 'base' has a sample from 'peer' that is 3600 s ahead of the clock: right samples are older, and expire"
    ]
    assert told(StampAhead, bus) == [StampAhead(NOW, "base", NOW + HOUR + 2, "peer")]


@pytest.mark.parametrize("beyond", [0, 1])
def test_a_stamp_is_ahead_only_beyond_the_bound(beyond: int) -> None:
    bus = bus_at(max_ahead=2.0)
    buffer = Buffer(bus)
    bus.publish(moving("map", "base", NOW + 2 * SECOND + beyond))
    bus.publish(moving("map", "base", NOW - HOUR))
    counted = bus.statistics()
    assert (counted.ahead, counted.buffers[0].expired, counted.buffers[0].expired_ahead) == (beyond, 1, beyond)
    assert told(StampAhead, bus) == [StampAhead(NOW, "base", NOW + 2 * SECOND + 1, "")] * beyond
    with pytest.raises(PastExtrapolationError) as caught:
        buffer.lookup_nowait("map", "base", NOW - HOUR)
    assert caught.value.ahead == (2 * SECOND + 1) * beyond


def test_what_expires_because_of_a_stamp_ahead_says_so(bus: Bus, buffer: Buffer) -> None:
    bus.publish(moving("map", "base", NOW + HOUR, authority="peer"))
    for k in range(3):
        bus.publish(moving("map", "base", NOW + k, authority="odometry"))
    (counted,) = bus.statistics().buffers
    assert (counted.expired, counted.expired_ahead) == (3, 3)
    with pytest.raises(PastExtrapolationError) as caught:
        buffer.lookup_nowait("map", "base", NOW)
    assert caught.value.ahead == HOUR
    assert str(caught.value).endswith(
        "from 'peer'; its newest stamp is 3600 s ahead of the clock, and right samples expire"
    )
    assert "3600 s ahead  " in str(buffer.explain("map", "base"))
    assert "3600 s ahead of the clock, and right samples expire" in str(buffer.explain("map", "base", NOW))
    assert "3600 s ahead  " in buffer.describe()


def test_a_sample_that_is_late_by_less_than_a_window_is_silent_and_one_that_expires_is_told(
    caplog: pytest.LogCaptureFixture,
) -> None:
    bus = bus_at(max_behind=60.0)
    buffer = Buffer(bus)
    bus.publish([moving("map", "base", NOW), moving("map", "base", NOW - 10 * SECOND)])
    assert (bus.statistics().buffers[0].expired, caplog.records) == (0, [])
    assert told(StampBehind, bus, moving("map", "base", NOW - 20 * SECOND)) == [
        StampBehind(NOW, "base", NOW - 20 * SECOND, NOW, "")
    ]
    (counted,) = bus.statistics().buffers
    assert (counted.expired, counted.expired_ahead) == (1, 0)
    with pytest.raises(PastExtrapolationError) as caught:
        buffer.lookup_nowait("map", "base", NOW - 20 * SECOND)
    assert caught.value.ahead == 0
    assert [record.getMessage() for record in caplog.records] == [
        "frame 'base' has a sample from '' that is 20 s older than the newest, and has expired: it is late, or the "
        "clock of its sender is behind or stands still"
    ]
    assert bus.statistics().behind == 0


class SteppedClock(SystemClock):
    """A clock of the machine that somebody sets back; it announces nothing."""

    step = 0

    def now(self) -> int:
        return NOW + self.step


def test_a_clock_of_the_machine_that_was_set_back_is_told_when_samples_expire(caplog: pytest.LogCaptureFixture) -> None:
    clock = SteppedClock()
    bus = Bus(clock)
    Buffer(bus)
    # The stream is open before: a new one would begin with what is ahead by then.
    with bus.events() as events:
        bus.publish(moving("map", "base", NOW, authority="odometry"))
        clock.step = -HOUR
        bus.publish([moving("map", "base", NOW - HOUR + k, authority="odometry") for k in range(2)])
        found = [event for event in iter(events.queue.get, None) if isinstance(event, StampAhead)]
    assert found == [StampAhead(NOW - HOUR, "base", NOW, "odometry")]
    (line,) = caplog.messages
    assert line.startswith("frame 'base' has a sample from 'odometry' that is 3600 s ahead of the clock")
    assert bus.statistics().buffers[0].expired_ahead == 2


def test_max_age_bounds_the_future_as_well(bus: Bus, buffer: Buffer) -> None:
    bus.publish(moving("map", "base", NOW + 2 * SECOND, authority="peer"))
    assert buffer.lookup_nowait("map", "base", max_age=2.0).stamp == NOW + 2 * SECOND
    with pytest.raises(AheadError) as caught:
        buffer.lookup_nowait("map", "base", max_age=1.5)
    assert (caught.value.child, caught.value.stamp, caught.value.ahead) == ("base", NOW + 3 * SECOND // 2, 2 * SECOND)
    assert isinstance(buffer.explain("map", "base", max_age=1.5).errors[0], AheadError)
    assert buffer.can_transform("map", "base", max_age=9.2e9)


def test_the_edge_that_is_ahead_is_named_the_lagging_one_or_under_a_policy_the_newest(bus: Bus, buffer: Buffer) -> None:
    bus.publish([moving("map", "base", NOW + 2 * SECOND), moving("base", "arm", NOW + 5 * SECOND)])
    for policy, child in ((None, "base"), (Hold(10.0), "arm")):
        with pytest.raises(AheadError) as caught:
            buffer.lookup_nowait("map", "arm", max_age=1.0, extrapolate=policy)
        assert caught.value.child == child


@pytest.mark.every_loop
async def test_an_awaited_lookup_of_an_answer_ahead_fails_at_once_and_a_watch_waits_for_the_clock() -> None:
    clock = SimulatedClock(NOW)
    with Bus(clock) as bus, Buffer(bus) as buffer:
        bus.publish(moving("map", "base", NOW + 5 * SECOND, 5.0))
        with pytest.raises(AheadError):
            await buffer.lookup("map", "base", max_age=1.0)
        with pytest.raises(AheadError):
            await buffer.transform(PointStamped("base", LATEST, (0, 0, 0)), "map", max_age=1.0)
        with buffer.watch("map", "base", max_age=1.0) as changes:
            assert len(buffer.pending()) == 0
            await clock.advance(4.5)
            bus.publish(moving("map", "base", NOW + 9 * SECOND // 2, 4.5))
            assert (await anext(changes)).stamp == NOW + 5 * SECOND


# Stamps behind

WALL = 1_795_560_204 * SECOND
LATE = "it is late, or the clock of its sender is behind or stands still"


@pytest.mark.parametrize("quiet", [True, False])
@pytest.mark.parametrize(
    ("stamp", "words"),
    [
        (WALL // SECOND, "56.9 years behind the clock: seconds passed as nanoseconds?"),
        (WALL // 1_000_000, "56.9 years behind the clock: milliseconds passed as nanoseconds?"),
        (WALL // 1_000, "56.9 years behind the clock: microseconds passed as nanoseconds?"),
        (3617 * SECOND, "56.9 years behind the clock: these look like two clocks (simulated time and wall time?)"),
        (0, "56.9 years behind the clock: a stamp that was never set?"),
        (WALL - 180 * SECOND, f"180 s behind the clock: {LATE}"),
    ],
)
def test_stamps_behind_the_clock_are_announced_logged_once_with_the_likely_cause_and_counted(
    caplog: pytest.LogCaptureFixture, stamp: int, words: str, quiet: bool
) -> None:
    bus = bus_at(WALL)
    buffer = Buffer(bus)
    bus.publish(moving("map", "base", WALL, authority="odometry"))
    late = [moving("map", "base", stamp + k, authority="driver") for k in range(5)]
    if quiet:
        for sample in late:
            bus.publish(sample)
    else:
        assert told(StampBehind, bus, *late) == [StampBehind(WALL, "base", stamp, None, "driver")]
    (counted,) = bus.statistics().buffers
    assert (bus.statistics().behind, counted.expired) == (5, 5)
    assert [record.getMessage() for record in caplog.records if "authorities" not in record.getMessage()] == [
        f"frame 'base' has a sample from 'driver' that is {words}"
    ]
    assert buffer.lookup_nowait("map", "base").stamp == WALL


@pytest.mark.parametrize("beyond", [0, 1])
def test_a_stamp_is_behind_only_beyond_the_bound(beyond: int) -> None:
    bus = bus_at(max_behind=2.0)
    bus.publish(moving("map", "base", NOW - 2 * SECOND - beyond))
    assert bus.statistics().behind == beyond


async def test_a_clock_that_stands_still_and_a_message_that_comes_late_are_noticed_on_a_quiet_bus() -> None:
    clock = SimulatedClock(NOW)
    bus = Bus(clock)
    bus.publish(moving("map", "stopped", NOW))
    bus.publish(moving("map", "late", NOW))
    for _ in range(10):
        await clock.advance(1.0)
        assert told(StampBehind, bus, moving("map", "stopped", NOW)) == []
    await clock.advance(1.0)
    assert [event.at for event in told(StampBehind, bus, moving("map", "stopped", NOW))] == [NOW]
    await clock.advance(180.0)
    last = told(StampBehind, bus, moving("map", "late", NOW + 1))[-1]
    assert (last.frame, last.at, bus.statistics().behind) == ("late", NOW + 1, 2)


def test_a_stream_of_events_that_is_opened_later_hears_of_what_is_still_behind(bus: Bus) -> None:
    bus.publish([moving("map", "late", 0, authority="driver"), moving("map", "was late", 0)])
    bus.publish([moving("map", "late", 5, authority="driver"), moving("map", "was late", NOW)])
    assert told(StampBehind, bus, moving("map", "late", 9, authority="driver")) == [
        StampBehind(NOW, "late", 5, None, "driver")
    ]
    assert told(StampBehind, bus, moving("map", "was late", 9, authority="other")) == [
        StampBehind(NOW, "late", 9, None, "driver"),
        StampBehind(NOW, "was late", 9, None, "other"),
    ]
    assert bus.statistics().behind == 5


def test_late_data_of_a_robot_and_a_short_history_are_silent(bus: Bus, caplog: pytest.LogCaptureFixture) -> None:
    Buffer(bus)
    for late in (0, SECOND // 5, 5 * SECOND):
        bus.publish([moving("map", f"late by {late}", NOW - late + k) for k in range(100)])
    bus.publish(static("base", "lidar", stamp=0))
    assert (caplog.records, bus.statistics().behind, bus.statistics().buffers[0].expired) == ([], 0, 0)


async def test_nothing_is_behind_a_simulated_clock_before_its_first_time(caplog: pytest.LogCaptureFixture) -> None:
    clock = SimulatedClock()
    bus = Bus(clock)
    Buffer(bus)
    for stamp in (WALL, 3617 * SECOND, -HOUR):
        bus.publish(moving("map", "base", stamp))
    assert (caplog.records, bus.statistics().behind) == ([], 0)
    clock.set(WALL)
    bus.publish(moving("map", "base", 3617 * SECOND))
    assert bus.statistics().behind == 1


def test_the_errors_of_a_lookup_between_two_clocks_say_so() -> None:
    tree = TransformTree()
    tree.insert(moving("map", "base", 3617 * SECOND))
    with pytest.raises(FutureExtrapolationError) as caught:
        tree.lookup("map", "base", 1_691_424_773 * SECOND)
    assert str(caught.value) == (
        "frame 'base': asked for 1691424773.000 s, newest sample is 3617.000 s (53.6 years short): these look like two "
        "clocks (simulated time and wall time?)"
    )
    with pytest.raises(PastExtrapolationError, match=re.escape("too early): seconds passed as nanoseconds?")):
        tree.lookup("map", "base", 3617)


def test_the_log_line_and_the_error_of_a_stamp_years_ahead_name_the_likely_cause(
    caplog: pytest.LogCaptureFixture,
) -> None:
    cause = "these look like two clocks (simulated time and wall time?)"
    bus_at(3617 * SECOND).publish(moving("map", "base", WALL))
    assert caplog.messages == [
        "frame 'base' has a sample from '' that is 56.9 years ahead of the clock: right samples are older, and expire; "
        + cause
    ]
    with pytest.raises(InvalidTransformError, match=re.escape(f"ahead of the clock (at most 1 s): {cause}")):
        bus_at(3617 * SECOND, reject_ahead=True).publish(moving("map", "base", WALL))


async def test_a_simulated_clock_counts_from_its_first_move() -> None:
    advanced, jumped = SimulatedClock(), SimulatedClock()
    buses = [Bus(advanced), Bus(jumped)]
    for bus in buses:
        bus.publish(moving("map", "base", HOUR))
    await advanced.advance(1.0)
    jumped.set(0)
    for bus in buses:
        bus.publish(moving("map", "base", 2 * HOUR))
        assert bus.statistics().ahead == 1


def test_a_static_sample_is_never_ahead(caplog: pytest.LogCaptureFixture) -> None:
    bus = bus_at(reject_ahead=True)
    bus.publish(static("map", "base", stamp=NOW + HOUR))
    assert [record for record in caplog.records if record.levelno >= logging.WARNING] == []
    with pytest.raises(InvalidTransformError, match="ahead of the clock"):
        bus.publish(moving("map", "arm", NOW + HOUR))


@pytest.mark.parametrize(
    ("clock", "options"),
    [(SimulatedClock(), {}), (SystemClock(), {"max_ahead": None}), (SimulatedClock(WALL), {"max_behind": None})],
)
def test_a_clock_that_nobody_has_set_and_a_bus_without_a_bound_have_no_stamp_ahead_or_behind(
    caplog: pytest.LogCaptureFixture, clock: SystemClock, options: Any
) -> None:
    bus = Bus(clock, **options)
    stamps = [WALL, 0, 1] if "max_behind" in options else [STAMP_MAX - 10 + k for k in range(3)]
    for stamp in stamps:
        bus.publish(moving("map", f"base {stamp}", stamp))
    assert (caplog.records, bus.statistics().ahead, bus.statistics().behind) == ([], 0, 0)


@pytest.mark.parametrize(
    ("options", "kind"),
    [
        ({"max_ahead": -1.0}, ValueError),
        ({"max_behind": -1.0}, ValueError),
        ({"max_behind": "1"}, TypeError),
        ({"max_ahead": "1"}, TypeError),
        ({"max_ahead": None, "reject_ahead": True}, ValueError),
        ({"max_translation": 0.0}, ValueError),
    ],
)
def test_bounds_that_make_no_sense_are_errors(options: Any, kind: type[Exception]) -> None:
    with pytest.raises(kind):
        Bus(SimulatedClock(), **options)
