"""The lease of a session: the time of silence after which others take it for lost.

zenoh counts the lease of a connection from the last message that was read from it. A process that waits for a CPU most
of the time reads late, and takes ends for lost that have told all the while that they live. That costs it more time:
each connection is made again, and both ends ask each other for what they have missed.
"""

import os
from contextlib import suppress

LEASE = 4.0
"""s; a peer that is cut off is lost soon enough to be found again in 5 s."""
BUSY_LEASE = 10.0
"""s; on a busy machine."""
MOST_RUNNABLE = 8.0
"""Threads for each CPU that run or could run; where there are more, a machine is busy."""
_LOAD = "/proc/loadavg"


def default_lease(load: str | os.PathLike[str] = _LOAD) -> float:
    """The lease of a session that is given none, in s: longer if the machine is busy just now.

    Parameters
    ----------
    load : path
        Linux's `/proc/loadavg`, whose fourth field tells how many threads are runnable; see proc(5). Where it cannot be
        read, no machine is busy.
    """
    # Nothing else that a link imports needs pathlib, which costs 0.4 MB.
    with suppress(OSError, ValueError, IndexError), open(load, encoding="ascii") as file:  # noqa: PTH123
        runnable = int(file.read().split()[3].partition("/")[0])
        if runnable > MOST_RUNNABLE * (os.cpu_count() or 1):
            return BUSY_LEASE
    return LEASE
