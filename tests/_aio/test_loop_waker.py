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
    """A bell, how often it was answered, and an event for the next time."""

    def __init__(self) -> None:
        self.bell = LoopWaker(self._answer)
        self.answers = 0
        self.threads: set[int] = set()
        self.opened = anyio.Event()

    def _answer(self) -> None:
        self.answers += 1
        self.threads.add(threading.get_ident())
        self.opened.set()


async def test_a_thread_wakes_a_loop_that_has_nothing_else_to_do() -> None:
    door = Door()
    assert not door.bell.connected
    door.bell.connect()
    assert door.bell.connected
    for rings in range(1, 4):
        door.opened = anyio.Event()
        with anyio.fail_after(PATIENCE):
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(anyio.to_thread.run_sync, door.bell.ring)
                await door.opened.wait()
        assert door.answers == rings
    assert door.threads == {threading.get_ident()}


async def test_it_is_answered_soon_and_not_at_once_and_once_for_many_rings() -> None:
    door = Door()
    door.bell.connect()
    for _ in range(1_000):
        door.bell.ring()
    assert door.answers == 0
    await settle()
    assert door.answers == 1
    await settle()
    assert door.answers == 1


async def test_what_rings_while_it_is_answered_is_answered_once_more() -> None:
    answers: list[int] = []

    def answer() -> None:
        answers.append(len(answers))
        if len(answers) < 5:
            bell.ring()
            bell.ring()

    bell = LoopWaker(answer)
    bell.connect()
    bell.ring()
    await settle()
    assert answers == [0, 1, 2, 3, 4]


async def test_nothing_that_threads_queue_before_they_ring_is_left_behind() -> None:
    queue: list[int] = []
    taken: list[int] = []
    everything = anyio.Event()

    def answer() -> None:
        while queue:
            taken.append(queue.pop())
        if len(taken) == 8_000:
            everything.set()

    bell = LoopWaker(answer)
    bell.connect()

    def produce() -> None:
        for number in range(2_000):
            queue.append(number)
            bell.ring()

    threads = [threading.Thread(target=produce) for _ in range(4)]
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with anyio.fail_after(PATIENCE):
            for thread in threads:
                thread.start()
            # No more rings come that could wake the loop for what it has overlooked.
            await everything.wait()
    finally:
        sys.setswitchinterval(interval)
        for thread in threads:
            thread.join(PATIENCE)
    assert len(taken) == 8_000


def test_a_bell_that_was_never_connected_says_so() -> None:
    with pytest.raises(RuntimeError, match="connect the doorbell"):
        LoopWaker(lambda: None).ring()


def test_it_is_connected_on_an_event_loop_only() -> None:
    door = Door()
    with pytest.raises(RuntimeError):
        door.bell.connect()
    assert not door.bell.connected


@pytest.mark.parametrize("rings", [0, 1])
def test_every_ring_after_the_end_of_the_loop_says_so(run: Run, rings: int) -> None:
    door = Door()

    async def leave_with_unanswered_rings() -> None:
        door.bell.connect()
        for _ in range(rings):
            door.bell.ring()

    run(leave_with_unanswered_rings)
    answers = door.answers
    for _ in range(3):
        with pytest.raises(RuntimeError):
            door.bell.ring()
    assert door.answers == answers


@pytest.mark.parametrize("rings", [0, 1])
def test_a_bell_may_be_connected_again_to_a_loop_that_comes_later(run: Run, rings: int) -> None:
    door = Door()

    async def leave_with_unanswered_rings() -> None:
        door.bell.connect()
        for _ in range(rings):
            door.bell.ring()

    async def answer() -> None:
        door.bell.connect()
        before = door.answers
        door.bell.ring()
        await settle()
        assert door.answers == before + 1

    run(leave_with_unanswered_rings)
    for _ in range(2):
        run(answer)


def test_a_ring_that_an_ended_loop_has_never_answered_is_told_of_at_the_next_and_forgotten_on_another_loop() -> None:
    door = Door()

    async def connect() -> None:
        door.bell.connect()

    for _ in range(2):
        loop = asyncio.new_event_loop()
        loop.run_until_complete(connect())
        door.bell.ring()
        loop.close()
        for _ in range(2):
            with pytest.raises(RuntimeError):
                door.bell.ring()
        assert door.answers == 0

    async def answer() -> None:
        door.bell.connect()
        door.bell.ring()
        await asyncio.wait_for(door.opened.wait(), PATIENCE)

    asyncio.run(answer())
    assert door.answers == 1


def test_a_thread_that_rings_while_the_loop_ends_is_told_of_it(run: Run) -> None:
    door = Door()
    begun = threading.Event()
    told: list[Exception] = []

    def ring_on() -> None:
        while not told:
            try:
                door.bell.ring()
            except RuntimeError as error:
                told.append(error)
            begun.set()

    thread = threading.Thread(target=ring_on)

    async def serve() -> None:
        door.bell.connect()
        thread.start()
        assert begun.wait(PATIENCE)

    run(serve)
    thread.join(PATIENCE)
    assert not thread.is_alive()
