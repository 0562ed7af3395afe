"""The covariances of one edge's errors at several stamps, by the kind that its sender named.

An error e(t) of an edge has six numbers along the axes of its parent (`tfbus.geometry.covariance`). Its covariance at a
stamp between two samples is S(t) = (1 - s) S0 + s S1, whatever the kind. The kinds differ in the covariance of e(t)
and e(u), for t before u:

*drift*: each motion adds an error of its own, so the child at u has the error of the child at t, carried along the
rigid body by the lever arm l = p(u) - p(t), and an independent one more: cov(e(u), e(t)) = A S(t), with A =
[[I, -l x], [0, I]]. Of the difference of the two, only S(u) - A S(t) A^T is left. A sender may also become surer, for
instance when it finds a place again; then there is no such increment. Let P = A S(t) A^T, W = P + S(u), and U D U^T the
eigenvectors and values of W^-1/2 P W^-1/2. In the directions with D > 1/2, where the error shrinks, time runs
backwards: the common part is C = W^1/2 U min(D, 1 - D) U^T W^1/2, which is P where nothing shrinks. The stamps form a
chain in order, each depending on the one before it only, so the covariance of all of them is positive semidefinite.

*constant*: one error at all stamps: cov(e(u), e(t)) = S(u)^1/2 S(t)^1/2, which is S if all are the same.

*independent*: the samples' errors are independent, and between two samples the two parts of the error, of covariance
(1 - s) S0 and s S1, are Brownian in their weight. So cov(e(u), e(t)) = (1 - s(u)) S0 + s(t) S1 between the same two
samples, which gives both S(t) for t = u and, in the difference of two close stamps, little; across a sample that both
are interpolated from, it is the product of its weights.

Stamps whose kinds differ count as independent of each other.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Self

import numpy as np

from tfbus.geometry.covariance import Covariance, Kind, Matrix, as_kind, lever_arm, root_of
from tfbus.plain import from_fields
from tfbus.rows import Vector

_SHRINKS = 1e-9
"""The negative part of an increment, as a part of the whole, from which an error counts as shrinking."""
_NOTHING = 1e-12


class Part(NamedTuple):
    """A sample that an edge's error was interpolated from."""

    stamp: int
    weight: float
    matrix: Matrix

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return {"stamp": self.stamp, "weight": self.weight, "covariance": self.matrix.ravel().tolist()}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """The sample from which `to_dict` made `data`; `ValueError` if it is none."""
        fields = from_fields(cls, data, {"stamp": int, "weight": float, "covariance": tuple[float, ...]})
        return cls(matrix=Covariance(fields.pop("covariance")).matrix, **fields)


class EdgeError(NamedTuple):
    """The error of one edge at one stamp.

    Attributes
    ----------
    stamp : int
        ns; the stamp of its sample if the edge is static.
    place : (x, y, z)
        The child's origin in the parent, in m.
    kind : {"independent", "drift", "constant"}
    parts : tuple of one or two Part
    """

    stamp: int
    place: Vector
    kind: Kind
    parts: tuple[Part, ...]

    @property
    def matrix(self) -> Matrix:
        """The covariance of this error alone."""
        if len(self.parts) == 1:
            return self.parts[0].matrix
        first, last = self.parts
        return np.asarray(first.weight * first.matrix + last.weight * last.matrix)

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON; the place is that of the edge."""
        return {"stamp": self.stamp, "kind": self.kind, "parts": [part.to_dict() for part in self.parts]}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """The error from which `to_dict` made `data`, at the origin; `ValueError` if it is none."""
        fields = from_fields(cls, data, {"stamp": int, "kind": str, "parts": tuple[Part, ...]})
        parts, kind = fields["parts"], as_kind(fields["kind"])
        weights = [part.weight for part in parts]
        if len(parts) not in (1, 2) or min(weights) < 0.0 or not math.isclose(sum(weights), 1.0):
            raise ValueError(f"an error is of one sample, or of two whose weights add up to one: not of {weights}")
        return cls(fields["stamp"], (0.0, 0.0, 0.0), kind, parts)


def covariances(errors: Sequence[EdgeError]) -> Matrix:
    """The covariances of an edge's errors at n different stamps in ascending order; shape (n, n, 6, 6)."""
    count = len(errors)
    found = np.zeros((count, count, 6, 6))
    for i, error in enumerate(errors):
        found[i, i] = error.matrix
    for kind in {error.kind for error in errors}:
        same = [i for i, error in enumerate(errors) if error.kind == kind]
        gain = np.eye(6)
        for place, i in enumerate(same):
            for before, j in enumerate(same[:place]):
                if kind == "constant":
                    found[i, j] = _of_constant(found[i, i], found[j, j])
                elif kind == "independent":
                    found[i, j] = _of_independent(errors[i], errors[j])
                else:
                    if before == 0:
                        last = same[place - 1]
                        gain = _gain(errors[last], errors[i])
                    found[i, j] = gain @ found[same[place - 1], j]
                found[j, i] = found[i, j].T
    return found


def _of_constant(later: Matrix, earlier: Matrix) -> Matrix:
    return earlier if np.array_equal(later, earlier) else root_of(later) @ root_of(earlier)


def _of_independent(later: EdgeError, earlier: EdgeError) -> Matrix:
    stamps = [{part.stamp for part in error.parts} for error in (later, earlier)]
    same_segment = stamps[0] == stamps[1]
    found = np.zeros((6, 6))
    for a in later.parts:
        for b in earlier.parts:
            if a.stamp == b.stamp:
                found += (min(a.weight, b.weight) if same_segment else a.weight * b.weight) * a.matrix
    return found


def _gain(earlier: EdgeError, later: EdgeError) -> Matrix:
    """The map of the earlier error to the part of the later one that comes from it."""
    carried: Matrix = lever_arm(np.subtract(later.place, earlier.place))
    before, after = carried @ earlier.matrix @ carried.T, later.matrix
    # Each number in its own unit, because m and rad may differ by orders of magnitude.
    unit = np.sqrt(np.maximum((before + after).diagonal(), 0.0))
    unit[unit == 0.0] = 1.0
    before, after = before / np.outer(unit, unit), after / np.outer(unit, unit)
    if np.linalg.eigvalsh(after - before)[0] >= -_SHRINKS:
        return carried
    values, vectors = np.linalg.eigh(before + after)
    known = values > _NOTHING
    root, basis = np.sqrt(values[known]), vectors[:, known]
    shares, turn = np.linalg.eigh((basis.T @ before @ basis) / np.outer(root, root))
    kept = np.where(shares > 0.5, (1.0 - shares) / np.maximum(shares, 0.5), 1.0)
    inner = (turn * np.maximum(kept, 0.0)) @ turn.T
    gain = (basis * root) @ inner @ (basis / root).T
    return np.asarray(gain * np.outer(unit, 1.0 / unit) @ carried)
