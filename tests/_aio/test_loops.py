"""Waking a loop from threads, letting all tasks settle, and waiting for the ends of threads and task groups."""

import asyncio
import gc
import queue
import threading
import types
import weakref
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Generator
from contextlib import suppress
from functools import partial
from threading import Event, Thread
from typing import Any

import anyio
import anyio.lowlevel
import anyio.to_thread
import outcome
import pytest
import trio
from support.asking import settle

from tfbus._aio.loops import LoopWaker, asleep, join_all, running_loop, settling, wait_for_all, wake_up
from tfbus._aio.task_groups import close_task_group
from tfbus._aio.turn_budget import TurnBudget

pytestmark = [pytest.mark.anyio, pytest.mark.every_loop]

Run = Callable[[Callable[[], Awaitable[None]]], None]

PATIENCE = 30.0
"""Real seconds after which a test that hangs is given up."""


async def test_a_callback_that_raises_is_logged_and_ends_nothing(caplog: pytest.LogCaptureFixture) -> None:
    answers: list[int] = []
    waker = LoopWaker(lambda: answers.append(1 // len(answers)))
    waker.bind()
    waker.wake()
    await settle()
    assert [record.exc_info[0] for record in caplog.records if record.exc_info] == [ZeroDivisionError]
    answers.append(0)
    waker.wake()
    await settle()
    assert answers == [0, 1]


async def test_requests_of_work_on_the_loop_are_answered_at_its_end_and_later_ones_later() -> None:
    done: list[str] = []
    waker = LoopWaker(lambda: done.append("answer"))
    waker.bind()

    def work() -> None:
        waker.wake()
        thread = Thread(target=waker.wake)
        thread.start()
        thread.join()
        done.append("work")

    waker.answer(work)
    assert done == ["work", "answer"]
    with pytest.raises(ZeroDivisionError):
        waker.answer(lambda: 1 // 0)
    waker.wake()
    assert len(done) == 3
    await settle()
    assert len(done) == 4


async def test_a_callback_that_wakes_again_is_called_again_and_gives_tasks_their_turn() -> None:
    calls: list[None] = []

    def call() -> None:
        calls.append(None)
        if len(calls) < 100:
            waker.wake()

    waker = LoopWaker(call)
    waker.bind()
    waker.wake()
    for _ in range(5):
        await anyio.lowlevel.checkpoint()
    assert 1 < len(calls) < 100


def test_a_request_is_answered_though_the_loop_ends_and_the_loop_is_not_kept(run: Run) -> None:
    answers: list[int] = []
    loops: list[weakref.ref[object]] = []

    async def serve() -> None:
        loops.append(weakref.ref(running_loop()))
        for number in range(2):
            waker = LoopWaker(partial(answers.append, number))
            waker.bind()
            waker.wake()

    run(serve)
    assert answers == [0, 1]
    gc.collect()
    assert loops[0]() is None


def test_a_request_is_answered_while_trio_ends_and_where_it_is_the_guest_of_another_loop() -> None:
    answers: list[None] = []
    woken = trio.Event()
    guest, end = LoopWaker(woken.set), LoopWaker(partial(answers.append, None))
    turns: queue.SimpleQueue[Callable[[], object]] = queue.SimpleQueue()
    outcomes: list[outcome.Outcome[None]] = []

    async def late() -> AsyncIterator[None]:
        try:
            yield
        finally:
            # Trio ends it behind all tasks.
            end.wake()

    generator = late()

    async def serve() -> None:
        guest.bind()
        end.bind()
        await anext(generator)
        # The host wakes it, outside of all tasks.
        turns.put(guest.wake)
        with trio.fail_after(PATIENCE):
            await woken.wait()

    trio.lowlevel.start_guest_run(serve, run_sync_soon_threadsafe=turns.put, done_callback=outcomes.append)
    while not outcomes:
        turns.get(timeout=PATIENCE)()
    outcomes[0].unwrap()
    assert answers == [None]


async def test_a_sleep_that_was_cancelled_may_be_ended_afterwards() -> None:
    sleep, end = wake_up(running_loop())
    with anyio.CancelScope() as scope:
        scope.cancel()
        await asleep(sleep)
    with suppress(Exception):
        end()
    await anyio.lowlevel.checkpoint()
    assert scope.cancelled_caught


def test_waking_in_a_thread_while_the_loop_ends_raises(run: Run) -> None:
    waker = LoopWaker(list)
    begun = threading.Event()
    errors: list[Exception] = []

    def keep_waking() -> None:
        while not errors:
            try:
                waker.wake()
            except RuntimeError as error:
                errors.append(error)
            begun.set()

    thread = threading.Thread(target=keep_waking)

    async def serve() -> None:
        waker.bind()
        thread.start()
        assert begun.wait(PATIENCE)

    run(serve)
    thread.join(PATIENCE)
    assert not thread.is_alive()


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


@pytest.mark.parametrize("hops", [1, 2, 100])
@pytest.mark.parametrize("chain", [nested_task_groups, checkpoints])
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


async def test_threads_are_waited_for_until_they_end_or_the_time_is_over() -> None:
    may_end = Event()
    stuck, ended = Thread(target=may_end.wait), Thread(target=may_end.is_set)
    for thread in (stuck, ended):
        thread.start()
    assert not await wait_for_all([stuck, ended], 0.01)
    with anyio.CancelScope() as scope:
        # The end of a cancelled task waits too.
        scope.cancel()
        assert await wait_for_all([ended], 60.0)
    assert not scope.cancelled_caught
    join_all([stuck], 0.0)
    assert stuck.is_alive()
    may_end.set()
    assert await wait_for_all([stuck, ended], 60.0)
    assert await wait_for_all([], 0.0)


async def gives_way(budget: TurnBudget) -> bool:
    """Whether it passes a checkpoint, where a cancelled task ends."""
    with anyio.CancelScope() as scope:
        scope.cancel()
        await budget.give_way()
    return scope.cancelled_caught


async def test_work_gives_way_once_its_time_is_spent_and_not_before() -> None:
    now = 0.0
    budget = TurnBudget(2.0, lambda: now, lambda: now)
    now = 1.5
    assert not budget.spent
    assert not await gives_way(budget)
    now = 2.0
    assert budget.spent
    assert await gives_way(budget)
    await budget.give_way()
    now = 3.5
    assert not await gives_way(budget)
    budget.begin()
    now = 5.0
    assert not budget.spent
    now = 5.5
    assert budget.spent


def test_the_time_in_which_a_thread_waits_for_a_processor_does_not_count() -> None:
    now = busy = 0.0
    budget = TurnBudget(2.0, lambda: now, lambda: busy)
    now, busy = 50.0, 1.5
    assert not budget.spent
    now = 50.4
    assert not budget.spent
    now, busy = 50.5, 1.9
    assert not budget.spent
    busy = 2.0
    now = 50.7
    assert budget.spent


async def fail(error: BaseException) -> None:
    raise error


async def close_with(*errors: BaseException) -> None:
    """Close a group whose tasks raise these errors in one turn of the loop."""
    tasks = anyio.create_task_group()
    await tasks.__aenter__()
    for error in errors:
        tasks.start_soon(fail, error)
    await close_task_group(tasks)


@pytest.mark.parametrize("in_one_task", [True, False])
async def test_a_group_that_one_task_raises_and_the_errors_of_several_tasks_are_a_group(in_one_task: bool) -> None:
    errors = [KeyError("a"), ValueError("b")]
    with pytest.raises(ExceptionGroup) as caught:
        await close_with(*([ExceptionGroup("own", errors)] if in_one_task else errors))
    assert {*caught.value.exceptions} == {*errors}


async def test_a_callback_of_another_thread_may_start_and_cancel_tasks() -> None:
    began, scope = anyio.Event(), anyio.CancelScope()

    async def wait() -> None:
        with scope:
            began.set()
            await anyio.sleep_forever()

    async with anyio.create_task_group() as tasks:
        start = LoopWaker(lambda: tasks.start_soon(wait))
        cancel = LoopWaker(scope.cancel)
        for waker in (start, cancel):
            waker.bind()
        for waker in (start, cancel):
            thread = threading.Thread(target=waker.wake)
            thread.start()
            await anyio.to_thread.run_sync(thread.join)
            with anyio.fail_after(5.0):
                await began.wait()
