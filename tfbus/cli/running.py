"""The event loop of a command."""

import signal
import sys
from collections.abc import Awaitable, Callable

import anyio


def run(main: Callable[[], Awaitable[object]], backend: str) -> None:
    """As `anyio.run`, but Ctrl-C lets everything come to its end in order, however often it is pressed.

    Raises
    ------
    KeyboardInterrupt
        At the end, if it was pressed.
    """
    # Where somebody ignores it, as a shell does for what runs in the background, it stays ignored.
    if sys.platform == "win32" or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        anyio.run(main, backend=backend)
        return
    interrupted = False
    failed: Exception | None = None

    async def run_until_interrupted() -> None:
        nonlocal interrupted
        with anyio.open_signal_receiver(signal.SIGINT) as presses:
            async with anyio.create_task_group() as tasks:

                async def work() -> None:
                    nonlocal failed
                    try:
                        await main()
                    except Exception as error:  # noqa: BLE001 - the task group would wrap it
                        failed = error
                    tasks.cancel_scope.cancel()

                tasks.start_soon(work)
                async for _ in presses:
                    interrupted = True
                    tasks.cancel_scope.cancel()

    anyio.run(run_until_interrupted, backend=backend)
    if failed is not None:
        raise failed
    if interrupted:
        raise KeyboardInterrupt
