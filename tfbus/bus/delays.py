"""`Delays`, which measures how long samples take from their stamp to their arrival."""

from tfbus.geometry.stamped import Batch
from tfbus.stamps import SECOND

_WEIGHT = 0.1
"""Of the newest sample in the mean."""


class Delays:
    """The running mean of the delay of each frame: the clock's now at the arrival of a sample, less its stamp.

    Only moving samples count. A delay may be negative, where the clocks of two machines differ.
    """

    def __init__(self) -> None:
        self.by_frame: dict[str, float] = {}
        """In s, by child."""

    def note(self, batch: Batch, now: int) -> None:
        """Count the samples of a batch that arrives at the stamp `now`, in ns."""
        means = self.by_frame
        for sample in batch:
            fields = sample._fields
            if fields[5]:
                means.pop(fields[1], None)
            else:
                delay = (now - fields[2]) / SECOND
                mean = means.get(fields[1])
                means[fields[1]] = delay if mean is None else mean + _WEIGHT * (delay - mean)

    def forget(self, frame: str) -> None:
        """Forget a frame that was removed."""
        self.by_frame.pop(frame, None)
