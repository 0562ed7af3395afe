"""Measurements of samples as they arrive: rates, delays, gaps and losses of each frame and sender."""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np

from tfbus.geometry.stamped import Batch
from tfbus.stamps import SECOND, format_duration, from_seconds, time_between

_WEIGHT = 0.1
"""The weight of the newest sample in the mean."""


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


MAX_SAMPLES: Final = 20_000
"""The greatest number of samples that are kept for a frame and sender; older ones are dropped from the window."""


@dataclass(frozen=True, slots=True)
class Arrival:
    """The samples of one frame from one sender within a window; durations in s, None where there are too few samples.

    Attributes
    ----------
    frame, parent, authority : str
        The parent is from the newest sample.
    static : bool
        Whether the newest sample is static; such a frame is not measured.
    samples : int
        The samples in the window.
    rate : float or None
        Arrivals a second.
    delay_mean, delay_p99, delay_max, delay_min : float or None
        The mean, the 99th percentile, the maximum and the minimum of arrival minus stamp; negative if the clock of the
        sender is ahead.
    jitter : float or None
        The standard deviation of the time between two arrivals.
    longest_gap : float or None
        The longest time between two arrivals, or since the last one.
    late : int
        Samples with an older stamp than a sample before them.
    lost : int
        Samples that are missing between the stamps, by the median period; an estimate, for senders with a fixed rate
        only.

    Examples
    --------
    >>> from tfbus.analysis import Arrivals
    >>> arrivals = Arrivals(window=5.0)
    >>> for stamp in range(0, SECOND, SECOND // 10):
    ...     arrivals.note([TransformStamped("odom", "base", stamp, Transform(), "wheels")], stamp)
    >>> [(arrival.frame, round(arrival.rate)) for arrival in arrivals.measure(SECOND)]
    [('base', 10)]
    """

    frame: str
    parent: str
    authority: str
    static: bool
    samples: int
    rate: float | None
    delay_mean: float | None
    delay_p99: float | None
    delay_max: float | None
    jitter: float | None
    longest_gap: float | None
    late: int
    lost: int
    delay_min: float | None = None


class Arrivals:
    """Measures the arriving samples, over a window that ends now.

    Parameters
    ----------
    window : float
        Its length in s.

    Examples
    --------
    >>> from tfbus.analysis import Arrivals
    >>> arrivals = Arrivals(window=5.0)
    >>> for stamp in range(0, SECOND, SECOND // 10):
    ...     arrivals.note((TransformStamped("map", "cart", stamp, Transform()),), stamp)
    >>> [(each.frame, each.samples) for each in arrivals.measure(SECOND)]
    [('cart', 10)]
    """

    def __init__(self, window: float) -> None:
        self._window = from_seconds(window)
        self._received: dict[tuple[str, str], _Received] = {}

    def note(self, batch: Batch, now: int) -> None:
        """Count the samples of a batch that arrives at the stamp `now`, in ns.

        Examples
        --------
        >>> from tfbus.analysis import Arrivals
        >>> arrivals = Arrivals(window=5.0)
        >>> arrivals.note((TransformStamped("map", "cart", 0, Transform(), "odometry"),), now=10)
        >>> arrivals.measure(10)[0].authority
        'odometry'
        """
        for sample in batch:
            key = sample.child, sample.authority
            received = self._received.get(key)
            if received is None:
                received = self._received[key] = _Received()
            received.parent, received.static = sample.parent, sample.static
            if not sample.static:
                received.times.append((now, sample.stamp))

    def forget(self, frame: str) -> None:
        """Forget a frame that was removed.

        Examples
        --------
        >>> from tfbus.analysis import Arrivals
        >>> arrivals = Arrivals(window=5.0)
        >>> arrivals.note((TransformStamped("map", "cart", 0, Transform()),), now=10)
        >>> arrivals.forget("cart")
        >>> arrivals.measure(10)
        []
        """
        for key in [key for key in self._received if key[0] == frame]:
            del self._received[key]

    def measure(self, now: int) -> list[Arrival]:
        """Each frame and sender, sorted by both; a pair that was silent for the whole window stays, without a rate.

        Examples
        --------
        >>> from tfbus.analysis import Arrivals
        >>> Arrivals(window=5.0).measure(0)
        []
        """
        found = []
        for (frame, authority), received in sorted(self._received.items()):
            times = received.times
            while times and times[0][0] < now - self._window:
                times.popleft()
            found.append(received.measured(frame, authority, now))
        return found


class _Received:
    """The arrivals and stamps of one frame and sender, in ns."""

    def __init__(self) -> None:
        self.parent = ""
        self.static = False
        self.times: deque[tuple[int, int]] = deque(maxlen=MAX_SAMPLES)

    def measured(self, frame: str, authority: str, now: int) -> Arrival:
        count = len(self.times)
        if not count:
            unknown = (None, None, None, None, None, None)
            return Arrival(frame, self.parent, authority, self.static, 0, *unknown, late=0, lost=0)
        arrived, stamps = np.array(self.times, np.int64).T
        delays = np.sort(time_between(stamps, arrived)) / SECOND
        periods = time_between(arrived[:-1], arrived[1:]) / SECOND
        several = count > 1 and arrived[-1] > arrived[0]
        return Arrival(
            frame,
            self.parent,
            authority,
            self.static,
            count,
            rate=(count - 1) * SECOND / (int(arrived[-1]) - int(arrived[0])) if several else None,
            delay_mean=float(delays.mean()),
            delay_p99=float(delays[-(-99 * count // 100) - 1]),
            delay_max=float(delays[-1]),
            delay_min=float(delays[0]),
            jitter=float(periods.std()) if count > 1 else None,
            longest_gap=max(float(periods.max(initial=0.0)), (now - int(arrived[-1])) / SECOND),
            late=int(np.count_nonzero(stamps[1:] < np.maximum.accumulate(stamps)[:-1])),
            lost=_lost(time_between((different := np.unique(stamps))[:-1], different[1:])),
        )


ANOTHER_CLOCK: Final = 1e8
"""s; clocks that differ by more do not count the same time."""
_AHEAD: Final = 1e-3
_LATE: Final = 0.1


@dataclass(frozen=True, slots=True)
class SenderDelay:
    """The evidence that arrivals alone give of the clock of a sender that answers nothing.

    Attributes
    ----------
    authority : str
    delay : float
        The smallest time from a stamp to the arrival of its sample within the window, in s. The clock of the sender is
        behind by this much less the unknown time that its samples take.
    """

    authority: str
    delay: float

    @property
    def remark(self) -> str:
        """The conclusion in words; empty if there is none."""
        if abs(self.delay) > ANOTHER_CLOCK:
            return "another clock (simulated?)"
        if self.delay < -_AHEAD:
            return f"its clock is at least {format_duration(from_seconds(-self.delay))} ahead of this one"
        return "late, or its clock is behind this one" if self.delay > _LATE else ""


def sender_delays(arrivals: Iterable[Arrival]) -> list[SenderDelay]:
    """The smallest delay of each sender, sorted by their names."""
    least: dict[str, float] = {}
    for arrival in arrivals:
        if arrival.delay_min is not None:
            least[arrival.authority] = min(arrival.delay_min, least.get(arrival.authority, arrival.delay_min))
    return [SenderDelay(authority, delay) for authority, delay in sorted(least.items())]


def _lost(steps: "np.ndarray[tuple[int], np.dtype[np.int64]]") -> int:
    """The number of samples that are missing where two stamps are several usual periods apart."""
    if len(steps) < 2:
        return 0
    return int((np.rint(steps / np.median(steps)).astype(np.int64) - 1).clip(0).sum())
