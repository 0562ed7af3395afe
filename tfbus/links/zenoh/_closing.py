"""The end of zenoh's sessions, for which nobody waits for ever.

A session closes within milliseconds; zenoh gives up waiting for a frozen peer after 10 s. The event loop waits a second
for that, and the interpreter, at its end, a few: a callback of zenoh after that end would abort the process, and so
would a thread that comes back from a call of zenoh.
"""

import atexit
import threading
from collections.abc import Sequence
from contextlib import suppress

import zenoh

from tfbus._aio.loops import join_all, wait_for_all

CLOSING_TIME = 1.0
LONGEST_CLOSE = 15.0
"""s; so long the event loop and the interpreter wait."""
_NAME = "tfbus and zenoh end"


def close_session(session: zenoh.Session | None) -> None:
    """Close a session, if there is one; a second call does nothing."""
    if session is not None:
        # zenoh may give up waiting for a peer; that peer notices the end by itself.
        with suppress(zenoh.ZError):
            session.close()


def begin_to_close(session: zenoh.Session | None) -> threading.Thread:
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


def wait_at_exit(thread: threading.Thread) -> None:
    """Have the interpreter, at its end, wait for a thread that is to end."""
    thread.name = _NAME


@atexit.register
def _wait_at_exit() -> None:
    join_all([thread for thread in threading.enumerate() if thread.name == _NAME], LONGEST_CLOSE)
