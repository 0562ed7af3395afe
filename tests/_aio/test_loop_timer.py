import math
from collections.abc import Callable
from typing import Any

import anyio
import pytest

from tfbus.buffer.lookups import LoopTimer, running_loop

pytestmark = [pytest.mark.anyio, pytest.mark.every_loop]

PATIENCE = 30.0
"""Real seconds after which a test that hangs is given up."""


class Rung:
    """A timer of the running loop, with the times at which it rang."""

    def __init__(self, then: Callable[[], object] = lambda: None) -> None:
        self.times: list[float] = []
        self._then = then
        self.event = anyio.Event()
        self.timer = LoopTimer(running_loop(), self._ring)

    def _ring(self) -> None:
        self.times.append(self.timer.now())
        self.event.set()
        self._then()

    async def wait(self) -> None:
        with anyio.fail_after(PATIENCE):
            await self.event.wait()
        self.event = anyio.Event()


async def test_a_timer_rings_once_at_each_time_that_is_set() -> None:
    rung = Rung()
    assert rung.timer.due == math.inf
    for count in (1, 2):
        due = rung.timer.now() + 0.002
        rung.timer.set(due)
        assert rung.timer.due == due
        await rung.wait()
        assert rung.timer.due == math.inf
        assert len(rung.times) == count
        # uvloop rounds to milliseconds.
        assert rung.times[-1] >= due - 0.001


@pytest.mark.parametrize(("first", "second"), [(60.0, 0.002), (0.001, 0.004)])
async def test_another_time_takes_the_place_of_the_one_before(first: float, second: float) -> None:
    rung = Rung()
    now = rung.timer.now()
    rung.timer.set(now + first)
    rung.timer.set(now + second)
    await rung.wait()
    assert rung.times[0] >= now + second - 0.001
    await anyio.sleep(0.006)
    assert len(rung.times) == 1


async def test_a_timer_may_be_set_while_it_rings() -> None:
    rung: Any = None
    rung = Rung(lambda: rung.timer.set(rung.timer.now()) if len(rung.times) < 3 else None)
    rung.timer.set(rung.timer.now())
    while len(rung.times) < 3:
        await rung.wait()


async def test_a_timer_that_raises_is_logged_and_goes_on(caplog: pytest.LogCaptureFixture) -> None:
    def fail() -> None:
        if len(rung.times) == 1:
            raise ValueError("broken")

    rung = Rung(fail)
    for _ in range(2):
        rung.timer.set(rung.timer.now())
        await rung.wait()
    assert len(rung.times) == 2
    assert [(record.name, record.message) for record in caplog.records] == [("tfbus", "a timer raised")]
