"""The times at which a link asks its peers whether they hear it.

After connections have broken and come back, zenoh sometimes keeps one of which one end has lost all that the other end
has declared: its presence, subscriptions and queries. That end hears nobody there. The other end hears it, and knows
nothing of this unless it asks. So it asks soon and often after each change of a connection, and while all is well ever
more seldom.
"""

from collections.abc import Callable
from dataclasses import dataclass
from random import Random

FIRST_PAUSE = 1.0
LONGEST_PAUSE = 300.0
"""s between two questions to one peer: at first, and then twice that time, up to the longest."""
SETTLED_PAUSE = 60.0
"""s; after a peer has told that it hears this link."""
SECOND_PAUSE = 0.5
"""s; after an answer that the link is not heard, for its presence may be on its way."""
DEAF = 2
"""So many such answers in a row mean that it will not come."""
MOST_SILENT = 3
"""A peer that answers nothing is taken for deaf so often; it may have no right to answer."""


@dataclass(slots=True)
class _Check:
    due: float
    pause: float = FIRST_PAUSE
    unheard: int = 0
    silent: int = 0


class Hearing:
    """Decides which peers to ask when, and judges their answers.

    Parameters
    ----------
    now : callable
        Returns a monotonic time in s.
    random : Random, optional
    """

    def __init__(self, now: Callable[[], float], random: Random | None = None) -> None:
        self._now = now
        self._random = Random() if random is None else random
        self._checks: dict[str, _Check] = {}

    def joined(self, peer: str) -> None:
        """A peer is there, or has come back."""
        self._checks[peer] = _Check(self._now() + self._jitter(FIRST_PAUSE))

    def left(self, peer: str) -> None:
        """A peer is lost."""
        self._checks.pop(peer, None)

    def next_due(self) -> float | None:
        """The time of the next call of `take_due`; None while nobody is there."""
        return min((check.due for check in self._checks.values()), default=None)

    def take_due(self) -> list[str]:
        """The peers to ask now."""
        now = self._now()
        due = [peer for peer, check in self._checks.items() if check.due <= now]
        for peer in due:
            check = self._checks[peer]
            check.pause = min(2 * check.pause, LONGEST_PAUSE)
            check.due = now + self._jitter(check.pause)
        return due

    def is_heard(self, peer: str) -> None:
        """Note that a peer has told by itself that it hears this link: it need not be asked soon."""
        check = self._checks.get(peer)
        if check is not None:
            check.unheard = 0
            check.pause = max(check.pause, SETTLED_PAUSE)
            check.due = max(check.due, self._now() + self._jitter(SETTLED_PAUSE))

    def is_deaf(self, peer: str, hears: bool) -> bool:
        """Note a peer's answer; returns whether it does not hear this link, and will not by itself."""
        check = self._checks.get(peer)
        if check is None:
            return False
        if hears:
            check.unheard = 0
            return False
        deaf = _count_unheard(check)
        check.pause = FIRST_PAUSE
        check.due = self._ask_again(deaf)
        return deaf

    def is_silent(self, peer: str) -> bool:
        """Note that a peer has not answered; returns whether it is taken for deaf."""
        check = self._checks.get(peer)
        if check is None or check.silent >= MOST_SILENT:
            return False
        deaf = _count_unheard(check)
        # An end that has no time to answer must not be asked more often for it.
        check.due = max(check.due, self._ask_again(deaf))
        check.silent += deaf
        return deaf

    def _ask_again(self, deaf: bool) -> float:
        """The time of the next question; there is time for what is done about a deaf peer."""
        return self._now() + self._jitter(2 * FIRST_PAUSE if deaf else SECOND_PAUSE)

    def _jitter(self, seconds: float) -> float:
        return seconds * self._random.uniform(0.8, 1.2)


def _count_unheard(check: _Check) -> bool:
    """Count an answer that the link is not heard, or none; returns whether that makes the peer deaf."""
    check.unheard = (check.unheard + 1) % DEAF
    return check.unheard == 0
