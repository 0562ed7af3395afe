"""Callbacks for batches and removals, and the log, which tells each thing once."""

import logging

import pytest
from support.samples import moving, static

from tfbus import Buffer, Bus, BusClosedError, SimulatedClock, SubscriberFailed, TransformStamped
from tfbus.bus.subscribers import OnceLogger
from tfbus.registration import Registration

Batch = tuple[TransformStamped, ...]


def children(batches: list[Batch]) -> list[str]:
    return [sample.child for batch in batches for sample in batch]


def noting(bus: Bus, log: list[object]) -> Registration:
    """Note the children of each batch, and each frame that is removed."""
    return bus.subscribe(lambda batch: log.append([sample.child for sample in batch]), log.append)


def test_a_subscriber_gets_each_batch_as_a_tuple_until_it_is_closed(bus: Bus) -> None:
    got: list[Batch] = []
    with bus.subscribe(got.append):
        bus.publish(moving("map", "a", 1))
        bus.publish(moving("map", name, 2) for name in "ab")
    bus.publish(moving("map", "a", 3))
    assert got == [(moving("map", "a", 1),), (moving("map", "a", 2), moving("map", "b", 2))]


def test_buffers_have_a_batch_before_subscribers_are_called(bus: Bus) -> None:
    stamps = []
    bus.subscribe(lambda _: stamps.append(buffer.lookup_nowait("map", "a").stamp))
    buffer = Buffer(bus)
    bus.publish(moving("map", "a", 1))
    bus.publish(moving("map", "a", 2))
    assert stamps == [1, 2]


def test_a_late_subscriber_gets_the_latched_static_samples_first(bus: Bus) -> None:
    bus.publish([static("map", "a"), static("map", "b"), moving("map", "c", 1)])
    bus.publish(static("map", "b", x=2.0))
    got: list[Batch] = []
    bus.subscribe(got.append)
    assert [set(batch) for batch in got] == [{static("map", "a"), static("map", "b", x=2.0)}]
    bus.publish(moving("map", "c", 2))
    assert got[1:] == [(moving("map", "c", 2),)]


def test_an_exception_of_a_callback_is_isolated_announced_and_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    bus = Bus(SimulatedClock())
    log: list[object] = []

    def clumsy(_batch: Batch) -> None:
        raise ValueError("spilt the coffee")

    def forgetful(frame: str) -> None:
        raise KeyError(frame)

    bus.subscribe(clumsy, forgetful)
    noting(bus, log)
    with bus.events() as events:
        for stamp in range(3):
            bus.publish(moving("map", "a", stamp))
            bus.remove_frame("a")
        failed = [event for event in iter(events.queue.get, None) if isinstance(event, SubscriberFailed)]
    assert log == [["a"], "a"] * 3
    assert bus.statistics().callbacks_failed == 6
    assert [type(event.error) for event in failed] == [ValueError, KeyError] * 3
    assert all(name in event.subscriber for event, name in zip(failed, ["clumsy", "forgetful"] * 3, strict=True))
    (record,) = caplog.records
    assert (record.name, record.levelno, "clumsy" in record.getMessage()) == ("tfbus", logging.WARNING, True)
    assert record.exc_info is not None
    assert str(record.exc_info[1]) == "spilt the coffee"


def test_a_base_exception_of_a_subscriber_is_raised_and_the_bus_stays_usable(bus: Bus) -> None:
    got: list[Batch] = []

    def interrupted(batch: Batch) -> None:
        got.append(batch)
        if batch[0].stamp == 1:
            raise KeyboardInterrupt

    bus.subscribe(interrupted)
    with pytest.raises(KeyboardInterrupt):
        bus.publish(moving("map", "a", 1))
    bus.publish(moving("map", "a", 2))
    assert [batch[0].stamp for batch in got] == [1, 2]


def test_a_subscriber_that_another_one_closes_is_no_longer_called(bus: Bus) -> None:
    got: list[Batch] = []
    bus.subscribe(lambda _: victim.close())
    victim = bus.subscribe(got.append)
    bus.publish(moving("map", "a", 1))
    assert got == []


def test_a_subscriber_registered_in_a_callback_gets_every_batch_from_the_next_one_on(bus: Bus) -> None:
    got: list[Batch] = []

    def recruit(batch: Batch) -> None:
        if batch[0].child == "a":
            bus.subscribe(got.append)

    bus.subscribe(recruit)
    bus.publish(static("map", "s"))
    bus.publish(moving("map", "a", 1))
    bus.publish(moving("map", "b", 2))
    assert children(got) == ["s", "b"]


