"""The rules for a sample itself: how long its translation may be, and how far its stamp may be ahead of the clock."""

import math
from collections.abc import Iterator
from contextlib import contextmanager

from tfbus.clock import Clock, SimulatedClock
from tfbus.errors import InvalidTransformError
from tfbus.geometry.bounds import as_max_translation, is_within, not_physical
from tfbus.geometry.stamped import Batch, TransformStamped
from tfbus.stamps import STAMP_MAX, as_duration, format_duration, format_stamp, from_seconds


class Plausibility:
    """Judges translations and stamps.

    Parameters
    ----------
    clock : Clock
    max_translation : float
        The greatest length of a translation, in m.
    max_ahead : float or None
        How far a stamp may be ahead of the clock, in s; None for any distance.
    reject_ahead : bool
        Whether samples that are further ahead are refused.

    Raises
    ------
    TypeError, ValueError
        If `max_translation` is not greater than zero and at most 1e100, `max_ahead` is not a duration, or
        `reject_ahead` comes without a `max_ahead`.

    Attributes
    ----------
    max_translation : float
    rejects_ahead : bool
    clock_jumped : bool
        Whether a jump of the clock was announced. Until then a `SimulatedClock` at 0 counts as one that nobody has set.
    """

    def __init__(self, clock: Clock, max_translation: float, max_ahead: float | None, reject_ahead: bool) -> None:
        self.max_translation = as_max_translation(max_translation)
        seconds = math.inf if max_ahead is None else as_duration(max_ahead, "max_ahead")
        self._max_ahead = None if seconds == math.inf else from_seconds(seconds)
        if reject_ahead and self._max_ahead is None:
            raise ValueError("reject_ahead needs a max_ahead: without one, no stamp is ahead of the clock")
        self.rejects_ahead = reject_ahead
        self._clock = clock
        self._simulated = isinstance(clock, SimulatedClock)
        self._recorded = 0
        self.clock_jumped = False

    @property
    def clock_is_set(self) -> bool:
        """Whether the clock has a time that stamps can be compared with."""
        return not self._simulated or self.clock_jumped or self._clock.now() != 0

    def newest_plausible(self) -> int:
        """The greatest stamp, in ns, that is not ahead of the clock now; `STAMP_MAX` if none is."""
        if self._max_ahead is None or self._recorded or not self.clock_is_set:
            return STAMP_MAX
        return min(self._clock.now() + self._max_ahead, STAMP_MAX)

    @contextmanager
    def recorded_time(self) -> Iterator[None]:
        """A ``with`` for samples whose stamps are of another clock; none of them is ahead."""
        self._recorded += 1
        try:
            yield
        finally:
            self._recorded -= 1

    def split(self, batch: Batch) -> tuple[Batch, list[InvalidTransformError], Batch]:
        """The samples of a batch that may go on, the errors of the others, and the samples that are ahead, in order.

        A static sample is never ahead, because it holds at every stamp.
        """
        newest = self.newest_plausible()
        allowed: list[TransformStamped] = []
        refused: list[InvalidTransformError] = []
        ahead: list[TransformStamped] = []
        for sample in batch:
            _, _, stamp, _, _, static = sample._fields
            if not is_within(sample, self.max_translation):
                refused.append(not_physical(sample, self.max_translation))
                continue
            if stamp > newest and not static:
                ahead.append(sample)
                if self.rejects_ahead:
                    refused.append(self._too_far_ahead(sample))
                    continue
            allowed.append(sample)
        return tuple(allowed), refused, tuple(ahead)

    def _too_far_ahead(self, sample: TransformStamped) -> InvalidTransformError:
        parent, child, stamp, _, authority, _ = sample._fields
        assert self._max_ahead is not None
        ahead, bound = format_duration(stamp - self._clock.now()), format_duration(self._max_ahead)
        return InvalidTransformError(
            f"frame {child!r}: the stamp {format_stamp(stamp)} from {authority!r} is {ahead} ahead of the clock "
            f"(at most {bound})",
            reason="ahead",
            parent=parent,
            child=child,
            authority=authority,
        )
