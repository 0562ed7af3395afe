"""The answers to peers that ask for a link's state; peers with the same question get the same answer."""

from collections.abc import Callable, Sequence
from typing import Any

from tfbus.links._state import CHUNK, LinkState, StateEntry, StateStep

MOST_KEPT = 8
"""So many answers are kept for those who ask next: links that start together ask for the same at the same time."""


class StateTeller:
    """Writes the changes of a state behind a number as a message, once for all who ask for them.

    Parameters
    ----------
    state : LinkState
    write : callable
        Writes changes and their step as a message; raises `ValueError` if one message cannot hold so many.
    """

    def __init__(self, state: LinkState, write: Callable[[Sequence[StateEntry], StateStep], Any]) -> None:
        self._state = state
        self._write = write
        self._number = state.number
        self._kept: dict[int, Any] = {}

    def answer(self, since: int) -> Any:
        """The message with the oldest changes behind a number; None if no message can hold even one of them."""
        if self._number != self._state.number:
            self._number = self._state.number
            self._kept.clear()
        if since not in self._kept:
            written = self._written(since)
            if len(self._kept) >= MOST_KEPT:
                del self._kept[next(iter(self._kept))]
            self._kept[since] = written
        return self._kept[since]

    def _written(self, since: int) -> Any:
        limit = CHUNK
        while limit:
            try:
                return self._write(*self._state.changes(since, limit))
            except ValueError:
                limit //= 2
        return None
