"""The faults in the samples of one frame, found in numpy."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tfbus.analysis.finding import Finding
from tfbus.analysis.limits import Limits
from tfbus.stamps import SECOND, STAMP_MAX, time_between, to_seconds

_OUTLIER = 20.0
"""The least speed of a jump, as a multiple of the median speed of its frame."""
_MIN_MOVES = 20
"""The number of moves from which the median is taken for usual."""
_MIN_STEP = 0.1
_MIN_TURN = 0.5
"""m and rad; a smaller one is no jump, unless its speed is beyond the bound."""
_WINDOWS = 10
_MIN_IN_WINDOW = 5
_GAP = 10.0


@dataclass(frozen=True, slots=True)
class MovingSamples:
    """The moving samples of a frame in the order of their arrival, or of their stamps.

    Parameters
    ----------
    frame : str
    stamps : int64 array of shape (n,)
        ns.
    rows : float64 array of shape (n, 7)
    parents : int array of shape (n,)
        The number of the parent of each.
    authorities : int array of shape (n,)
    received : int64 array of shape (n,), optional
        When each arrived, in ns; None if they are in the order of their stamps.
    """

    frame: str
    stamps: npt.NDArray[np.int64]
    rows: npt.NDArray[np.float64]
    parents: npt.NDArray[np.int64]
    authorities: npt.NDArray[np.int64]
    received: npt.NDArray[np.int64] | None

    def findings(self, limits: Limits) -> Iterator[Finding]:
        """All that is wrong."""
        yield from self._arrivals(limits)
        order = np.argsort(self.stamps, kind="stable")
        stamps, rows, parents = self.stamps[order], self.rows[order], self.parents[order]
        with np.errstate(over="ignore", invalid="ignore"):
            lengths = np.sqrt((rows[:, :3] ** 2).sum(axis=1))
        far = ~(lengths <= limits.translation)
        yield from self._at("translation", far, stamps, lengths, "m", f"farther than {limits.translation:g} m")
        last = np.append(stamps[1:] != stamps[:-1], True)
        yield from self._at("duplicate stamps", ~last, stamps, None, "", "stamps that came before")
        # Of one stamp, the last sample holds. What is far off anyway is no jump.
        good = last & ~far
        stamps, rows, parents = stamps[good], rows[good], parents[good]
        # The difference of stamps that are centuries apart does not fit.
        if len(stamps) < 2 or int(stamps[-1]) - int(stamps[0]) > STAMP_MAX:
            return
        yield from self._jumps(limits, stamps, rows, parents)
        yield from self._rates(limits, stamps)

    def _arrivals(self, limits: Limits) -> Iterator[Finding]:
        if self.received is None:
            return
        newest = np.maximum.accumulate(self.stamps)
        back = time_between(self.stamps, newest)
        yield from self._at("stamps go back", back > 0, self.stamps, back / SECOND, "s", "older than one before")
        ahead = time_between(self.received, self.stamps) / SECOND
        yield from self._at("ahead", ahead > limits.ahead, self.stamps, ahead, "s", "stamped ahead of its arrival")

    def _jumps(
        self,
        limits: Limits,
        stamps: npt.NDArray[np.int64],
        rows: npt.NDArray[np.float64],
        parents: npt.NDArray[np.int64],
    ) -> Iterator[Finding]:
        # Another parent means other coordinates.
        same = parents[1:] == parents[:-1]
        times = (np.diff(stamps) / SECOND)[same]
        after = stamps[1:][same]
        steps = np.sqrt((np.diff(rows[:, :3], axis=0) ** 2).sum(axis=1))[same]
        cosine = np.abs((rows[1:, 3:] * rows[:-1, 3:]).sum(axis=1))[same]
        # The distance of the quaternions is exact for small angles, where the cosine is not.
        difference = np.minimum(
            ((rows[1:, 3:] - rows[:-1, 3:]) ** 2).sum(axis=1), ((rows[1:, 3:] + rows[:-1, 3:]) ** 2).sum(axis=1)
        )[same]
        angles = np.where(cosine < 0.9, 2 * np.arccos(np.minimum(cosine, 1.0)), 4 * np.arcsin(np.sqrt(difference) / 2))
        for kind, moves, least, bound, unit, what in (
            ("jump", steps, _MIN_STEP, limits.speed, "m/s", "moves faster than it can"),
            ("turn", angles, _MIN_TURN, limits.turn_rate, "rad/s", "turns faster than it can"),
        ):
            speeds = moves / times
            usual = speeds[speeds > 0]
            outlying = np.zeros(len(speeds), bool)
            if len(usual) >= _MIN_MOVES:
                outlying = (speeds > _OUTLIER * np.median(usual)) & (moves > least)
            yield from self._at(kind, (speeds > bound) | outlying, after, speeds, unit, what)

    def _rates(self, limits: Limits, stamps: npt.NDArray[np.int64]) -> Iterator[Finding]:
        times = np.diff(stamps) / SECOND
        usual = float(np.median(times))
        pauses = times > _GAP * usual
        yield from self._at(
            "gap",
            pauses & (times > limits.gap),
            stamps[:-1],
            times,
            "s",
            f"no sample for long, usually every {usual:.4g} s",
        )
        counts, edges = np.histogram(stamps - stamps[0], _WINDOWS)
        width = to_seconds(int(stamps[-1] - stamps[0])) / _WINDOWS
        expected = float(np.median(counts))
        # A window that a pause explains is not told twice.
        lost = np.zeros(_WINDOWS)
        for start, length in zip(stamps[:-1][pauses], times[pauses], strict=True):
            first = to_seconds(int(start - stamps[0])) / width
            for window in range(int(first), min(_WINDOWS, int(first + length / width) + 1)):
                lost[window] += max(0.0, min(window + 1, first + length / width) - max(window, first))
        low = (counts < expected / 2 * (1 - lost)) & (expected >= _MIN_IN_WINDOW) & (lost < 0.9)
        if low.any():
            worst = int(np.argmin(np.where(low, counts, expected)))
            first = int(stamps[0] + edges[int(np.argmax(low))])
            detail = f"its rate breaks down from {expected / width:.4g} Hz for a tenth of the time"
            at = int(stamps[0] + edges[worst])
            yield Finding("rate", self.frame, int(low.sum()), first, float(counts[worst]) / width, "Hz", detail, at)

    def _at(
        self,
        kind: str,
        wrong: npt.NDArray[np.bool_],
        stamps: npt.NDArray[np.int64],
        values: npt.NDArray[np.float64] | None,
        unit: str,
        detail: str,
    ) -> Iterator[Finding]:
        """The finding for the samples that are wrong, if there are any."""
        places = np.flatnonzero(wrong)
        if not len(places):
            return
        first = int(stamps[places[0]])
        if values is None:
            yield Finding(kind, self.frame, len(places), first, None, unit, detail)
            return
        worst = int(places[np.argmax(values[places])])
        yield Finding(kind, self.frame, len(places), first, float(values[worst]), unit, detail, int(stamps[worst]))
