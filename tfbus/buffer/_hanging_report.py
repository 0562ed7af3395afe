"""The log line about lookups that hang: one for all of them, at most every few seconds."""

import logging
import math
from collections.abc import Hashable
from itertools import islice

from tfbus.bus.once_logger import SeenKeys
from tfbus.clock import Clock
from tfbus.errors import TransformLookupError
from tfbus.stamps import from_seconds, to_seconds
from tfbus.tree.question import Question
from tfbus.waiting.waiting_index import PendingLookup, WaitingIndex, blocking_frames

REPORT_AFTER = 5.0
"""A lookup that has waited for longer than this, in s, is logged."""

NAMED = 3
"""The number of lookups that a line names; naming one searches all frames for similar names."""

_LOOKED_AT = 10_000


class HangingReport:
    """Logs the lookups of one buffer that have waited for `REPORT_AFTER`, each cause once.

    Parameters
    ----------
    waiting : WaitingIndex
    clock : Clock
    """

    def __init__(self, waiting: WaitingIndex, clock: Clock) -> None:
        self._waiting = waiting
        self._clock = clock
        self._told = SeenKeys(_LOOKED_AT)
        self._last: int | None = None

    def tell(self, question: Question, since: int, blocker: TransformLookupError) -> float:
        """Log a lookup that has waited for `REPORT_AFTER`, and all others that have, unless a line was logged just now.

        Returns
        -------
        float
            The time, in s, until this is to be called again; infinity if the cause has been told.
        """
        if _cause(blocker) in self._told:
            return math.inf
        now = self._clock.now()
        if self._last is not None and 0 <= now - self._last < from_seconds(REPORT_AFTER):
            return REPORT_AFTER - to_seconds(now - self._last)
        self._last = now
        self._told.add(_cause(blocker))
        named = [PendingLookup(question, since, blocker)]
        untold = 0
        for pending in islice(self._waiting.waiting_since(now - from_seconds(REPORT_AFTER)), _LOOKED_AT):
            if self._told.add(_cause(pending.blocked_by)):
                if len(named) < NAMED:
                    named.append(pending)
                else:
                    untold += 1
        log = logging.getLogger("tfbus")
        if len(named) == 1:
            log.warning(
                "a lookup of %r in %r has waited for more than %g s: %s",
                question.source,
                question.target,
                REPORT_AFTER,
                blocker,
            )
        else:
            lookups = "; ".join(map(str, named))
            more = f"; and {untold} more, see Buffer.pending()" if untold else ""
            log.warning(
                "%d lookups have waited for more than %g s: %s%s", len(named) + untold, REPORT_AFTER, lookups, more
            )
        return math.inf


def _cause(blocker: TransformLookupError) -> Hashable:
    return type(blocker), blocking_frames(blocker)
