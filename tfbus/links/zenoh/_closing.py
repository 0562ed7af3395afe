"""The end of zenoh's sessions, for which nobody waits for ever.

A session closes within milliseconds; zenoh gives up waiting for a frozen peer after 10 s. The event loop waits a second
for that, and the interpreter, at its end, a few: a callback of zenoh after that end would abort the process, and so
would a thread that comes back from a call of zenoh.
"""

import atexit
import os
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Protocol

import zenoh

from tfbus._aio.loops import join_all, wait_for_all

CLOSING_TIME = 1.0
LONGEST_CLOSE = 15.0
"""s; so long the event loop and the interpreter wait."""
_NAME = "tfbus and zenoh end"
_forked = _used = False


def use_zenoh() -> None:
    """Note that this process uses zenoh from now on.

    Raises
    ------
    RuntimeError
        If it was forked from one that did: zenoh's threads are there, and its sessions here would hear nobody.
    """
    global _used
    if _forked:
        raise RuntimeError(
            "this process was forked from one that uses zenoh, whose threads are not here: start it with the method "
            "'spawn' of multiprocessing, or fork before the first link"
        )
    _used = True


def _note_fork() -> None:
    global _forked
    _forked = _used


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_note_fork)


class Closable(Protocol):
    """A session of zenoh, or what belongs to one."""

    def close(self) -> None: ...


def close_session(session: Closable | None) -> None:
    """Close a session, if there is one; a second call does nothing, and so does one in a child made by `fork`."""
    if session is not None and not _forked:
        # zenoh may give up waiting for a peer; that peer notices the end by itself.
        with suppress(zenoh.ZError):
            session.close()


def begin_to_close(session: Closable | None) -> threading.Thread:
    """Close a session in a thread of its own; returns the thread."""
    # Not a thread that the interpreter waits for without a limit.
    closing = threading.Thread(target=close_session, args=(session,), name=_NAME, daemon=True)
    closing.start()
    return closing


async def wait_until_closed(closing: Sequence[threading.Thread]) -> TimeoutError | None:
    """Wait a second for such threads, also when cancelled; returns an error if that was too short."""
    if await wait_for_all(closing, CLOSING_TIME):
        return None
    return TimeoutError(f"zenoh has not closed its session within {CLOSING_TIME:g} s, and goes on in the background")


class Keeper:
    """The thread in which a wire or a router opens and closes its sessions, because zenoh's calls block.

    A program that exits without the end of its links has them closed all the same.

    Parameters
    ----------
    keep : callable
        The work of the thread. It returns soon after `stopped`; it waits for `changed` meanwhile.

    Attributes
    ----------
    changed : threading.Event
        Set when there is something to do, for instance because of `stop`.
    stopped : bool
    """

    def __init__(self, keep: Callable[[], object]) -> None:
        self.changed = threading.Event()
        self.stopped = False
        self._thread = threading.Thread(target=keep, name=_NAME, daemon=True)

    def start(self) -> None:
        """Begin; raises as `use_zenoh`."""
        use_zenoh()
        atexit.register(self.stop)
        self._thread.start()

    def stop(self) -> None:
        """Have the thread end; from any thread."""
        self.stopped = True
        self.changed.set()

    async def end(self) -> TimeoutError | None:
        """Have the thread end, and wait for it as `wait_until_closed` does; also if it has not begun."""
        self.stop()
        atexit.unregister(self.stop)
        return await wait_until_closed([] if self._thread.ident is None else [self._thread])


@atexit.register
def _wait_at_exit() -> None:
    join_all([thread for thread in threading.enumerate() if thread.name == _NAME], LONGEST_CLOSE)
