"""The event loop of a command, with an orderly end at Ctrl-C."""

import signal
import sys
from collections.abc import Awaitable, Callable
from typing import TypeVar

import anyio

T = TypeVar("T")


def run(main: Callable[[], Awaitable[T]], backend: str) -> T:
    """Run an async function as `anyio.run` does; Ctrl-C cancels it, and its cleanup survives further presses.

    Raises
    ------
    KeyboardInterrupt
        After the function has ended, if Ctrl-C was pressed.
    """
    # A handler that is not Python's own stays: a shell, for example, has background programs ignore the signal.
    if sys.platform == "win32" or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        return anyio.run(main, backend=backend)
    interrupted = False
    failure: Exception | None = None
    result: T

    async def run_until_interrupted() -> None:
        nonlocal interrupted
        with anyio.open_signal_receiver(signal.SIGINT) as presses:
            async with anyio.create_task_group() as tasks:

                async def work() -> None:
                    nonlocal failure, result
                    try:
                        result = await main()
                    except Exception as error:  # noqa: BLE001 - the task group would wrap it in an ExceptionGroup
                        failure = error
                    tasks.cancel_scope.cancel()

                tasks.start_soon(work)
                async for _ in presses:
                    interrupted = True
                    tasks.cancel_scope.cancel()

    anyio.run(run_until_interrupted, backend=backend)
    if failure is not None:
        raise failure
    if interrupted:
        raise KeyboardInterrupt
    return result
