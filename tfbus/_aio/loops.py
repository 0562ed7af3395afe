"""Event loops and threads: waking a loop from any thread, waiting until its tasks are blocked, and joining threads.

How `settling` waits: trio tells when all tasks are blocked, asyncio does not. `anyio.wait_all_tasks_blocked` looks at
every task, so a program of n timed tasks pays n steps each time that one of them wakes. But asyncio schedules tasks and
callbacks by the public method ``call_soon`` of the loop, and the loop runs them first in, first out. So `settling`
counts the calls of that method. If there was no call between two turns of the settling task, then everything that was
scheduled earlier has run, and nothing is left to run.
"""

import logging
import sys
import threading
from asyncio import get_running_loop
from collections.abc import Awaitable, Callable, Coroutine, Generator, Iterator, Sequence
from contextlib import contextmanager
from contextvars import Context, copy_context
from functools import partial
from time import monotonic
from types import SimpleNamespace, coroutine
from typing import Any, cast

import anyio
import anyio.lowlevel
import anyio.to_thread

# trio writes its name here while it runs a task, also inside a task of asyncio, as in a cell of a notebook. It needs
# sniffio, which anyio has imported if it is installed.
here: Any = getattr(sys.modules.get("sniffio"), "thread_local", SimpleNamespace(name=None))


@coroutine
def _turn() -> Generator[None, None, None]:
    yield


def checkpoint() -> Awaitable[None]:
    """`anyio.lowlevel.checkpoint`, without the way through anyio."""
    return _turn() if here.name is None else _lowlevel().checkpoint()


def running_loop() -> Any:
    """The running event loop: the loop object of asyncio, or the token of trio."""
    return get_running_loop() if here.name is None else _lowlevel().current_trio_token()


def _lowlevel() -> Any:
    return sys.modules["trio.lowlevel"]


_spawned: set[Any] = set()


def spawn(loop: Any, function: Callable[[], Coroutine[Any, Any, None]]) -> None:
    """Start a task of no task group on the running loop; it must not raise."""
    if here.name is not None:
        _lowlevel().spawn_system_task(function)
        return
    # asyncio holds its tasks weakly.
    task = loop.create_task(function())
    _spawned.add(task)
    task.add_done_callback(_spawned.discard)


@coroutine
def asleep(sleep: Generator[Any, None, None]) -> Generator[Any, None, None]:
    """Sleep as `wake_up` says."""
    yield from sleep


def wake_up(loop: Any) -> tuple[Generator[Any, None, None], Callable[[], object]]:
    """The sleep of one task on the running loop, to be iterated once by that task, and the function that ends it.

    If it was ended before the task awaits it, there is no checkpoint. The function may raise an `Exception` if the wait
    has ended, or the event loop is closed.
    """
    if here.name is None:
        # No function of Python is then on the way from a publish to the event loop.
        future = loop.create_future()
        return future.__await__(), partial(future.set_result, None)
    woken = _TrioWakeUp()
    return woken.sleep(), woken.end


class _TrioWakeUp:
    """A wait of one task on trio."""

    __slots__ = ("_ended", "_task")

    def __init__(self) -> None:
        self._task: Any = None
        self._ended = False

    def end(self) -> None:
        """End the wait, if it has not ended."""
        if not self._ended:
            self._ended = True
            task, self._task = self._task, None
            if task is not None:
                _lowlevel().reschedule(task)

    def sleep(self) -> Generator[Any, None, None]:
        """Sleep until `end` is called."""
        if not self._ended:
            lowlevel = _lowlevel()
            self._task = lowlevel.current_task()
            yield from lowlevel.wait_task_rescheduled(self._abort).__await__()

    def _abort(self, _raise_cancel: object) -> Any:
        """End the wait, because trio has cancelled it."""
        self._task = None
        return _lowlevel().Abort.SUCCEEDED


class _TrioCalls:
    """Calls functions on the running loop of trio in its next turn, for the loop's own thread.

    A task waits for them, so that nothing goes through the socket by which `trio.lowlevel.TrioToken` wakes the loop:
    that takes several system calls.
    """

    def __init__(self, token: Any) -> None:
        self._token = token
        self._functions: list[Callable[[], object]] = []
        self._woken = _TrioWakeUp()
        self._ended = False
        _lowlevel().spawn_system_task(self._run)

    def call_soon(self, function: Callable[[], object]) -> None:
        """Call a function in the next turn; it must not raise."""
        # At the end of trio, generators are closed behind all tasks.
        if self._ended:
            self._token.run_sync_soon(function)
        else:
            self._functions.append(function)
            self._woken.end()

    async def _run(self) -> None:
        try:
            while True:
                self._woken = _TrioWakeUp()
                if self._functions:
                    # Other tasks get their turn first.
                    await _lowlevel().checkpoint()
                else:
                    await asleep(self._woken.sleep())
                self._call_all()
        finally:
            self._ended = True
            del _trio_calls[self._token]
            self._call_all()

    def _call_all(self) -> None:
        functions, self._functions = self._functions, []
        for function in functions:
            function()