def test_a_batch_published_in_a_callback_is_buffered_at_once_and_delivered_after_the_current_one() -> None:
    bus = Bus(SimulatedClock())
    buffer = Buffer(bus)
    echoes = {"a": ["b", "c"], "b": ["d"]}
    first: list[Batch] = []
    last: list[Batch] = []

    def echo(batch: Batch) -> None:
        for child in echoes.get(batch[0].child, []):
            bus.publish(moving("map", child, 1))
            assert buffer.can_transform("map", child, 1)

    bus.subscribe(first.append)
    bus.subscribe(echo)
    bus.subscribe(last.append)
    bus.publish(moving("map", "a", 1))
    assert children(first) == children(last) == ["a", "b", "c", "d"]
    assert bus.statistics().callbacks_failed == 0


def test_a_batch_published_during_registration_reaches_every_subscriber_at_once(bus: Bus) -> None:
    got: list[Batch] = []
    bus.subscribe(got.append)
    bus.publish(static("map", "a"))

    def answer(batch: Batch) -> None:
        if batch[0].child == "a":
            bus.publish(moving("a", "b", 1))

    bus.subscribe(answer)
    assert children(got) == ["a", "b"]


def test_endless_publishing_in_a_callback_is_stopped_by_an_error_that_names_it(
    bus: Bus, caplog: pytest.LogCaptureFixture
) -> None:
    errors: list[RuntimeError] = []

    def chatterbox(batch: Batch) -> None:
        try:
            bus.publish(moving("map", "a", batch[0].stamp + 1))
        except RuntimeError as error:
            errors.append(error)
            raise

    bus.subscribe(chatterbox)
    bus.publish(moving("map", "a", 0))
    (error,) = errors
    assert "chatterbox" in str(error)
    assert bus.statistics().samples == 1_001
    assert bus.statistics().callbacks_failed == 1
    assert len(caplog.records) == 1
    bus.publish(moving("map", "a", 5_000))
    assert len(errors) == 2


def test_a_subscriber_that_closes_the_bus_does_not_stop_the_delivery_of_the_batch(bus: Bus) -> None:
    got: list[Batch] = []
    bus.subscribe(lambda _: bus.close())
    bus.subscribe(got.append)
    bus.publish(moving("map", "a", 1))
    assert got == [(moving("map", "a", 1),)]
    with pytest.raises(BusClosedError):
        bus.publish(moving("map", "a", 2))


@pytest.mark.parametrize("together", [True, False])
def test_a_frame_removed_in_a_callback_is_left_out_for_later_subscribers(bus: Bus, together: bool) -> None:
    front: list[Batch] = []
    behind: list[Batch] = []

    def remove(batch: Batch) -> None:
        front.append(batch)
        if any(sample.child == "b" for sample in batch):
            bus.remove_frame("b")

    bus.subscribe(remove)
    bus.subscribe(behind.append)
    a, b, c = moving("map", "a", 1), static("map", "b"), moving("map", "c", 1)
    bus.publish([a, b] if together else b)
    bus.publish(c)
    assert front == [(a, b) if together else (b,), (c,)]
    assert behind == ([(a,)] if together else []) + [(c,)]


def test_later_subscribers_get_only_static_samples_if_a_callback_sets_the_clock_back() -> None:
    clock = SimulatedClock(start=10)
    bus = Bus(clock)
    got: list[Batch] = []
    bus.subscribe(lambda _: clock.set(clock.now() - 1))
    bus.subscribe(got.append)
    bus.publish(moving("map", "a", 10))
    bus.publish([moving("map", "b", 9), static("map", "s")])
    assert got == [(static("map", "s"),)]


# Removals


def test_removals_are_delivered_in_order_with_the_batches_until_the_subscriber_is_closed(bus: Bus) -> None:
    log: list[object] = []
    with noting(bus, log):
        bus.publish([moving("map", "a", 1), static("map", "b")])
        bus.remove_frame("a")
        bus.publish(moving("map", "a", 1))
        bus.remove_frame("b")
        bus.remove_frame("a")
        bus.publish(moving("map", "c", 1))
    bus.remove_frame("c")
    bus.publish(moving("map", "d", 1))
    assert log == [["a", "b"], "a", ["a"], "b", "a", ["c"]]


def test_the_removal_of_a_frame_that_only_a_buffer_lists_is_delivered() -> None:
    clock = SimulatedClock(start=10)
    bus = Bus(clock)
    buffer = Buffer(bus)
    log: list[object] = []
    noting(bus, log)
    bus.publish(moving("map", "a", 10))
    clock.set(0)
    bus.remove_frame("a")
    assert log == [["a"], "a"]
    assert buffer.tree.frames() == []


