"""The newest sample of each moving frame that a link has sent, for peers to which less than all is enough."""

import math
from collections.abc import Callable

from tfbus.geometry.stamped import TransformStamped
from tfbus.links._entries import OutgoingBatch
from tfbus.links._message import Message, can_hold, write_answer
from tfbus.links._outbox import Turn
from tfbus.links._peers import MAX_PEERS
from tfbus.links._state import StateStep

_PER_MESSAGE = 1_000
_TOGETHER = 0.02
_EARLY = 0.9
"""s, and part of a period: what comes later than the one, and earlier than the other, is left out."""


class NewestSamples:
    """Keeps one sample of each moving frame until it is taken.

    Static frames and removals are not in it: whoever hears only this is told the state of the link, and asks for them.

    Attributes
    ----------
    step : StateStep or None
        The newest claim of the link.
    untold : bool
        Whether anything was noted or claimed since the messages were taken last.
    """

    def __init__(self) -> None:
        self.step: StateStep | None = None
        self.untold = False
        self._newest: dict[str, tuple[bytes, int, TransformStamped]] = {}

    def note(self, turn: Turn) -> None:
        """Note what one turn has published and removed."""
        newest = self._newest
        for entry in turn.entries:
            if isinstance(entry, OutgoingBatch):
                for sample in entry.samples:
                    fields = sample._fields
                    if not fields[5]:
                        newest[fields[1]] = entry.origin, entry.sequence, sample
                    elif newest:
                        newest.pop(fields[1], None)
            else:
                newest.pop(entry.frame, None)
        self.claim(turn.step)

    def claim(self, step: StateStep | None) -> None:
        """Note a claim of the link, which goes out although no sample does."""
        self.step = step
        self.untold = True

    def take(self) -> list[Message]:
        """Messages with the samples that were noted since this was called last, and the claim."""
        entries = [
            OutgoingBatch(origin, sequence, (sample,))
            for origin, sequence, sample in self._newest.values()
            if can_hold(sample)
        ]
        self._newest.clear()
        self.untold = False
        if self.step is None:
            return []
        # It tells nothing of the state but its number.
        claim = StateStep(self.step.number, self.step.number, self.step.digest)
        parts = [entries[start : start + _PER_MESSAGE] for start in range(0, len(entries), _PER_MESSAGE)]
        return [message for part in parts or [[]] for message in _written(part, claim)]


def _written(entries: list[OutgoingBatch], claim: StateStep) -> list[Message]:
    """One message of all entries if possible, else several: long authorities fill one sooner than samples do."""
    try:
        return [write_answer(entries, claim)]
    except ValueError:
        if len(entries) < 2:
            raise
    middle = len(entries) // 2
    return _written(entries[:middle], claim) + _written(entries[middle:], claim)


class Thinning:
    """Decides which messages with newest samples a link takes: those of each sender at a rate.

    Parameters
    ----------
    rate : float
        In Hz.
    now : callable
        Returns a monotonic time in s.
    """

    def __init__(self, rate: float, now: Callable[[], float]) -> None:
        self._period = 1 / rate
        self._now = now
        self._taken: dict[str, float] = {}

    def takes(self, sender: str) -> bool:
        """Whether a message that has come now is taken."""
        now = self._now()
        # Samples that belong together come in several messages at once.
        since = now - self._taken.get(sender, -math.inf)
        if _TOGETHER < since < _EARLY * self._period:
            return False
        if since > _TOGETHER:
            if len(self._taken) >= MAX_PEERS:
                self._taken.clear()
            self._taken[sender] = now
        return True
