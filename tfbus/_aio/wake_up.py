"""The wake-up of one waiting task. It does less than an event, for which any number of tasks may wait."""

import sys
from collections.abc import Generator
from typing import Any, cast

from tfbus._aio.loop_timer import running_loop


class WakeUp:
    """``await wake_up`` waits until `end` is called; at once, without a checkpoint, if it was called before.

    Only one task may wait, on the loop that ran when this was made, and only once.
    """

    __slots__ = ("_ended", "_future", "_task")

    def __init__(self) -> None:
        loop = running_loop()
        self._future: Any = loop.create_future() if hasattr(loop, "create_future") else None
        self._task: Any = None
        self._ended = False

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
        return self._wait_on_trio().__await__()

    async def _wait_on_trio(self) -> None:
        if self._ended:
            return
        lowlevel = cast(Any, sys.modules["trio"]).lowlevel

        def abort(_raise_cancel: object) -> Any:
            self._task = None
            self._ended = True
            return lowlevel.Abort.SUCCEEDED

        self._task = lowlevel.current_task()
        await lowlevel.wait_task_rescheduled(abort)
