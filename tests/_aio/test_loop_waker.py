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


class Door:
    """A waker, how often it was answered, and an event for the next time."""

    def __init__(self) -> None:
        self.waker = LoopWaker(self._answer)
        self.answers = 0
        self.threads: set[int] = set()
        self.opened = anyio.Event()

    def _answer(self) -> None:
        self.answers += 1
        self.threads.add(threading.get_ident())
        self.opened.set()


async def test_a_thread_wakes_a_loop_that_has_nothing_else_to_do() -> None:
    loop = Door()
    assert not loop.waker.bound
    loop.waker.bind()
    assert loop.waker.bound
    for requests in range(1, 4):
        loop.opened = anyio.Event()
        with anyio.fail_after(PATIENCE):
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(anyio.to_thread.run_sync, loop.waker.wake)
                await loop.opened.wait()
        assert loop.answers == requests
    assert loop.threads == {threading.get_ident()}


async def test_the_callback_runs_soon_and_once_for_many_requests() -> None:
    loop = Door()
    loop.waker.bind()
    for _ in range(1_000):
        loop.waker.wake()
    assert loop.answers == 0
    await settle()
    assert loop.answers == 1
    await settle()
    assert loop.answers == 1


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


async def test_nothing_that_threads_queue_before_a_request_is_left_behind() -> None:
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


def test_an_unbound_waker_raises() -> None:
    with pytest.raises(RuntimeError, match="bind the waker"):
        LoopWaker(lambda: None).wake()


def test_a_waker_is_bound_on_an_event_loop_only() -> None:
    loop = Door()
    with pytest.raises(RuntimeError):
        loop.waker.bind()
    assert not loop.waker.bound


@pytest.mark.parametrize("requests", [0, 1])
def test_every_request_after_the_end_of_the_loop_raises(run: Run, requests: int) -> None:
    loop = Door()

    async def leave_with_unanswered_requests() -> None:
        loop.waker.bind()
        for _ in range(requests):
            loop.waker.wake()

    run(leave_with_unanswered_requests)
    answers = loop.answers
    for _ in range(3):
        with pytest.raises(RuntimeError):
            loop.waker.wake()
    assert loop.answers == answers


@pytest.mark.parametrize("requests", [0, 1])
def test_a_waker_may_be_bound_to_a_later_loop(run: Run, requests: int) -> None:
    loop = Door()

    async def leave_with_unanswered_requests() -> None:
        loop.waker.bind()
        for _ in range(requests):
            loop.waker.wake()

    async def answer() -> None:
        loop.waker.bind()
        before = loop.answers
        loop.waker.wake()
        await settle()
        assert loop.answers == before + 1

    run(leave_with_unanswered_requests)
    for _ in range(2):
        run(answer)


def test_a_ring_that_an_ended_loop_has_never_answered_is_told_of_at_the_next_and_forgotten_on_another_loop() -> None:
    loop = Door()

    async def connect() -> None:
        loop.waker.bind()

    for _ in range(2):
        native = asyncio.new_event_loop()
        native.run_until_complete(connect())
        loop.waker.wake()
        native.close()
        for _ in range(2):
            with pytest.raises(RuntimeError):
                loop.waker.wake()
        assert loop.answers == 0

    async def answer() -> None:
        loop.waker.bind()
        loop.waker.wake()
        await asyncio.wait_for(loop.opened.wait(), PATIENCE)

    asyncio.run(answer())
    assert loop.answers == 1


def test_a_thread_that_rings_while_the_loop_ends_is_told_of_it(run: Run) -> None:
    loop = Door()
    begun = threading.Event()
    told: list[Exception] = []

    def ring_on() -> None:
        while not told:
            try:
                loop.waker.wake()
            except RuntimeError as error:
                told.append(error)
            begun.set()

    thread = threading.Thread(target=ring_on)

    async def serve() -> None:
        loop.waker.bind()
        thread.start()
        assert begun.wait(PATIENCE)

    run(serve)
    thread.join(PATIENCE)
    assert not thread.is_alive()
