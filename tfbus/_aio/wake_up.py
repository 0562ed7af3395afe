"""The wake-up of one waiting task. It does less than an event, for which any number of tasks may wait."""

import sys
from collections.abc import Callable, Generator
from functools import partial
from typing import Any, cast

from tfbus._aio.loop_timer import running_loop


class WakeUp:
    """``await wake_up`` waits until `end` is called; at once, without a checkpoint, if it was called before.

    Only one task may wait, on the loop that ran when this was made, and only once.
    """

    __slots__ = ("_ended", "_future", "_task")

    def __init__(self) -> None:
        loop = running_loop()
        self._task: Any = None
        self._ended = False
        self._future: Any = loop.create_future() if hasattr(loop, "create_future") else None

    @property
    def wake(self) -> Callable[[], object]:
        """A function like `end`, but faster, and it may raise an `Exception` if the wait has ended."""
        # No function of Python is then on the way from a publish to an asyncio loop.
        return self.end if self._future is None else partial(self._future.set_result, None)

    def end(self) -> None:
        """End the wait, if it has not ended.

        Raises
        ------
        RuntimeError
            If the event loop is closed.
        """
        if self._future is not None:
            # Done already, if the task was cancelled.
            if not self._future.done():
                self._future.set_result(None)
        elif not self._ended:
            self._ended = True
            task, self._task = self._task, None
            if task is not None:
                cast(Any, sys.modules["trio"]).lowlevel.reschedule(task)

    def __await__(self) -> Generator[Any, None, None]:
        if self._future is not None:
            return cast(Generator[Any, None, None], self._future.__await__())
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
