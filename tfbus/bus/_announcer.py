"""Announces events to the streams that read them."""

from collections.abc import Callable, Sequence
from typing import Protocol

from tfbus.events import Event


class Listener(Protocol):
    """A reader of events."""

    def put(self, event: Event) -> object: ...


class Announcer:
    """Passes each event to all listeners.

    Check `has_listeners` before making an event: most programs have none, and an event costs more than the check.

    Parameters
    ----------
    now : callable
        Gives the present stamp in ns, which events carry.
    listeners : sequence of Listener
        The bus adds and removes listeners here.
    """

    def __init__(self, now: Callable[[], int], listeners: Sequence[Listener] = ()) -> None:
        self.now = now
        self._listeners = listeners

    @property
    def has_listeners(self) -> bool:
        """Whether anybody reads events."""
        return len(self._listeners) > 0

    def announce(self, event: Event) -> None:
        """Pass an event to every listener."""
        for listener in self._listeners:
            listener.put(event)
