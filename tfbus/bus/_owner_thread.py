"""The thread that a bus belongs to.

`fork` copies the thread that calls it, and no other. A child has a copy of a bus, but neither the event loop nor the
threads of the links, recorders and servers on it: what it publishes there would reach nobody. So such a bus belongs to
no thread of the child. One that nothing of this kind is on is a plain object, and the child may use its copy.
"""

import asyncio
from threading import get_ident

import anyio


class OwnerThread:
    """The thread that may use a bus: first the one that made it, then that of the first event loop that uses it.

    Attributes
    ----------
    thread : int
        Its identity, as `threading.get_ident` gives it; 0 for none.
    left_in : str
        What is on the bus and works in the process only from which this one was forked; empty if that is nothing.
    """

    __slots__ = ("_on_a_loop", "left_in", "thread")

    def __init__(self) -> None:
        self.thread = get_ident()
        self.left_in = ""
        self._on_a_loop = _runs_a_loop()

    def check(self) -> None:
        """Raise `RuntimeError` unless this thread owns the bus, or runs an event loop and may take it over."""
        thread = get_ident()
        if thread == self.thread and self._on_a_loop:
            return
        self.check_process()
        on_a_loop = _runs_a_loop()
        if thread != self.thread:
            if self._on_a_loop or not on_a_loop:
                raise RuntimeError("the bus belongs to another thread: publish with `with bus.threadsafe() as publish`")
            self.thread = thread
        self._on_a_loop = on_a_loop

    def check_process(self) -> None:
        """Raise `RuntimeError` in a child of `fork` that has the bus without what is on it."""
        if self.left_in:
            raise RuntimeError(
                f"this process was forked, and fork has not copied what works for the bus, {self.left_in}: make a bus "
                "in the child, or start the child with the method 'spawn' of multiprocessing"
            )

    def leave(self, things: str) -> None:
        """Belong to no thread, because this process was forked and has not got some things."""
        self.thread = 0
        self.left_in = things


def _runs_a_loop() -> bool:
    """Whether this thread runs an event loop. In a bare asyncio callback only asyncio knows."""
    for probe in (asyncio.get_running_loop, anyio.get_current_task):
        try:
            probe()
        except RuntimeError:
            continue
        return True
    return False
