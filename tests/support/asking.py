"""A moving child, a pause, a call in a task of its own, and threads that read while the test writes."""

import sys
import threading
from collections.abc import Awaitable, Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Generic, TypeVar

import anyio
import anyio.lowlevel
from anyio.abc import TaskGroup

from tfbus import SystemClock, Transform, TransformStamped, from_seconds

T = TypeVar("T")


def driving(parent: str, child: str, seconds: float, authority: str = "") -> TransformStamped:
    """A sample of a child that drives at 1 m/s: at t s it is t m along the first axis."""
    return TransformStamped(parent, child, from_seconds(seconds), Transform((seconds, 0.0, 0.0)), authority)


async def settle() -> None:
    """Let everything run until all tasks are blocked."""
    for _ in range(5):
        await anyio.lowlevel.checkpoint()
    await anyio.wait_all_tasks_blocked()


class HandClock(SystemClock):
    """A clock whose timeouts run out when the test cancels their scopes."""

    def __init__(self) -> None:
        self.scopes: list[anyio.CancelScope] = []

    def move_on_after(self, seconds: float) -> anyio.CancelScope:  # noqa: ARG002
        self.scopes.append(anyio.CancelScope())
        return self.scopes[-1]


class Asked(Generic[T]):
    """A call in a task of its own, and how it ended."""

    def __init__(self, tasks: TaskGroup, call: Callable[[], Awaitable[T]]) -> None:
        self._call = call
        self._answer: list[T] = []
        self._scope = anyio.CancelScope()
        self.error: Exception | None = None
        self.ended = False
        tasks.start_soon(self._run)

    @property
    def cancelled(self) -> bool:
        return self._scope.cancelled_caught

    @property
    def answer(self) -> T:
        """The result of the call; its error is raised here."""
        if self.error is not None:
            raise self.error
        assert self.ended, "the call still waits"
        assert self._answer, "the call was cancelled"
        return self._answer[0]

    def cancel(self) -> None:
        self._scope.cancel()

    async def _run(self) -> None:
        try:
            with self._scope:
                self._answer.append(await self._call())
        except Exception as error:  # noqa: BLE001 - the test looks at it
            self.error = error
        self.ended = True


# Threads that read while the test writes


@contextmanager
def threads_that(read: Callable[[], None], number: int = 2) -> Iterator[None]:
    """Some threads call `read` over and over while the block runs, and take turns as often as they can."""
    begun, done = threading.Barrier(number + 1), threading.Event()

    def go_on() -> None:
        begun.wait()
        while not done.is_set():
            read()

    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(number) as pool:
            readers = [pool.submit(go_on) for _ in range(number)]
            try:
                begun.wait()
            except BaseException:
                # A reader that waits for others would hold up the end of the pool.
                begun.abort()
                raise
            try:
                yield
            finally:
                done.set()
        for reader in readers:
            reader.result()
    finally:
        sys.setswitchinterval(interval)
