"""A link's account of what its carrier has sent."""

from collections import Counter
from collections.abc import Callable


class SendReport:
    """Counts what a carrier has sent, and what it could not send; for the event loop only.

    Parameters
    ----------
    warn : callable
        Called with the error of everything that could not be sent.

    Attributes
    ----------
    messages, samples : int
        What was handed to the network.
    not_sent : Counter
        Samples and removals that no message can hold, by reason.
    """

    def __init__(self, warn: Callable[[Exception], object]) -> None:
        self._warn = warn
        self.messages = 0
        self.samples = 0
        self.not_sent: Counter[str] = Counter()

    def sent(self, samples: int) -> None:
        """Count one message with so many samples."""
        self.messages += 1
        self.samples += samples

    def refused(self, reason: str, error: Exception, count: int = 1) -> None:
        """Count samples and removals that the carrier's messages cannot hold."""
        self.not_sent[reason] += count
        self._warn(error)

    def failed(self, error: Exception) -> None:
        """Tell of a message that the network did not accept."""
        self._warn(error)
