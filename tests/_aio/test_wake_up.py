from collections.abc import Callable
from contextlib import suppress

import anyio
import anyio.lowlevel
import pytest
from support.asking import settle

from tfbus.buffer.lookups import wake_up

pytestmark = [pytest.mark.anyio, pytest.mark.every_loop]


class Waiting:
    """A task that waits, and how that ended."""

    def __init__(self) -> None:
        self.woken, self.wake = wake_up()
        self.ended: str = ""

    def end(self) -> None:
        """End the wait, whether it has ended or not."""
        with suppress(Exception):
            self.wake()

    async def run(self) -> None:
        try:
            await self.woken
        except BaseException:
            self.ended = "cancelled"
            raise
        self.ended = "woken"


async def test_the_task_goes_on_once_the_wait_is_ended_and_not_before() -> None:
    waiting = Waiting()
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(waiting.run)
        await settle()
        assert waiting.ended == ""
        waiting.end()
        # Again, before the task has run and after it.
        waiting.end()
        await settle()
        assert str(waiting.ended) == "woken"
        waiting.end()


async def test_a_wait_that_was_ended_before_is_none() -> None:
    waiting = Waiting()
    waiting.end()
    await waiting.run()
    assert waiting.ended == "woken"


async def test_a_cancelled_wait_may_be_ended() -> None:
    waiting = Waiting()
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(waiting.run)
        await settle()
        tasks.cancel_scope.cancel()
    assert waiting.ended == "cancelled"
    waiting.end()
    await settle()


@pytest.mark.parametrize("end_first", [True, False])
async def test_ended_and_cancelled_in_one_turn_the_task_ends_once(end_first: bool) -> None:
    waiting = Waiting()
    with anyio.fail_after(30.0):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(waiting.run)
            await settle()
            steps: list[Callable[[], object]] = [waiting.end, tasks.cancel_scope.cancel]
            for step in steps if end_first else reversed(steps):
                step()
    assert waiting.ended in ("woken", "cancelled")
    await anyio.lowlevel.checkpoint()
