"""Hypothesis strategies for what tfbus takes, with the rotations and names that have broken code before."""

import math
from functools import cache

from hypothesis import strategies as st

from tfbus import SECOND, Transform, TransformStamped
from tfbus.rows import Quaternion, Vector
from tfbus.stamps import STAMP_MAX, STAMP_MIN

TODAY = 1_790_000_000 * SECOND
"""A stamp of the size that a wall clock gives."""

_AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))


@cache
def vectors(limit: float = 1_000.0) -> st.SearchStrategy[Vector]:
    """Three numbers from -limit to limit."""
    number = st.floats(-limit, limit)
    return st.tuples(number, number, number)


@cache
def unit_vectors() -> st.SearchStrategy[Vector]:
    """The axes, and anything between them."""
    return st.sampled_from(_AXES) | vectors(1.0).filter(lambda vector: math.hypot(*vector) > 0.1).map(_normalised)


def _normalised(vector: Vector) -> Vector:
    x, y, z = vector
    length = math.hypot(x, y, z)
    return x / length, y / length, z / length


@cache
def small_angles() -> st.SearchStrategy[float]:
    """From 1e-12 to 1e-3 rad, every decade as likely as the next."""
    return st.floats(-12.0, -3.0).map(lambda exponent: 10.0**exponent)


@cache
def angles() -> st.SearchStrategy[float]:
    """Rad from -pi to pi: anything, next to nothing, nearly half a turn, and the right angles."""
    return st.one_of(
        st.floats(-math.pi, math.pi),
        small_angles(),
        small_angles().map(lambda angle: math.pi - angle),
        st.sampled_from((0.0, math.pi / 2, math.pi, -math.pi / 2)),
    )


@st.composite
def rotations(draw: st.DrawFn) -> Quaternion:
    """Unit quaternions (x, y, z, w) of either sign."""
    x, y, z = draw(unit_vectors())
    half = draw(angles()) / 2.0
    sign = draw(st.sampled_from((1.0, -1.0)))
    sine = sign * math.sin(half)
    return x * sine, y * sine, z * sine, sign * math.cos(half)


@cache
def transforms(limit: float = 1_000.0) -> st.SearchStrategy[Transform]:
    """Transforms with translations from -limit to limit m in each axis."""
    return st.builds(Transform, vectors(limit), rotations())


CHARACTERS = st.characters(exclude_categories=["Cs"])
"""The default alphabet of `st.text`, which takes hypothesis seconds in each process to work out from a codec."""


@cache
def frame_names() -> st.SearchStrategy[str]:
    """Everything that may name a frame: blanks, quotes, newlines, any alphabet."""
    odd = st.sampled_from(("base link", " ", 'a"b', "a\\b", "a\nb", "a/b", "NO_PARENT", "küche", "腕", "🦾", "null"))
    return odd | st.text(CHARACTERS, min_size=1, max_size=12).filter(lambda name: not name.startswith("/"))


@cache
def stamps(low: int = STAMP_MIN, high: int = STAMP_MAX) -> st.SearchStrategy[int]:
    """Nanoseconds from low to high; where the range allows it, often near zero and near today's."""
    ranges = [st.integers(low, high)]
    for middle in (0, TODAY):
        near, far = max(low, middle - SECOND), min(high, middle + SECOND)
        if near <= far:
            ranges.append(st.integers(near, far))
    return st.one_of(ranges)


@st.composite
def samples(
    draw: st.DrawFn,
    names: st.SearchStrategy[str] | None = None,
    at: st.SearchStrategy[int] | None = None,
    static: st.SearchStrategy[bool] | None = None,
) -> TransformStamped:
    """Samples between two different frames."""
    names = frame_names() if names is None else names
    parent = draw(names)
    child = draw(names.filter(lambda name: name != parent))
    stamp = draw(stamps() if at is None else at)
    kind = draw(st.booleans() if static is None else static)
    return TransformStamped(parent, child, stamp, draw(transforms()), draw(st.sampled_from(("", "odometry"))), kind)
