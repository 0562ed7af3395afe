import asyncio
import sys
import threading
from collections.abc import Awaitable, Callable

import anyio
import anyio.to_thread
import pytest
from support.asking import settle

from tfbus._aio.loop_waker import LoopWaker

pytestmark = [pytest.mark.anyio, pytest.mark.every_loop]

Run = Callable[[Callable[[], Awaitable[None]]], None]

PATIENCE = 30.0
"""Real seconds after which a test that hangs is given up."""


class CountedWaker:
    """A waker with the number of its calls, and an event for the next call."""

    def __init__(self) -> None:
        self.waker = LoopWaker(self._answer)
        self.calls = 0
        self.threads: set[int] = set()
        self.called = anyio.Event()

    def _answer(self) -> None:
        self.calls += 1
        self.threads.add(threading.get_ident())
        self.called.set()


async def test_a_thread_wakes_an_idle_loop() -> None:
    counted = CountedWaker()
    assert not counted.waker.bound
    counted.waker.bind()
    assert counted.waker.bound
    for requests in range(1, 4):
        counted.called = anyio.Event()
        with anyio.fail_after(PATIENCE):
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(anyio.to_thread.run_sync, counted.waker.wake)
                await counted.called.wait()
        assert counted.calls == requests
    assert counted.threads == {threading.get_ident()}


async def test_the_callback_runs_soon_and_once_for_many_requests() -> None:
    counted = CountedWaker()
    counted.waker.bind()
    for _ in range(1_000):
        counted.waker.wake()
    assert counted.calls == 0
    await settle()
    assert counted.calls == 1
    await settle()
    assert counted.calls == 1


async def test_a_request_during_the_callback_leads_to_another_call() -> None:
    answers: list[int] = []

    def answer() -> None:
        answers.append(len(answers))
        if len(answers) < 5:
            waker.wake()
            waker.wake()

    waker = LoopWaker(answer)
    waker.bind()
    waker.wake()
    await settle()
    assert answers == [0, 1, 2, 3, 4]


async def test_every_item_queued_before_a_wake_is_processed() -> None:
    queue: list[int] = []
    taken: list[int] = []
    everything = anyio.Event()

    def answer() -> None:
        while queue:
            taken.append(queue.pop())
        if len(taken) == 8_000:
            everything.set()

    waker = LoopWaker(answer)
    waker.bind()

    def produce() -> None:
        for number in range(2_000):
            queue.append(number)
            waker.wake()

    threads = [threading.Thread(target=produce) for _ in range(4)]
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with anyio.fail_after(PATIENCE):
            for thread in threads:
                thread.start()
            # No more requests come that could wake the loop for what it has overlooked.
            await everything.wait()
    finally:
        sys.setswitchinterval(interval)
        for thread in threads:
            thread.join(PATIENCE)
    assert len(taken) == 8_000


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


def test_an_unbound_waker_raises() -> None:
    with pytest.raises(RuntimeError, match="bind the waker"):
        LoopWaker(lambda: None).wake()


def test_binding_without_an_event_loop_raises() -> None:
    counted = CountedWaker()
    with pytest.raises(RuntimeError):
        counted.waker.bind()
    assert not counted.waker.bound


@pytest.mark.parametrize("requests", [0, 1])
def test_every_wake_after_the_end_of_the_loop_raises(run: Run, requests: int) -> None:
    counted = CountedWaker()

    async def leave_with_unanswered_requests() -> None:
        counted.waker.bind()
        for _ in range(requests):
            counted.waker.wake()

    run(leave_with_unanswered_requests)
    calls = counted.calls
    for _ in range(3):
        with pytest.raises(RuntimeError):
            counted.waker.wake()
    assert counted.calls == calls


@pytest.mark.parametrize("requests", [0, 1])
def test_a_waker_may_be_bound_to_a_later_loop(run: Run, requests: int) -> None:
    counted = CountedWaker()

    async def leave_with_unanswered_requests() -> None:
        counted.waker.bind()
        for _ in range(requests):
            counted.waker.wake()

    async def answer() -> None:
        counted.waker.bind()
        before = counted.calls
        counted.waker.wake()
        await settle()
        assert counted.calls == before + 1

    run(leave_with_unanswered_requests)
    for _ in range(2):
        run(answer)


def test_a_wake_that_a_closed_loop_never_answered_makes_the_next_one_raise_until_the_waker_is_bound_again() -> None:
    counted = CountedWaker()

    async def connect() -> None:
        counted.waker.bind()

    for _ in range(2):
        native = asyncio.new_event_loop()
        native.run_until_complete(connect())
        counted.waker.wake()
        native.close()
        for _ in range(2):
            with pytest.raises(RuntimeError):
                counted.waker.wake()
        assert counted.calls == 0

    async def answer() -> None:
        counted.waker.bind()
        counted.waker.wake()
        await asyncio.wait_for(counted.called.wait(), PATIENCE)

    asyncio.run(answer())
    assert counted.calls == 1


def test_waking_in_a_thread_while_the_loop_ends_raises(run: Run) -> None:
    counted = CountedWaker()
    begun = threading.Event()
    errors: list[Exception] = []

    def keep_waking() -> None:
        while not errors:
            try:
                counted.waker.wake()
            except RuntimeError as error:
                errors.append(error)
            begun.set()

    thread = threading.Thread(target=keep_waking)

    async def serve() -> None:
        counted.waker.bind()
        thread.start()
        assert begun.wait(PATIENCE)

    run(serve)
    thread.join(PATIENCE)
    assert not thread.is_alive()
