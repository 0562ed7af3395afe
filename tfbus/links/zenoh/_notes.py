"""The notes that zenoh's threads make for the task that keeps the sessions of a link connected."""

import math
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Literal, NamedTuple

import anyio
import zenoh

from tfbus._aio.loops import LoopWaker
from tfbus.links._receive_queue import Presence

MOST_ASKING = 1_000
"""So many questions, and so many links that hear this one, are noted at once."""
MOST_NOTED = 10_000
"""So many changes, connections, and answers each are noted at once."""


class Noted(NamedTuple):
    """All that was noted since it was taken last."""

    changes: list[tuple[str, Presence]]
    """Peers that have come, or gone by one of their ways."""
    connected: list[tuple[str, str, str]]
    """Connections that have come or gone: the session at the far end, and the addresses of the near and the far end."""
    asking: list[zenoh.Query]
    """Questions of links whether they are heard."""
    heard_by: list[tuple[str, list[str] | None, bytes]]
    """Answers of peers to such questions: the sessions of this link that they hear, or None for no answer, and whom
    else they know."""
    hearers: set[str]
    """Peers that have told by themselves that they hear this link."""


class Notes:
    """Takes notes from any thread, and wakes the event loop for them.

    Parameters
    ----------
    now : callable
        Returns a monotonic time in s.
    overflowed : callable, optional
        Called for each note that is left out, because there are too many of its kind.

    Attributes
    ----------
    since : float
        The time of the oldest note, in s; infinite while there is none.
    """

    def __init__(self, now: Callable[[], float], overflowed: Callable[[], object] = lambda: None) -> None:
        self._now = now
        self._overflowed = overflowed
        self._lock = threading.Lock()
        self._noted = Noted([], [], [], [], set())
        self._stirred = anyio.Event()
        self._waker = LoopWaker(lambda: self._stirred.set())
        self.since = math.inf

    def bind(self) -> None:
        """Wake the running event loop from now on."""
        self._waker.bind()

    def add_change(self, peer: str, presence: Presence) -> None:
        """Note that a peer has come or gone."""
        self._add("changes", (peer, presence))

    def add_connection(self, session: str, near: str, far: str) -> None:
        """Note that a connection to a session, between two addresses, has come or gone."""
        self._add("connected", (session, near, far))

    def add_question(self, query: zenoh.Query) -> bool:
        """Note a question whether its sender is heard; returns False, and notes nothing, if there are too many."""
        with self._lock:
            if len(self._noted.asking) >= MOST_ASKING:
                return False
            self._noted.asking.append(query)
            self._stir()
        return True

    def add_answer(self, peer: str, names: list[str] | None, named: bytes) -> None:
        """Note the answer of a peer to such a question."""
        self._add("heard_by", (peer, names, named))

    def add_hearer(self, peer: str) -> None:
        """Note that a peer hears this link, unless there are too many of them."""
        with self._lock:
            if len(self._noted.hearers) < MOST_ASKING:
                self._noted.hearers.add(peer)
                self._stir()

    def stir(self) -> None:
        """Wake the event loop for something that needs no note."""
        with self._lock:
            self._stir()

    def take(self) -> Noted:
        """Remove and return all notes."""
        with self._lock:
            noted, self._noted = self._noted, Noted([], [], [], [], set())
            self.since = math.inf
        return noted

    async def wait(self, due: float) -> None:
        """Wait until something is noted, or until a time."""
        self._stirred = anyio.Event()
        if self.since == math.inf:
            with anyio.move_on_after(due - self._now()):
                await self._stirred.wait()

    def _add(self, kind: Literal["changes", "connected", "heard_by"], note: Any) -> None:
        with self._lock:
            notes = getattr(self._noted, kind)
            is_full = len(notes) >= MOST_NOTED
            if not is_full:
                notes.append(note)
            self._stir()
        if is_full:
            self._overflowed()

    def _stir(self) -> None:
        self.since = min(self.since, self._now())
        # The loop is not bound yet, or has ended.
        with suppress(RuntimeError):
            self._waker.wake()
