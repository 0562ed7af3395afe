"""`Reception`, when each frame of a recording was heard: its stamps and the times of their arrival."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tfbus.recording.recording import RecordedMessage
from tfbus.stamps import SECOND, Stamps, time_between

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Reception:
    """The times at which one frame was heard.

    Parameters
    ----------
    frame : str
    stamps : integer array of shape (n,)
        The stamps of its moving samples in the order of their arrival, in ns.
    received : integer array of shape (n,)
        The log times at which they arrived, in ns.
    static : bool
        Whether it has static samples only.
    """

    frame: str
    stamps: Stamps
    received: Stamps
    static: bool

    @property
    def periods(self) -> Floats:
        """The times between two successive stamps, in s, shape (m - 1,) for m different stamps."""
        stamps = np.unique(self.stamps)
        return time_between(stamps[:-1], stamps[1:]).astype(np.float64) / SECOND

    @property
    def delays(self) -> Floats:
        """The time from each stamp to its arrival, in s, shape (n,)."""
        return time_between(self.stamps, self.received).astype(np.float64) / SECOND


def read_reception(messages: Iterable[RecordedMessage]) -> dict[str, Reception]:
    """The reception of each frame, by frame, sorted by name.

    Parameters
    ----------
    messages : iterable of RecordedMessage
        Such as ``open_recording(path).messages()``.
    """
    stamps: dict[str, list[int]] = {}
    received: dict[str, list[int]] = {}
    for message in messages:
        for sample in message.batch:
            _, child, stamp, _, _, static = sample._fields
            times = stamps.setdefault(child, [])
            arrivals = received.setdefault(child, [])
            if not static:
                times.append(stamp)
                arrivals.append(message.received)
    return {
        frame: Reception(
            frame, np.array(stamps[frame], np.int64), np.array(received[frame], np.int64), not stamps[frame]
        )
        for frame in sorted(stamps)
    }
