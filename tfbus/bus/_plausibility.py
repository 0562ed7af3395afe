"""The rules for a sample itself: how long its translation may be, and how far its stamp may be from the clock."""

import math
from collections.abc import Iterator
from contextlib import contextmanager

from tfbus.clock import Clock, SimulatedClock
from tfbus.errors import InvalidTransformError
from tfbus.geometry.bounds import as_max_translation, is_within, not_physical
from tfbus.geometry.stamped import Batch, TransformStamped
from tfbus.stamps import (
    SECOND,
    STAMP_MAX,
    STAMP_MIN,
    as_duration,
    format_duration,
    format_stamp,
    from_seconds,
    likely_cause,
)


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
    max_behind : float or None
        How far the stamp of a moving sample may be behind the clock, in s; None for any distance.

    Raises
    ------
    TypeError, ValueError
        If `max_translation` is not greater than zero and at most 1e100, `max_ahead` or `max_behind` is not a duration,
        or `reject_ahead` comes without a `max_ahead`.

    Attributes
    ----------
    max_translation : float
    rejects_ahead : bool
    lasting : int
        How long the plausible stamps may be used without looking at the clock, in ns; a simulated one tells its moves.
    """

    def __init__(
        self,
        clock: Clock,
        max_translation: float,
        max_ahead: float | None,
        reject_ahead: bool,
        max_behind: float | None = None,
    ) -> None:
        self.max_translation = as_max_translation(max_translation)
        self._max_ahead = _as_bound(max_ahead, "max_ahead")
        self._max_behind = _as_bound(max_behind, "max_behind")
        if reject_ahead and self._max_ahead is None:
            raise ValueError("reject_ahead needs a max_ahead: without one, no stamp is ahead of the clock")
        self.rejects_ahead = reject_ahead
        self._clock = clock
        self.lasting = STAMP_MAX if isinstance(clock, SimulatedClock) else SECOND // 10
        self._recorded = 0
        self._kept = 0

    def newest_plausible(self) -> int:
        """The greatest stamp, in ns, that is not ahead of the clock now; `STAMP_MAX` if none is."""
        if self._max_ahead is None or not self._compares:
            return STAMP_MAX
        return min(self._clock.now() + self._max_ahead, STAMP_MAX)

    def oldest_plausible(self) -> int:
        """The least stamp, in ns, that is not behind the clock now; `STAMP_MIN` if none is."""
        if self._max_behind is None or self._kept or not self._compares:
            return STAMP_MIN
        return max(self._clock.now() - self._max_behind, STAMP_MIN)

    @property
    def _compares(self) -> bool:
        """Whether stamps are of the clock, and it has a time."""
        return not self._recorded and bool(getattr(self._clock, "is_set", True))

    @contextmanager
    def recorded_time(self) -> Iterator[None]:
        """A ``with`` for samples whose stamps are of another clock; none of them is ahead or behind."""
        self._recorded += 1
        try:
            yield
        finally:
            self._recorded -= 1

    @contextmanager
    def kept_samples(self) -> Iterator[None]:
        """A ``with`` for samples that were kept for those who join later; none of them is behind."""
        self._kept += 1
        try:
            yield
        finally:
            self._kept -= 1

    def split(self, batch: Batch) -> tuple[Batch, list[InvalidTransformError], Batch, Batch]:
        """The samples of a batch that may go on, the errors of the others, and those that are ahead, and behind.

        All are in order. A static sample is never ahead or behind, because it holds at every stamp.
        """
        newest, oldest = self.newest_plausible(), self.oldest_plausible()
        allowed: list[TransformStamped] = []
        refused: list[InvalidTransformError] = []
        ahead: list[TransformStamped] = []
        behind: list[TransformStamped] = []
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
            elif stamp < oldest and not static:
                behind.append(sample)
            allowed.append(sample)
        return tuple(allowed), refused, tuple(ahead), tuple(behind)

    def _too_far_ahead(self, sample: TransformStamped) -> InvalidTransformError:
        parent, child, stamp, _, authority, _ = sample._fields
        assert self._max_ahead is not None
        now = self._clock.now()
        ahead, bound, cause = format_duration(stamp - now), format_duration(self._max_ahead), likely_cause(stamp, now)
        return InvalidTransformError(
            f"frame {child!r}: the stamp {format_stamp(stamp)} from {authority!r} is {ahead} ahead of the clock "
            f"(at most {bound}){cause and f': {cause}'}",
            reason="ahead",
            parent=parent,
            child=child,
            authority=authority,
        )


def _as_bound(seconds: float | None, name: str) -> int | None:
    """A bound in ns; None for any distance."""
    duration = math.inf if seconds is None else as_duration(seconds, name)
    return None if duration == math.inf else from_seconds(duration)
