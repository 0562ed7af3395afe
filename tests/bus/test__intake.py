"""The intake is only a faster way: with it and without it, a bus and its buffers hold the same."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import tfbus
from tfbus import Buffer, Bus, BusClosedError, InvalidTransformError, SimulatedClock, Transform, TransformStamped

SAMPLES = st.tuples(
    st.sampled_from(["map", "map", "map", "a"]),
    st.sampled_from("ab"),
    st.integers(0, 9),
    st.sampled_from([1.0, 1.0, 1.0, 1e13]),
    st.sampled_from(["me", "me", "me", "you"]),
    st.sampled_from([False, False, False, False, True]),
)
STEPS = st.one_of(
    st.tuples(st.just("one"), SAMPLES),
    st.tuples(st.just("one"), SAMPLES),
    st.tuples(st.just("many"), st.lists(SAMPLES, max_size=4)),
    st.tuples(st.just("drop"), st.lists(SAMPLES, max_size=4)),
    st.tuples(st.just("buffer"), st.booleans()),
    st.tuples(st.just("subscribe"), st.booleans()),
    st.tuples(st.just("clock"), st.integers(0, 9)),
    st.tuples(st.just("remove"), st.sampled_from("ab")),
)


def sample(drawn: tuple[Any, ...]) -> TransformStamped:
    parent, child, stamp, x, authority, static = drawn
    return TransformStamped(parent, child, stamp, Transform((x, 0.0, 0.0)), authority, static)


class Play:
    """A bus with buffers that come and go, and what it said."""

    def __init__(self, takes: bool) -> None:
        self.clock = SimulatedClock()
        self.bus = Bus(self.clock, max_ahead=2e-9, reject_ahead=True)
        self.bus._intake.open = takes
        self.buffers = [Buffer(self.bus)]
        self.said: list[object] = []
        self.subscriptions: list[Any] = []

    def publish(self, samples: Any, invalid: Any = "raise") -> None:
        try:
            self.bus.publish(samples, invalid)
        except InvalidTransformError as error:
            self.said.append(str(error))

    def one(self, drawn: tuple[Any, ...]) -> None:
        if drawn[0] != drawn[1]:
            self.publish(sample(drawn))

    def many(self, drawn: list[tuple[Any, ...]]) -> None:
        self.publish([sample(each) for each in drawn if each[0] != each[1]])

    def drop(self, drawn: list[tuple[Any, ...]]) -> None:
        self.publish(tuple(sample(each) for each in drawn if each[0] != each[1]), "drop")

    def buffer(self, comes: bool) -> None:
        if comes:
            self.buffers.append(Buffer(self.bus))
        elif self.buffers:
            self.buffers.pop().close()

    def subscribe(self, comes: bool) -> None:
        if comes:
            self.subscriptions.append(self.bus.subscribe(self.said.append))
        elif self.subscriptions:
            self.subscriptions.pop().close()

    def set(self, stamp: int) -> None:
        self.clock.set(stamp)

    def remove(self, frame: str) -> None:
        if frame in self.bus._topology:
            self.bus.remove_frame(frame)

    def state(self) -> object:
        trees = [
            [(edge.child, edge.parent, edge.samples, edge.newest) for edge in buffer.tree.edges()]
            for buffer in self.buffers
        ]
        return self.said, self.bus.statistics(), trees


@given(st.lists(STEPS, max_size=40))
def test_with_and_without_the_intake_a_bus_says_and_holds_the_same(steps: list[tuple[str, Any]]) -> None:
    plays = [Play(takes) for takes in (True, False)]
    for play in plays:
        play.many([("map", child, 0, 1.0, "me", False) for child in "ab"])
    for name, argument in steps:
        for play in plays:
            getattr(play, "set" if name == "clock" else name)(argument)
        assert plays[0].state() == plays[1].state()


def test_the_kernel_that_runs_takes_and_counts_what_is_published() -> None:
    with Bus() as bus, Buffer(bus) as buffer:
        module = type(bus._intake).__module__
        assert module == ("tfbus._kernel" if tfbus.kernel == "compiled" else "tfbus.bus._python_intake")
        for stamp in range(5):
            bus.publish(TransformStamped("map", "a", stamp, Transform()))
        assert bus.statistics().samples == buffer.tree.edges()[0].samples == 5
        before = bus._topology.accept
        bus._topology.accept = fail  # type: ignore[method-assign, assignment]
        bus.publish(TransformStamped("map", "a", 5, Transform()))
        bus._topology.accept = before  # type: ignore[method-assign]
        assert bus.statistics().samples == 6
    with pytest.raises(BusClosedError):
        bus.publish(TransformStamped("map", "a", 6, Transform()))


def fail(_batch: object, _invalid: object) -> None:
    raise AssertionError("a plain batch was judged closely")
