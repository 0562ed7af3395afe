"""Poses that turn about one tilted axis only, so that complex numbers are enough to work them out."""

import cmath
import math
from dataclasses import dataclass

from tfbus import Transform

AXIS = (1 / 3, 2 / 3, 2 / 3)
ACROSS = (2 / 3, 1 / 3, -2 / 3)
"""At right angles to the axis; so is the next one, which is the axis times this one."""
ACROSS_TOO = (-2 / 3, 2 / 3, -1 / 3)


@dataclass(frozen=True)
class Pose:
    """A turn by `angle` rad about the axis, then a shift in m: `across` in the plane of the turn, `along` the axis."""

    angle: float
    across: complex
    along: float

    def __matmul__(self, other: "Pose") -> "Pose":
        turned = cmath.rect(1.0, self.angle) * other.across
        return Pose(self.angle + other.angle, self.across + turned, self.along + other.along)

    def inverse(self) -> "Pose":
        return Pose(-self.angle, -cmath.rect(1.0, -self.angle) * self.across, -self.along)

    def towards(self, other: "Pose", fraction: float) -> "Pose":
        """A straight line and an even turn. The two are less than half a turn apart, so this is the shorter arc."""
        return Pose(
            self.angle + fraction * (other.angle - self.angle),
            self.across + fraction * (other.across - self.across),
            self.along + fraction * (other.along - self.along),
        )

    def transform(self) -> Transform:
        parts = zip(ACROSS, ACROSS_TOO, AXIS, strict=True)
        x, y, z = (self.across.real * u + self.across.imag * v + self.along * w for u, v, w in parts)
        sine = math.sin(self.angle / 2)
        qx, qy, qz = (sine * part for part in AXIS)
        return Transform((x, y, z), (qx, qy, qz, math.cos(self.angle / 2)))

    def is_close(self, found: Transform) -> bool:
        """Whether a transform is this pose; the sign of the quaternion does not matter."""
        expected = self.transform()
        apart = math.dist(found.translation, expected.translation)
        cosine = sum(mine * its for mine, its in zip(expected.rotation, found.rotation, strict=True))
        return apart < 1e-9 and abs(cosine) > 1 - 1e-12


def pose(number: int) -> Pose:
    """One of many different poses, all less than half a turn apart."""
    return Pose((number * 7 % 29 - 14) / 10, complex(number % 11 - 5, number % 7 - 3), float(number % 13))
