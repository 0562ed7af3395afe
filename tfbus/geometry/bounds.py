"""The bound on translations: what is further away is no measurement, and may make an answer infinite."""

import math

from tfbus.errors import InvalidTransformError
from tfbus.geometry.stamped import Batch, TransformStamped
from tfbus.stamps import is_real

MAX_TRANSLATION = 1e12
"""The default bound on the magnitude of a translation, in m: about six times the way to Saturn."""
GREATEST_BOUND = 1e100
"""The greatest bound, in m. The square of a translation, and the sum along any path, are finite below it."""


def as_max_translation(bound: float) -> float:
    """The argument `max_translation`, in m, as a float.

    Raises
    ------
    TypeError
        If it is not a real number.
    ValueError
        If it is not greater than zero, or greater than 1e100.
    """
    if not is_real(bound):
        raise TypeError(f"max_translation must be a number in m, not {bound!r}")
    if not 0.0 < bound <= GREATEST_BOUND:
        raise ValueError(f"max_translation must be greater than 0 and at most {GREATEST_BOUND:g} m, got {bound!r}")
    return float(bound)


def is_within(sample: TransformStamped, bound: float) -> bool:
    """Whether the translation of a sample is finite, and no longer than `bound` in m."""
    # The square is quicker to have, and only near the bound may it be on the other side than the magnitude.
    return sample._square < 0.99 * bound * bound or math.hypot(*sample._row[:3]) <= bound


def check_translations(batch: Batch, bound: float) -> None:
    """Raise `InvalidTransformError` for the first sample whose translation is longer than `bound` in m."""
    for sample in batch:
        if not is_within(sample, bound):
            raise not_physical(sample, bound)


def not_physical(sample: TransformStamped, bound: float) -> InvalidTransformError:
    """The error of a sample that is not within the bound, in m.

    Its reason is ``"not physical"``; or ``"not finite"``, which the product of two transforms may be.
    """
    parent, child, _, row, authority, _ = sample._fields
    length = math.hypot(*row[:3])
    if all(map(math.isfinite, row[:3])):
        why, reason = f"{length:.6g} m long, which is not physical (at most {bound:g} m)", "not physical"
    else:
        why, reason = "not finite", "not finite"
    sender = f", from {authority!r}" if authority else ""
    return InvalidTransformError(
        f"the translation of {child!r} in {parent!r} is {why}{sender}",
        reason=reason,
        parent=parent,
        child=child,
        authority=authority,
    )
