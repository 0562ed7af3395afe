"""Short ways to write samples of which only the parent, the stamp and x matter."""

from tfbus import Transform, TransformStamped


def moving(parent: str, child: str, stamp: int, x: float = 0.0, authority: str = "") -> TransformStamped:
    """A moving sample, `x` m along the first axis."""
    return TransformStamped(parent, child, stamp, Transform((x, 0.0, 0.0)), authority)


def static(parent: str, child: str, x: float = 0.0, stamp: int = 0, authority: str = "") -> TransformStamped:
    """A static sample, `x` m along the first axis."""
    return TransformStamped(parent, child, stamp, Transform((x, 0.0, 0.0)), authority, static=True)
