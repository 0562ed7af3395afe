"""Random schedules of everything that can happen to a watch, against a slow and obvious model."""

from collections.abc import Awaitable, Callable
from typing import Any

import anyio
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st
from support.asking import Asked
from support.samples import any_samples, moving

from tfbus import (
    SECOND,
    Buffer,
    Bus,
    ClockResetError,
    InvalidTransformError,
    SimulatedClock,
    TransformLookupError,
    TransformStamped,
    TransformTree,
    UnknownFrameError,
    Watch,
)

Run = Callable[[Callable[[], Awaitable[None]]], None]


def x_of(answer: TransformStamped) -> float:
    return answer.transform.translation[0]


def is_change(last: TransformStamped | None, answer: TransformStamped, threshold: float) -> bool:
    if last is None:
        return True
    return abs(x_of(answer) - x_of(last)) >= threshold if threshold else answer != last


class Model:
    """One watch, slow and obvious: it looks at its own tree each time that anything might have happened."""

    def __init__(self, target: str, source: str, threshold: float, period: float) -> None:
        self.tree = TransformTree(None)
        self.target, self.source = target, source
        self.threshold, self.period = threshold, period
        self.last: TransformStamped | None = None
        self.free_at = 0.0
        self.reset = False
        self.ended = False
        self.closed = False

    def read(self, elapsed: float) -> TransformStamped | type[Exception] | None:
        """The answer that a reader has by now; None if it waits."""
        if self.reset:
            return ClockResetError
        if elapsed >= self.free_at or self.ended:
            try:
                answer = self.tree.lookup(self.target, self.source)
            except TransformLookupError:
                pass
            else:
                if is_change(self.last, answer, self.threshold):
                    return answer
        return StopAsyncIteration if self.ended else None

    def note(self, outcome: TransformStamped | type[Exception], elapsed: float) -> None:
        """Take note of what the reader got."""
        if isinstance(outcome, TransformStamped):
            self.last, self.free_at = outcome, elapsed + self.period
        elif outcome is ClockResetError:
            self.reset, self.last, self.free_at = False, None, 0.0


Step = tuple[str, Any]
ANYTHING = st.lists(any_samples("abcd", 9), min_size=1, max_size=3)
# A chain of all frames, so that there often is an answer.
CHAINS = st.tuples(st.integers(0, 9), st.integers(0, 9)).map(
    lambda drawn: [moving("a", "b", drawn[0], float(drawn[1])), moving("b", "c", drawn[0], 1.0)]
)
PUBLISH = (CHAINS | CHAINS | ANYTHING).map(lambda batch: ("publish", batch))
STEPS: st.SearchStrategy[Step] = st.one_of(
    PUBLISH,
    PUBLISH,
    PUBLISH,
    st.just(("read", None)),
    st.just(("read", None)),
    st.just(("read", None)),
    st.just(("cancel", None)) | PUBLISH,
    st.sampled_from("abc").map(lambda frame: ("remove", frame)) | PUBLISH,
    st.just(("jump", None)) | PUBLISH,
    st.sampled_from(["watch", "buffer", "bus"]).map(lambda what: ("close", what)) | PUBLISH | PUBLISH,
)
# A burst happens without a task switch, and then some simulated time passes.
BURSTS = st.lists(
    st.tuples(st.lists(STEPS, min_size=1, max_size=4), st.sampled_from([0.0, 0.25, 1.0])), min_size=3, max_size=20
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    bursts=BURSTS,
    ends=st.permutations("abc").map(lambda frames: frames[:2]),
    threshold=st.sampled_from([0.0, 0.0, 3.0]),
    max_rate=st.sampled_from([None, None, 2.0]),
)
def test_a_reader_gets_what_the_model_says_whatever_happens_meanwhile(
    run: Run, bursts: list[tuple[list[Step], float]], ends: list[str], threshold: float, max_rate: float | None
) -> None:
    async def play() -> None:
        clock = SimulatedClock(100 * SECOND)
        bus = Bus(clock)
        buffer = Buffer(bus, None)
        model = Model(ends[0], ends[1], threshold, 0.0 if max_rate is None else 1.0 / max_rate)
        watch = buffer.watch(*ends, min_translation=threshold, max_rate=max_rate)
        elapsed = 0.0
        asked: Asked[TransformStamped] | None = None

        def check() -> None:
            """Compare how a read has ended, if it has, with the model."""
            nonlocal asked
            if asked is None:
                return
            if asked.ended and asked.cancelled:
                event("cancelled")
                asked = None
                return
            expected = model.read(elapsed)
            if expected is None:
                assert not asked.ended
                return
            if isinstance(expected, TransformStamped):
                assert asked.answer == expected
                event("answer")
            else:
                assert type(asked.error) is expected
                event(expected.__name__)
            model.note(expected, elapsed)
            asked = None

        async with anyio.create_task_group() as tasks:
            for steps, pause in bursts:
                cancelled = False
                for kind, what in steps:
                    if kind == "read" and asked is None and not cancelled:
                        asked = Asked(tasks, watch.__anext__)
                    elif kind == "cancel" and asked is not None:
                        asked.cancel()
                        cancelled = True
                    else:
                        happen(kind, what, clock, bus, buffer, watch, model)
                await clock.advance(0)
                check()
                for _ in range(round(pause / 0.25)):
                    await clock.advance(0.25)
                    elapsed += 0.25
                    check()
            watch.close()
            model.ended = True
            await clock.advance(0)
            check()
            assert asked is None
        assert buffer.pending() == ()

    run(play)


def happen(kind: str, what: Any, clock: SimulatedClock, bus: Bus, buffer: Buffer, watch: Watch, model: Model) -> None:
    """One step, for the real thing and for the model."""
    if model.closed:
        # The last answer may or may not have samples that come after the end.
        return
    deaf = model.ended
    if kind == "publish" and not bus.closed:
        try:
            bus.publish(what)
        except InvalidTransformError:
            return
        if not deaf:
            model.tree.insert_many(what)
    elif kind == "remove" and not bus.closed:
        try:
            bus.remove_frame(what)
        except UnknownFrameError:
            return
        if not deaf and what in model.tree:
            model.tree.remove_frame(what)
    elif kind == "jump":
        clock.set(clock.now() - SECOND)
        if not deaf:
            model.tree.clear()
            model.reset = True
    elif kind == "close":
        close: dict[str, Callable[[], None]] = {"watch": watch.close, "buffer": buffer.close, "bus": bus.close}
        close[what]()
        model.ended = True
        model.closed = what == "watch"
