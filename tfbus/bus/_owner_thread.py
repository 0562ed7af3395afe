"""The thread that a bus belongs to."""

import asyncio
from threading import get_ident

import anyio


class OwnerThread:
    """The thread that may use a bus: first the one that made it, then that of the first event loop that uses it.

    Attributes
    ----------
    thread : int
        Its identity, as `threading.get_ident` gives it.
    """

    __slots__ = ("_on_a_loop", "thread")

    def __init__(self) -> None:
        self.thread = get_ident()
        self._on_a_loop = _runs_a_loop()

    def check(self) -> None:
        """Raise `RuntimeError` unless this thread owns the bus, or runs an event loop and may take it over."""
        thread = get_ident()
        if thread == self.thread and self._on_a_loop:
            return
        on_a_loop = _runs_a_loop()
        if thread != self.thread:
            if self._on_a_loop or not on_a_loop:
                raise RuntimeError("the bus belongs to another thread: publish with `with bus.threadsafe() as publish`")
            self.thread = thread
        self._on_a_loop = on_a_loop


def _runs_a_loop() -> bool:
    """Whether this thread runs an event loop. In a bare asyncio callback only asyncio knows."""
    for probe in (asyncio.get_running_loop, anyio.get_current_task):
        try:
            probe()
        except RuntimeError:
            continue
        return True
    return False
