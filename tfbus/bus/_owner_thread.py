"""The thread that a bus belongs to.

`fork` copies the thread that calls it, and no other. A child has a copy of a bus, but neither the event loop nor the
threads of the links, recorders and servers on it: what it publishes there would reach nobody. So such a bus belongs to
no thread of the child. One that nothing of this kind is on is a plain object, and the child may use its copy.
"""

import asyncio
import os
from threading import get_ident
from weakref import WeakSet

import anyio

from tfbus.bus._intake import Intake


class OwnerThread:
    """The thread that may use a bus: first the one that made it, then that of the first event loop that uses it.

    Parameters
    ----------
    intake : Intake
        That of the bus; it takes batches from this thread only.

    Attributes
    ----------
    thread : int
        Its identity, as `threading.get_ident` gives it; 0 for none.
    entered : WeakSet
        What was entered on the bus and works in threads and on the event loop of this process, such as links.
    """

    __slots__ = ("__weakref__", "_intake", "_left_behind", "_on_a_loop", "entered", "thread")

    def __init__(self, intake: Intake) -> None:
        self._intake = intake
        self.thread = intake.thread = get_ident()
        self._on_a_loop = _runs_a_loop()
        self._left_behind = ""
        self.entered: WeakSet[object] = WeakSet()
        _OWNERS.add(self)

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
            self.thread = self._intake.thread = thread
        self._on_a_loop = on_a_loop

    def check_process(self) -> None:
        """Raise `RuntimeError` in a child of `fork` that has the bus without what is on it."""
        if self._left_behind:
            raise RuntimeError(
                f"this process was forked, and fork has not copied what works for the bus, {self._left_behind}: "
                "make a bus in the child, or start the child with the method 'spawn' of multiprocessing"
            )

    def leave_behind(self) -> None:
        """Belong to no thread of this process, which was forked, if anything was entered on the bus."""
        if self.entered:
            self._left_behind = " and ".join(sorted({type(thing).__name__ for thing in self.entered}))
            self.thread = self._intake.thread = 0


_OWNERS: WeakSet[OwnerThread] = WeakSet()


def _leave_behind() -> None:
    for owner in tuple(_OWNERS):
        owner.leave_behind()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_leave_behind)


def _runs_a_loop() -> bool:
    """Whether this thread runs an event loop. In a bare asyncio callback only asyncio knows."""
    for probe in (asyncio.get_running_loop, anyio.get_current_task):
        try:
            probe()
        except RuntimeError:
            continue
        return True
    return False
