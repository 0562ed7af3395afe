import logging
import math
from collections.abc import Iterator
from functools import partial

import anyio
import pytest
from support.asking import Asked, settle
from support.samples import moving

from tfbus import LATEST, SECOND, Buffer, Bus, Question, SimulatedClock, UnknownFrameError
from tfbus.buffer._hanging_report import HangingReport
from tfbus.waiting.waiting_index import Waiter, WaitingIndex


@pytest.fixture(autouse=True)
def warnings(caplog: pytest.LogCaptureFixture) -> Iterator[None]:
    with caplog.at_level(logging.WARNING, "tfbus"):
        yield


def waiting_for(index: WaitingIndex, *frames: str, since: int = 0) -> None:
    for frame in frames:
        index.park(Waiter(Question("map", frame, LATEST), since, list), UnknownFrameError(frame=frame))


def tell(report: HangingReport, frame: str, since: int = 0) -> float:
    return report.tell(Question("map", frame, LATEST), since, UnknownFrameError(frame=frame))


def test_one_line_tells_of_all_that_hang_and_names_three(caplog: pytest.LogCaptureFixture) -> None:
    clock, index = SimulatedClock(5 * SECOND), WaitingIndex()
    waiting_for(index, "b", "b", "c", "d", "e")
    waiting_for(index, "young", since=1)
    report = HangingReport(index, clock)
    assert tell(report, "a") == math.inf
    assert caplog.messages == [
        "5 lookups have waited for more than 5 s: 'a' in 'map': frame 'a' is not known; 'b' in 'map': frame 'b' is not "
        "known; 'c' in 'map': frame 'c' is not known; and 2 more, see Buffer.pending()"
    ]
    assert [tell(report, frame) for frame in "abcde"] == [math.inf] * 5
    assert len(caplog.messages) == 1


def test_a_new_cause_is_told_once_some_seconds_have_passed(caplog: pytest.LogCaptureFixture) -> None:
    clock = SimulatedClock(5 * SECOND)
    report = HangingReport(WaitingIndex(), clock)
    assert tell(report, "a") == math.inf
    assert tell(report, "b") == 5.0
    clock.set(7 * SECOND)
    assert tell(report, "b") == 3.0
    clock.set(10 * SECOND)
    assert tell(report, "b") == math.inf
    clock.set(20 * SECOND)
    assert tell(report, "b") == math.inf
    assert caplog.messages == [
        f"a lookup of {frame!r} in 'map' has waited for more than 5 s: frame {frame!r} is not known" for frame in "ab"
    ]


def test_a_jump_back_of_the_clock_delays_no_report(caplog: pytest.LogCaptureFixture) -> None:
    clock = SimulatedClock(1_000 * SECOND)
    report = HangingReport(WaitingIndex(), clock)
    tell(report, "a")
    clock.set(SECOND)
    assert tell(report, "b") == math.inf
    assert len(caplog.messages) == 2


@pytest.mark.anyio
async def test_a_thousand_lookups_that_hang_look_for_the_similar_names_of_three(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked_for: list[str] = []

    def close_matches(frame: str, known: tuple[str, ...]) -> tuple[str, ...]:
        looked_for.append(frame)
        return known[-1:]

    monkeypatch.setattr("tfbus.errors._close_matches", close_matches)
    clock = SimulatedClock()
    with Bus(clock) as bus, Buffer(bus) as buffer:
        bus.publish(moving("map", "base", 0))
        async with anyio.create_task_group() as tasks:
            asked = [
                Asked(tasks, partial(buffer.lookup, "map", f"wrong {number}", timeout=60.0)) for number in range(1_000)
            ]
            await settle()
            await clock.advance(30.0)
            (message,) = caplog.messages
            assert message.startswith("1000 lookups have waited for more than 5 s: ")
            assert message.endswith("; and 997 more, see Buffer.pending()")
            assert len(looked_for) == 3
            looked_for.clear()
            described = buffer.describe().splitlines()
            assert described[-1] == "waiting: 990 more lookups, see pending()"
            assert 0 < len(looked_for) <= 10
            looked_for.clear()
            await clock.advance(31.0)
    assert all("did you mean" not in repr(each.error.args) for each in asked if each.error is not None)
    assert looked_for == []
    assert "did you mean 'base'?" in str(asked[0].error)