@pytest.mark.parametrize("first", [True, False], ids=["in front", "behind"])
def test_a_removal_in_a_callback_is_delivered_between_the_older_and_the_newer_samples(bus: Bus, first: bool) -> None:
    log: list[object] = []
    stamps: list[int] = []

    def replace(batch: Batch) -> None:
        if batch[0].stamp == 1:
            bus.publish(moving("map", "b", 2))
            bus.publish(moving("map", "a", 3))
            bus.remove_frame("a")
            bus.publish(moving("map", "a", 4))

    registrations = [noting(bus, log)] if first else []
    bus.subscribe(replace)
    bus.subscribe(lambda batch: stamps.extend(sample.stamp for sample in batch))
    registrations += [] if first else [noting(bus, log)]
    bus.publish([moving("map", "a", 1), moving("map", "c", 1)])
    before: list[object] = [["a", "c"], "a"] if first else ["a", ["c"]]
    assert log == [*before, ["b"], ["a"]]
    assert stamps == [1, 2, 4]


def test_a_batch_published_in_a_removal_callback_is_delivered_after_the_removal(bus: Bus) -> None:
    logs: list[list[object]] = [[], []]
    noting(bus, logs[0])

    def keep(frame: str) -> None:
        if frame == "a":
            bus.publish(moving("map", "a", 2))
            bus.publish(moving("map", "b", 2))

    bus.subscribe(lambda _: None, keep)
    noting(bus, logs[1])
    bus.publish(moving("map", "a", 1))
    bus.remove_frame("a")
    assert logs[0] == logs[1] == [["a"], "a", ["a"], ["b"]]


def test_a_removal_in_a_removal_callback_is_delivered_to_every_subscriber(bus: Bus) -> None:
    logs: list[list[object]] = [[], []]
    noting(bus, logs[0])
    bus.subscribe(lambda _: None, lambda frame: bus.remove_frame("tool") if frame == "arm" else None)
    noting(bus, logs[1])
    bus.publish([static("map", "arm"), static("arm", "tool")])
    bus.remove_frame("arm")
    assert logs[0] == [["arm", "tool"], "arm", "tool"]
    assert sorted(map(str, logs[1][1:])) == ["arm", "tool"]
    assert bus.statistics().callbacks_failed == 0


def test_a_registration_closed_in_a_removal_callback_ends_both_callbacks(bus: Bus) -> None:
    log: list[object] = []
    other: list[object] = []

    def once(frame: str) -> None:
        log.append(frame)
        registration.close()
        victim.close()

    registration = bus.subscribe(log.append, once)
    victim = noting(bus, other)
    bus.publish([static("map", "a"), static("map", "b")])
    bus.remove_frame("a")
    bus.remove_frame("b")
    bus.publish(moving("map", "c", 1))
    assert log == [(static("map", "a"), static("map", "b")), "a"]
    assert other == [["a", "b"]]


def test_callbacks_must_be_callable_and_not_async() -> None:
    async def callback(frame: object) -> None: ...

    with Bus() as bus:
        for callbacks in (("print",), (print, "print")):
            with pytest.raises(TypeError, match="callable"):
                bus.subscribe(*callbacks)
        with pytest.raises(TypeError, match=r"must not be async.*bus\.stream"):
            bus.subscribe(callback)
        with pytest.raises(TypeError, match="must not be async"):
            bus.subscribe(print, callback)
        bus.publish(moving("map", "a", 1))
        assert bus.statistics().callbacks_failed == 0


LOGGER = logging.getLogger("tests.once")


def test_memory_is_bounded_and_the_oldest_of_a_thousand_keys_is_forgotten_first(
    caplog: pytest.LogCaptureFixture,
) -> None:
    once = OnceLogger(LOGGER)
    for key in range(1_001):
        once.warning(key, "key %d", key)
    caplog.clear()
    once.warning(1_000, "the newest")
    once.warning(1, "the oldest that is remembered")
    once.warning(0, "the forgotten one")
    assert caplog.messages == ["the forgotten one"]


def test_no_argument_begins_a_line_of_its_own(caplog: pytest.LogCaptureFixture) -> None:
    log = OnceLogger(logging.getLogger("tfbus"))
    name = "x\n2026 CRITICAL\x1b[2J"
    log.warning("key", "%s %r %s %d %.1f", name, name, OSError(name), 3, 0.5)
    (record,) = caplog.records
    shown = r"x\n2026 CRITICAL\x1b[2J"
    assert record.getMessage() == f"{shown} '{shown}' {shown} 3 0.5"
    assert record.msg == "%s %r %s %d %.1f"
