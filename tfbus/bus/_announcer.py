"""From what causes events to whoever reads them."""

from collections.abc import Callable, Sequence
from typing import Protocol

from tfbus.events import Event


class Listener(Protocol):
    """Somebody who is told of events."""

    def put(self, event: Event) -> object: ...


class Announcer:
    """Tells all listeners; false while there are none, so that nobody makes events for nobody.

    Parameters
    ----------
    now : callable
        The present stamp, in ns: events carry it.
    listeners : sequence of Listener
        Whoever is in it when something happens; somebody else adds and removes.
    """

    def __init__(self, now: Callable[[], int], listeners: Sequence[Listener] = ()) -> None:
        self.now = now
        self._listeners = listeners

    def __bool__(self) -> bool:
        return bool(self._listeners)

    def tell(self, event: Event) -> None:
        """Tell everybody."""
        for listener in self._listeners:
            listener.put(event)
