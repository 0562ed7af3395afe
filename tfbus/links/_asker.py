"""The times at which peers are asked for what was missed: soon, again after a while, and not all at once."""

from collections.abc import Callable
from dataclasses import dataclass
from random import Random

SETTLING = 0.05
"""s; what live messages bring by themselves has come by then, nearly always."""
FIRST_PAUSE = 0.2
LONGEST_PAUSE = 5.0
PATIENCE = 2.0
LONGEST_PATIENCE = 16.0
"""s without an answer, after which a question counts as lost: at first, and then twice that time, up to the longest.

A peer that has no time would else be asked again for what it is about to answer, and have less time for that.
"""
PATIENCE_EACH = 0.15
"""s more for each other question that is open: many are open where many links start at once, and nobody has time."""
MOST_OPEN = 64
"""So many questions are open at once: where nobody has time each takes seconds, and few at a time take minutes."""


@dataclass(slots=True)
class _Question:
    due: float
    open: bool = False
    pause: float = FIRST_PAUSE
    patience: float = PATIENCE


class Asker:
    """Decides when to ask which peer.

    A pause between two questions to one peer doubles while nothing helps, up to `LONGEST_PAUSE`, and has a jitter, so
    that many links that have missed the same thing do not ask in one moment.

    Parameters
    ----------
    now : callable
        Returns a monotonic time in s.
    random : Random, optional
    """

    def __init__(self, now: Callable[[], float], random: Random | None = None) -> None:
        self._now = now
        self._random = Random() if random is None else random
        self._questions: dict[str, _Question] = {}

    def want(self, peer: str, at_once: bool = False) -> bool:
        """Have a peer asked; returns whether that is new."""
        if peer in self._questions:
            return False
        wait = 0.0 if at_once else self._jitter(SETTLING)
        self._questions[peer] = _Question(self._now() + wait)
        return True

    def satisfied(self, peer: str) -> None:
        """Have a peer not asked any more, because nothing is missing or it has gone."""
        self._questions.pop(peer, None)

    def progressed(self, peer: str) -> None:
        """Have a peer asked again at once, because its answer has helped and more is missing."""
        self._questions[peer] = _Question(self._now())

    def failed(self, peer: str) -> None:
        """Have a peer asked again after a pause, because its answer did not help, or there was none."""
        question = self._questions.get(peer)
        if question is not None:
            self._pause(question)

    def take_due(self) -> list[str]:
        """The peers to ask now; each of them counts as asked."""
        now = self._now()
        for question in self._questions.values():
            if question.open and question.due <= now:
                question.patience = min(2 * question.patience, LONGEST_PATIENCE)
                self._pause(question)
        already_open = sum(question.open for question in self._questions.values())
        due = [peer for peer, question in self._questions.items() if not question.open and question.due <= now]
        asked = due[: max(MOST_OPEN - already_open, 0)]
        others = already_open + len(asked) - 1
        for peer in asked:
            question = self._questions[peer]
            question.open = True
            question.due = now + question.patience + PATIENCE_EACH * others
        return asked

    def next_due(self) -> float | None:
        """The time of the next call of `take_due`; None while nobody is to be asked."""
        full = sum(question.open for question in self._questions.values()) >= MOST_OPEN
        return min((one.due for one in self._questions.values() if one.open or not full), default=None)

    def _pause(self, question: _Question) -> None:
        question.open = False
        question.due = self._now() + self._jitter(question.pause)
        question.pause = min(2 * question.pause, LONGEST_PAUSE)

    def _jitter(self, seconds: float) -> float:
        return seconds * self._random.uniform(0.5, 1.5)