_trio_calls: dict[Any, _TrioCalls] = {}
"""By the tokens of the running loops."""


def _call_soon_on_trio(token: Any) -> Callable[[Callable[[], object]], object]:
    """The function that has the running loop of trio call another one in its next turn."""
    if token not in _trio_calls:
        _trio_calls[token] = _TrioCalls(token)
    return _trio_calls[token].call_soon


class LoopWaker:
    """Calls a function on the event loop soon after a thread has asked for it.

    Requests that come before the call share one call.

    Parameters
    ----------
    callback : callable
        Called on the loop. It must process everything that has been queued, or wake again. An `Exception` is logged.

    Notes
    -----
    Queue first, then call `wake`. The waker accepts new requests before it calls `callback`, so a request that comes
    during the call leads to another call: there may be one call too many, never one too few.
    """

    def __init__(self, callback: Callable[[], object]) -> None:
        self._callback = callback
        self._call_soon: Callable[[Callable[[], object]], object] | None = None
        self._call_soon_here: Callable[[Callable[[], object]], object] | None = None
        self._loop: Any = None
        self._thread = 0
        self._loop_is_closed: Callable[[], bool] = _never
        self._context: Context
        self._requested = False

    @property
    def bound(self) -> bool:
        """Whether `bind` was called."""
        return self._call_soon is not None

    def bind(self) -> None:
        """Wake the running event loop from now on."""
        # anyio has no public function for this; only the loops' own functions wake them from a thread.
        self._loop = native = cast(Any, anyio.lowlevel.current_token().native_token)
        self._call_soon = getattr(native, "run_sync_soon", None) or native.call_soon_threadsafe
        # On the loop's own thread, no byte through a socket pair is needed to wake it up.
        self._call_soon_here = getattr(native, "call_soon", None) or _call_soon_on_trio(native)
        self._thread = threading.get_ident()
        # trio answers each request that it has accepted. An asyncio loop may be closed with requests left.
        self._loop_is_closed = getattr(native, "is_closed", _never)
        self._context = copy_context()
        # An earlier loop may have ended without answering a request.
        self._requested = False

    @property
    def is_here(self) -> bool:
        """Whether the running event loop is the one that is woken; it raises if none runs."""
        return anyio.lowlevel.current_token().native_token is self._loop

    def wake(self) -> None:
        """Request a call of the callback; for any thread.

        Raises
        ------
        RuntimeError
            If the event loop has ended, or `bind` was never called.
        """
        if self._call_soon is None or self._call_soon_here is None:
            raise RuntimeError("bind the waker on the event loop first")
        if not self._requested:
            self._requested = True
            call_soon = self._call_soon_here if threading.get_ident() == self._thread else self._call_soon
            try:
                call_soon(self._call)
            except BaseException:
                self._requested = False
                raise
        elif self._loop_is_closed():
            raise RuntimeError("the event loop has ended before it answered an earlier request")

    def answer(self, work: Callable[[], object]) -> None:
        """Do work on the event loop, and call the callback when it ends, in the same turn, for all that it requests."""
        # Until the call, no request has the loop wake. One that came before leads to another call.
        self._requested = True
        try:
            work()
        finally:
            self._call()

    def _call(self) -> None:
        self._requested = False
        try:
            # The context of a task: a thread's own does not tell anyio which loop runs, so no task could be started.
            self._context.run(self._callback)
        except Exception:
            # No task would receive the error, and it would end the whole run of trio.
            logging.getLogger("tfbus").exception("a callback of another thread raised")


def _never() -> bool:
    return False


_QUIET_TURNS = 2
# A call of `call_soon_threadsafe` on the loop's own thread, or of a method that was kept, is not counted: a second
# quiet turn sees the calls that its callback makes.

_MOST_TURNS = 1_000
# A cancel scope whose task refuses to end gives the loop a callback every turn, though all tasks are blocked.


@contextmanager
def settling() -> Iterator[Callable[[], Awaitable[None]]]:
    """A ``with`` that gives an async function; the function returns when all tasks of the loop are blocked.

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

    It replaces the method while a task settles. All settling tasks of a loop share it.
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


def join_all(threads: Sequence[threading.Thread], seconds: float) -> None:
    """Wait in this thread for the end of other threads, at most for some seconds."""
    deadline = monotonic() + seconds
    for thread in threads:
        thread.join(max(0.0, deadline - monotonic()))


async def wait_for_all(threads: Sequence[threading.Thread], seconds: float) -> bool:
    """Wait for the end of threads, also when cancelled, but at most for some seconds.

    Returns whether all of them have ended.
    """
    with anyio.move_on_after(seconds, shield=True):
        # With a limit, for a worker of asyncio keeps the interpreter.
        await anyio.to_thread.run_sync(join_all, threads, seconds, abandon_on_cancel=True)
    return not any(thread.is_alive() for thread in threads)
