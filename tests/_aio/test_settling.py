import asyncio
import threading
import types
from collections.abc import Awaitable, Callable, Coroutine, Generator
from typing import Any

import anyio
import anyio.lowlevel
import anyio.to_thread
import pytest

from tfbus._aio.loops import settling

pytestmark = [pytest.mark.anyio, pytest.mark.every_loop]

ASYNCIO = [
    pytest.param(("asyncio", {"use_uvloop": uvloop}), id=name) for name, uvloop in (("asyncio", 0), ("uvloop", 1))
]
only_asyncio = pytest.mark.parametrize("anyio_backend", ASYNCIO)


class Log:
    """Tasks that have been set off, and whether all of them have ended."""

    def __init__(self) -> None:
        self.ended = 0

    def end(self) -> None:
        self.ended += 1


async def events(hops: int, log: Log) -> None:
    """Each of many tasks waits for the one before it."""
    async with anyio.create_task_group() as tasks:
        chain = [anyio.Event() for _ in range(hops + 1)]

        async def pass_on(hop: int) -> None:
            await chain[hop].wait()
            chain[hop + 1].set()

        for hop in range(hops):
            tasks.start_soon(pass_on, hop)
        chain[0].set()
        await chain[-1].wait()
    log.end()


async def nested_task_groups(hops: int, log: Log) -> None:
    if hops:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(nested_task_groups, hops - 1, log)
    else:
        log.end()


async def checkpoints(hops: int, log: Log) -> None:
    for _ in range(hops):
        await anyio.lowlevel.checkpoint()
    log.end()


async def streams(hops: int, log: Log) -> None:
    """Each of many tasks sends on what it has received."""
    async with anyio.create_task_group() as tasks:
        ends = [anyio.create_memory_object_stream[int](0) for _ in range(hops + 1)]

        async def send_on(hop: int) -> None:
            await ends[hop + 1][0].send(await ends[hop][1].receive())

        for hop in range(hops):
            tasks.start_soon(send_on, hop)
        await ends[0][0].send(1)
        await ends[-1][1].receive()
        for end in ends:
            end[0].close()
            end[1].close()
    log.end()


async def cancellations(hops: int, log: Log) -> None:
    """Each of many tasks cancels the next one when it is cancelled itself."""
    async with anyio.create_task_group() as tasks:
        scopes = [anyio.CancelScope() for _ in range(hops)]

        async def wait(hop: int) -> None:
            with scopes[hop]:
                await anyio.sleep_forever()
            if hop + 1 < hops:
                scopes[hop + 1].cancel()

        for hop in range(hops):
            tasks.start_soon(wait, hop)
        scopes[0].cancel()
    log.end()


@pytest.mark.parametrize("hops", [1, 2, 100])
@pytest.mark.parametrize("chain", [events, nested_task_groups, checkpoints, streams, cancellations])
async def test_a_chain_has_ended_before_settling_ends(
    chain: Callable[[int, Log], Coroutine[Any, Any, None]], hops: int
) -> None:
    log = Log()
    async with anyio.create_task_group() as tasks:
        for _ in range(3):
            tasks.start_soon(chain, hops, log)
        with settling() as settle:
            await settle()
        assert log.ended == 3


async def test_a_chain_that_is_longer_than_the_count_goes_has_ended_as_well() -> None:
    log = Log()
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(checkpoints, 2_000, log)
        with settling() as settle:
            await settle()
        assert log.ended == 1


async def test_what_is_set_off_after_one_settling_has_ended_before_the_next_one() -> None:
    async with anyio.create_task_group() as tasks:
        with settling() as settle:
            for hops in range(20):
                log = Log()
                tasks.start_soon(events, hops, log)
                await settle()
                assert log.ended == 1


async def test_tasks_that_wait_for_threads_or_real_time_count_as_blocked() -> None:
    release = threading.Event()

    def wait_in_a_thread() -> None:
        release.wait()

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(anyio.to_thread.run_sync, wait_in_a_thread)
        tasks.start_soon(anyio.sleep_forever)
        tasks.start_soon(anyio.sleep, 3_600.0)
        with settling() as settle:
            await settle()
        assert not release.is_set()
        release.set()
        tasks.cancel_scope.cancel()


