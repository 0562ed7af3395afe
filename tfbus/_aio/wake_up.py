"""The wake-up of one waiting task. It does less than an event, for which any number of tasks may wait."""

import sys
from collections.abc import Awaitable, Callable, Generator
from functools import partial
from typing import Any, cast

from tfbus._aio.loop_timer import running_loop


def wake_up() -> tuple[Awaitable[None], Callable[[], object]]:
    """A wait of one task on the loop that runs now, to be awaited once, and the function that ends it.

    If it was ended before the task awaits it, there is no checkpoint. The function may raise an `Exception` if the wait
    has ended, or the event loop is closed.
    """
    loop = running_loop()
    if hasattr(loop, "create_future"):
        # No function of Python is then on the way from a publish to the event loop.
        future = loop.create_future()
        return future, partial(future.set_result, None)
    woken = _TrioWakeUp()
    return woken, woken.end


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
                cast(Any, sys.modules["trio"]).lowlevel.reschedule(task)

    def __await__(self) -> Generator[Any, None, None]:
        if self._ended:
            return _nothing()
        lowlevel = cast(Any, sys.modules["trio"]).lowlevel
        self._task = lowlevel.current_task()
        return cast(Generator[Any, None, None], lowlevel.wait_task_rescheduled(self._abort).__await__())

    def _abort(self, _raise_cancel: object) -> Any:
        """End the wait, because trio has cancelled it."""
        self._task = None
        self._ended = True
        return cast(Any, sys.modules["trio"]).lowlevel.Abort.SUCCEEDED


def _nothing() -> Generator[Any, None, None]:
    yield from ()
