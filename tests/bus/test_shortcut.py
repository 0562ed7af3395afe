"""The kernel's way is only a shortcut: a bus that a listener keeps from it says and holds the same."""

from contextlib import suppress
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from tfbus import Buffer, Bus, InvalidTransformError, SimulatedClock, Transform, TransformStamped, UnknownFrameError

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
        if not takes:
            # Every batch then goes the ordinary way.
            self.bus.subscribe(len)
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
        with suppress(UnknownFrameError):
            self.bus.remove_frame(frame)

    def state(self) -> object:
        trees = [
            [(edge.child, edge.parent, edge.samples, edge.newest) for edge in buffer.tree.edges()]
            for buffer in self.buffers
        ]
        return self.said, self.bus.statistics(), trees


@given(st.lists(STEPS, max_size=40))
def test_with_and_without_the_shortcut_a_bus_says_and_holds_the_same(steps: list[tuple[str, Any]]) -> None:
    plays = [Play(takes) for takes in (True, False)]
    for play in plays:
        play.many([("map", child, 0, 1.0, "me", False) for child in "ab"])
    for name, argument in steps:
        for play in plays:
            getattr(play, "set" if name == "clock" else name)(argument)
        assert plays[0].state() == plays[1].state()
