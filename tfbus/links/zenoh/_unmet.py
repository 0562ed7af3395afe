"""The times at which a link looks after connections behind which it has met nobody.

Where many start at once and have little time, connections break and are made again from both ends, and zenoh sometimes
keeps one of which both ends have lost all that the other end has declared. Then neither hears the other, so neither
asks whether it is heard, as in `tfbus.links.zenoh._hearing`. All that they know is that they are connected.
"""

from collections.abc import Callable, Container

PAUSES = 3.0, 10.0, 30.0
"""s before each look; whoever is not met after the last one is no link, or has no right to be heard."""
MOST_UNMET = 1_000
"""So many connections are remembered, the first."""


class Unmet:
    """Decides when to look after which connection.

    Parameters
    ----------
    now : callable
        Returns a monotonic time in s.
    """

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._due: dict[str, tuple[float, int]] = {}

    def connected(self, session: str) -> None:
        """A connection to a session has come or gone, and no peer is known behind it."""
        if session in self._due or len(self._due) < MOST_UNMET:
            self._due[session] = self._now() + PAUSES[0], 1

    def take_due(self, present: Container[str]) -> list[str]:
        """The sessions to look after now; those that are present by now are left out for good."""
        now, due = self._now(), []
        for session, (when, looks) in tuple(self._due.items()):
            if session in present:
                del self._due[session]
            elif when <= now:
                due.append(session)
                if looks < len(PAUSES):
                    self._due[session] = now + PAUSES[looks], looks + 1
                else:
                    del self._due[session]
        return due
