"""Waiting until all tasks of the event loop are blocked.

trio tells when nothing can go on. asyncio does not: `anyio.wait_all_tasks_blocked` looks at every task, which costs a
program of n timed tasks n steps each time that one of them wakes. But whatever goes on there, be it a task or a
callback, has been given to the public method ``call_soon`` of the loop, and the loop runs what it has been given first
in, first out. So `settling` counts the calls of that method. If nothing has called it between two turns of the task
that settles, then all that was given earlier has run, and nothing is left to run.
"""

from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from typing import Any, cast

import anyio
import anyio.lowlevel

_QUIET_TURNS = 2
# Who calls `call_soon_threadsafe` on the loop's own thread, or has kept a method, is not counted: a second quiet turn
# sees what that callback sets off.

_MOST_TURNS = 1_000
# A cancel scope whose task refuses to end gives the loop a callback every turn, though all tasks are blocked.


@contextmanager
def settling() -> Iterator[Callable[[], Awaitable[None]]]:
    """A ``with`` that gives an async function which returns when all tasks of the loop are blocked.

    Tasks that wait for sockets, worker threads or the timers of the loop count as blocked. While a task never blocks,
    the function does not return.
    """
    loop = cast(Any, anyio.lowlevel.current_token().native_token)
    call_soon = getattr(loop, "call_soon", None)
    if call_soon is None:
        yield anyio.wait_all_tasks_blocked
        return
    calls = call_soon if isinstance(call_soon, _CountedCalls) else _CountedCalls(loop)
    calls.begin()
    try:
        yield calls.settle
    finally:
        calls.end()


class _CountedCalls:
    """The method ``call_soon`` of an asyncio loop, with the number of its calls.

    It is in the place of the method while anybody settles. Several that settle on one loop share it.
    """

    def __init__(self, loop: Any) -> None:
        self._loop = loop
        self._call_soon: Callable[..., Any] = loop.call_soon
        self._of_the_instance = "call_soon" in vars(loop)
        self._users = 0
        self._count = 0

    def __call__(self, *args: Any, **options: Any) -> Any:
        self._count += 1
        return self._call_soon(*args, **options)

    def begin(self) -> None:
        if self._users == 0:
            self._loop.call_soon = self
        self._users += 1

    def end(self) -> None:
        self._users -= 1
        if self._users > 0:
            return
        if self._of_the_instance:
            self._loop.call_soon = self._call_soon
        else:
            del self._loop.call_soon

    async def settle(self) -> None:
        quiet = 0
        for _ in range(_MOST_TURNS):
            before = self._count
            # The checkpoint is itself one call. A loop that does not count it is never quiet here.
            self._count -= 1
            await anyio.lowlevel.checkpoint()
            quiet = quiet + 1 if self._count == before else 0
            if quiet == _QUIET_TURNS:
                return
        await anyio.wait_all_tasks_blocked()
