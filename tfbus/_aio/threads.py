"""Waiting for threads that may never end."""

import threading
from collections.abc import Sequence
from time import monotonic

import anyio
import anyio.to_thread


def join_all(threads: Sequence[threading.Thread], seconds: float) -> None:
    """Wait in this thread for the end of others, but no longer than so many seconds."""
    deadline = monotonic() + seconds
    for thread in threads:
        thread.join(max(0.0, deadline - monotonic()))


async def wait_for_all(threads: Sequence[threading.Thread], seconds: float) -> bool:
    """Wait for the end of threads, also when cancelled, but no longer than so many seconds.

    Returns whether all of them have ended.
    """
    with anyio.move_on_after(seconds, shield=True):
        # With a limit, for a worker of asyncio keeps the interpreter.
        await anyio.to_thread.run_sync(join_all, threads, seconds, abandon_on_cancel=True)
    return not any(thread.is_alive() for thread in threads)