async def test_settling_may_be_cancelled() -> None:
    async def spin() -> None:
        while True:
            await anyio.lowlevel.checkpoint()

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(spin)
        with settling() as settle, anyio.move_on_after(0.01) as scope:
            await settle()
        assert scope.cancelled_caught
        tasks.cancel_scope.cancel()


async def test_two_tasks_may_settle_at_once() -> None:
    log = Log()
    seen: list[int] = []

    async def settle_often() -> None:
        with settling() as settle:
            for _ in range(10):
                await settle()
                seen.append(log.ended)

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(settle_often)
        tasks.start_soon(settle_often)
        tasks.start_soon(checkpoints, 30, log)
    assert seen == [1] * 20


@types.coroutine
def turns_of(call: Awaitable[None]) -> Generator[Any, Any, int]:
    """The number of times that a call gives way to the loop."""
    steps = call.__await__()
    turns = 0
    while True:
        try:
            step = next(steps)
        except StopIteration:
            return turns
        turns += 1
        yield step


@only_asyncio
@pytest.mark.parametrize("blocked", [0, 100])
async def test_settling_takes_two_turns_if_nothing_goes_on_however_many_tasks_there_are(blocked: int) -> None:
    async with anyio.create_task_group() as tasks:
        for _ in range(blocked):
            tasks.start_soon(anyio.sleep_forever)
        with settling() as settle:
            await settle()
            assert await turns_of(settle()) == 2
        tasks.cancel_scope.cancel()


@only_asyncio
async def test_settling_of_two_tasks_at_once_takes_both_two_turns() -> None:
    turns: list[int] = []

    async def count(settle: Callable[[], Awaitable[None]]) -> None:
        turns.append(await turns_of(settle()))

    with settling() as first, settling() as second:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(count, first)
            tasks.start_soon(count, second)
    # The start of the second task, and the end of the first one, are calls like any other.
    assert all(2 <= each <= 5 for each in turns)


@only_asyncio
@pytest.mark.parametrize("method", ["call_soon", "call_soon_threadsafe"])
async def test_what_a_callback_sets_off_has_ended_before_settling_ends(method: str) -> None:
    loop = asyncio.get_running_loop()
    kept = getattr(loop, method)
    log = Log()

    async def wait(released: anyio.Event) -> None:
        await released.wait()
        log.end()

    async with anyio.create_task_group() as tasks:
        with settling() as settle:
            for times in range(1, 11):
                released = anyio.Event()
                tasks.start_soon(wait, released)
                await settle()
                kept(released.set)
                await settle()
                assert log.ended == times


@only_asyncio
async def test_a_callback_that_calls_itself_for_ever_does_not_keep_settling_from_ending() -> None:
    loop = asyncio.get_running_loop()
    going = True

    def again() -> None:
        if going:
            loop.call_soon(again)

    again()
    with settling() as settle:
        await settle()
    going = False


@only_asyncio
async def test_the_method_of_the_loop_is_the_old_one_afterwards() -> None:
    loop = asyncio.get_running_loop()
    before = loop.call_soon
    with pytest.raises(KeyError), settling() as first:
        with settling() as second:
            await first()
            await second()
        assert loop.call_soon != before
        raise KeyError
    assert loop.call_soon == before
    assert "call_soon" not in vars(loop)


@only_asyncio
async def test_the_order_in_which_two_end_does_not_matter() -> None:
    loop = asyncio.get_running_loop()
    first, second = settling(), settling()
    await first.__enter__()()
    settle = second.__enter__()
    first.__exit__(None, None, None)
    assert await turns_of(settle()) == 2
    second.__exit__(None, None, None)
    assert "call_soon" not in vars(loop)


@only_asyncio
async def test_a_method_that_somebody_else_has_put_there_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    loop = asyncio.get_running_loop()
    called: list[object] = []
    original = loop.call_soon

    def traced(callback: Callable[..., object], *args: Any, **options: Any) -> asyncio.Handle:
        called.append(callback)
        return original(callback, *args, **options)

    monkeypatch.setattr(loop, "call_soon", traced)
    with settling() as settle:
        await settle()
    assert called
    assert loop.call_soon is traced
