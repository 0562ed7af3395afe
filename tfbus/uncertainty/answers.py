"""An answer with its error: a chain of edges, each with its transform, its stamp and its error.

To first order the error of an answer is a sum over its edges, e = sum J_k e_k. Edge k lies somewhere between target and
source. Its error (d, w) moves everything behind it, seen from the target, as one rigid body: so J_k turns it to the
target's axes, and adds the lever arm l from its child's origin to that of the source,

    J_k = +- [[I, -l x], [0, I]] diag(R, R),        R = rotation from the edge's parent to the target,

with a minus if the way from target to source climbs the edge, because then its inverse is used. Composition and inverse
of `tfbus.geometry.covariance` are the cases of two edges and of one. The lever arm is a difference of two places in the
target, so nothing cancels if both are far away.

An edge that is used once contributes J S J^T. One that is used at several stamps, in time travel or by several answers
together, contributes J_i K_ij J_j^T with the covariances K of `tfbus.uncertainty.correlation`. Edges are told apart by
the names of parent and child; the errors of different edges are independent.

First order ends where a rotation is so uncertain that the lever arm's end goes round a bend. `linear` compares the
greatest standard deviation of the answer's rotation, with all edges added up, with `LINEAR`. Beyond that,
`JointAnswers.sample` draws the errors of the edges and composes them without any approximation.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple, cast

import numpy as np

from tfbus.data import PoseWithCovarianceStamped
from tfbus.geometry.covariance import Covariance, Matrix, covariance_of, lever_arm, root_of, turned
from tfbus.geometry.stamped import TransformStamped
from tfbus.geometry.transform import Transform, from_row
from tfbus.geometry.transform_array import TransformArray, from_columns, locked
from tfbus.plain import StampsAs, from_fields, from_plain
from tfbus.rows import IDENTITY, Columns, Quaternion, Row, Vector, compose, invert
from tfbus.uncertainty.correlation import EdgeError, covariances

LINEAR = 0.125
"""In rad: the standard deviation of an answer's rotation up to which first order holds within some percent."""

Name = tuple[str, str]
"""An edge: parent and child."""


class Link(NamedTuple):
    """One edge on the way from target to source.

    Attributes
    ----------
    parent, child : str
    row : Row
        The child in the parent.
    climbs : bool
        Whether the way from target to source goes from the child to the parent.
    error : EdgeError or None
        None if a sample that it was read from has no covariance.
    """

    parent: str
    child: str
    row: Row
    climbs: bool
    error: EdgeError | None

    @property
    def ends(self) -> Name:
        """Its two frames, that nearer to the target first."""
        return (self.child, self.parent) if self.climbs else (self.parent, self.child)

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        error = None if self.error is None else self.error.to_dict()
        fields = {"parent": self.parent, "child": self.child, "transform": from_row(self.row).to_dict()}
        return {**fields, "climbs": self.climbs, "error": error}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Link:
        """The edge from which `to_dict` made `data`; `ValueError` if it is none."""
        kinds = {"parent": str, "child": str, "transform": Transform, "climbs": bool, "error": EdgeError | None}
        fields = from_fields(cls, data, kinds)
        row, error = fields.pop("transform")._row, fields.pop("error")
        return cls(row=row, error=error and error._replace(place=row[:3]), **fields)


class Share(NamedTuple):
    """The part of an answer's covariance that one edge contributes.

    Examples
    --------
    >>> tree = TransformTree()
    >>> _ = tree.insert(UncertainSample("map", "base", 0, Transform(), covariance=Covariance.of(xyz=0.5)))
    >>> (share,) = tree.lookup("map", "base", covariance=True).shares()
    >>> share.parent, share.child, float(share.matrix[0, 0])
    ('map', 'base', 0.25)
    """

    parent: str
    child: str
    matrix: Matrix
    """Shape (6, 6), in the order of `Covariance`; the matrices of all edges add up to the answer's."""


class UncertainTransform(TransformStamped):
    """The answer of a lookup with ``covariance=True``.

    Attributes
    ----------
    links : tuple of Link
        The edges that it was made of, from target to source.

    Notes
    -----
    ``a.inverse()`` and ``a @ b`` are answers of this kind too, and an edge that both use is counted once; so
    ``(a.inverse() @ b).covariance`` is the error of one answer as seen from another, such as of a grip.

    Examples
    --------
    >>> tree = TransformTree()
    >>> error = Covariance.of(xyz=0.01, rpy=0.1)
    >>> sample = UncertainSample("map", "base", 0, Transform((2.0, 0.0, 0.0)), static=True, covariance=error)
    >>> mount = TransformStamped("base", "hand", 0, Transform((1.0, 0.0, 0.0)), static=True)
    >>> outcomes = tree.insert_many([sample, mount])
    >>> found = tree.lookup("map", "hand", covariance=True)
    >>> found.covariance.sigmas.round(4).tolist()
    [0.01, 0.1005, 0.1005, 0.1, 0.1, 0.1]
    >>> found.exact
    (('base', 'hand'),)
    """

    __slots__ = ("__dict__", "_policy_use", "links")
    links: tuple[Link, ...]
    _policy_use: tuple[int, int | None]

    def _take(self, other: Any) -> None:
        self.links, self._policy_use = other.links, other._policy_use

    @property
    def extrapolated_by(self) -> int:
        """As that of the answer without a covariance, in ns. The error of waiting is not in the covariance."""
        return self._policy_use[0]

    @property
    def gap(self) -> int | None:
        """As that of the answer without a covariance, in ns."""
        return self._policy_use[1]

    @cached_property
    def covariance(self) -> Covariance:
        """Of the error of the source's origin and a small rotation, along the axes of the target; to first order."""
        return covariance_of(joint([self]).covariance)

    @property
    def exact(self) -> tuple[Name, ...]:
        """The edges, as (parent, child), that gave no covariance, and count as exact."""
        return tuple(dict.fromkeys((link.parent, link.child) for link in self.links if link.error is None))

    @property
    def linear(self) -> bool:
        """Whether the rotations are sure enough for first order: standard deviations of 0.125 rad at most in all.

        The covariance is then within some percent of the true one. Otherwise draw samples.
        """
        rotations = [link.error.matrix[3:, 3:] for link in self.links if link.error is not None]
        # The trace bounds the greatest eigenvalue of each edge, in whatever axes.
        return not rotations or math.sqrt(sum(float(np.linalg.eigvalsh(m)[-1]) for m in rotations)) <= LINEAR

    def shares(self) -> list[Share]:
        """The contribution of each edge that gave a covariance: first the one with the most of the position's variance.

        Examples
        --------
        >>> tree = TransformTree()
        >>> _ = tree.insert(UncertainSample("map", "base", 0, Transform(), covariance=Covariance.of(xyz=0.1)))
        >>> [share.child for share in tree.lookup("map", "base", covariance=True).shares()]
        ['base']
        """
        found = [Share(*name, matrix) for name, matrix in joint([self])._by_edge()]
        return sorted(found, key=lambda share: np.trace(share.matrix[:3, :3]).item(), reverse=True)

    def sample(self, n: int, rng: np.random.Generator | int | None = None) -> TransformArray:
        """`n` transforms drawn from the answer's distribution: the edges are drawn, and composed exactly.

        Parameters
        ----------
        n : int
        rng : numpy.random.Generator or int, optional
            The source of random numbers, or its seed.

        Examples
        --------
        >>> tree = TransformTree()
        >>> _ = tree.insert(UncertainSample("map", "base", 0, Transform(), covariance=Covariance.of(xyz=0.1)))
        >>> tree.lookup("map", "base", covariance=True).sample(1000, rng=1).translations.std(axis=0).round(1).tolist()
        [0.1, 0.1, 0.1]
        """
        return joint([self]).sample(n, rng)[0]

    def move_points(self, points: Any, covariances: Any = None) -> tuple[Matrix, Matrix]:
        """Points of the source in the target, and the covariance of each: its own error and the transform's.

        Parameters
        ----------
        points : array of shape (3,) or (n, 3)
            In m.
        covariances : array of shape (3, 3) or (n, 3, 3), optional
            Of the points' own errors, along the axes of the source; by default they are exact.

        Returns
        -------
        (array of shape (3,) or (n, 3), array of shape (3, 3) or (n, 3, 3))
            In m and m^2. Errors of the transform are common to all points; each covariance is that of one point.

        Examples
        --------
        >>> tree = TransformTree()
        >>> _ = tree.insert(UncertainSample("map", "base", 0, Transform(), covariance=Covariance.of(rpy=0.1)))
        >>> _, spread = tree.lookup("map", "base", covariance=True).move_points((10.0, 0.0, 0.0))
        >>> spread.diagonal().round(9).tolist()
        [0.0, 1.0, 1.0]
        """
        own = np.asarray(points, np.float64)
        transform = self.transform
        turn = transform.matrix()[:3, :3]
        jacobian = lever_arm(own @ turn.T)[..., :3, :]
        found = jacobian @ self.covariance.matrix @ np.swapaxes(jacobian, -1, -2)
        if covariances is not None:
            found = found + turn @ np.asarray(covariances, np.float64) @ turn.T
        return np.asarray(transform.apply(own)), found

    def ellipsoid(self, sigmas: float = 2.0) -> tuple[Vector, Quaternion]:
        """The ellipsoid of the source's origin in the target, for a picture; its centre is the answer's translation.

        Parameters
        ----------
        sigmas : float
            Its size in standard deviations.

        Returns
        -------
        ((a, b, c), (x, y, z, w))
            The semi-axes in m, the shortest first, and the unit quaternion that turns x, y, z to them.

        Examples
        --------
        >>> tree = TransformTree()
        >>> error = Covariance.of(xyz=(0.1, 0.2, 0.3))
        >>> _ = tree.insert(UncertainSample("map", "base", 0, Transform(), covariance=error))
        >>> [round(axis, 6) for axis in tree.lookup("map", "base", covariance=True).ellipsoid()[0]]
        [0.2, 0.4, 0.6]
        """
        values, vectors = np.linalg.eigh(self.covariance.matrix[:3, :3])
        # Eigenvectors may be left-handed.
        vectors[:, 0] *= np.linalg.det(vectors)
        matrix = np.eye(4)
        matrix[:3, :3] = vectors
        a, b, c = (sigmas * math.sqrt(max(value, 0.0)) for value in values.tolist())
        return (a, b, c), Transform.from_matrix(matrix).rotation

    def as_pose(self) -> PoseWithCovarianceStamped:
        """The pose of the source in the target as data with a covariance, for a message of ROS.

        Examples
        --------
        >>> tree = TransformTree()
        >>> _ = tree.insert(UncertainSample("map", "base", 0, Transform(), covariance=Covariance.of(xyz=0.5)))
        >>> float(tree.lookup("map", "base", covariance=True).as_pose().covariance[0, 0])
        0.25
        """
        return PoseWithCovarianceStamped(self.parent, self.stamp, self.transform, self.covariance.matrix)

    def inverse(self) -> UncertainTransform:
        """The transform in the other direction, with its error.

        Examples
        --------
        >>> tree = TransformTree()
        >>> _ = tree.insert(UncertainSample("map", "base", 0, Transform(), covariance=Covariance.of(xyz=0.5)))
        >>> tree.lookup("map", "base", covariance=True).inverse().covariance.sigmas[0].item()
        0.5
        """
        links = tuple(link._replace(climbs=not link.climbs) for link in reversed(self.links))
        return uncertain(super().inverse(), links)

    def __matmul__(self, other: TransformStamped) -> TransformStamped:
        found = super().__matmul__(other)
        if not isinstance(other, UncertainTransform) or not isinstance(found, TransformStamped):
            return found
        return uncertain(found, self.links + other.links)

    def to_dict(self, *, stamps: StampsAs = "int") -> dict[str, Any]:
        """As the answer without a covariance, and its ``"edges"`` from target to source, of which the rest is computed.

        Each is a dict: ``"parent"``, ``"child"``, ``"transform"``, ``"climbs"``, and ``"error"``; this is None, or has
        ``"stamp"``, ``"kind"`` and ``"parts"``: the stamp, weight and covariance of each sample, of 36 numbers.

        Examples
        --------
        >>> tree = TransformTree()
        >>> _ = tree.insert(UncertainSample("map", "base", 0, Transform(), covariance=Covariance.of(xyz=0.5)))
        >>> (edge,) = tree.lookup("map", "base", covariance=True).to_dict()["edges"]
        >>> edge["error"]["parts"][0]["covariance"][0]
        0.25
        """
        policy_use = {} if self.gap is None else {"extrapolated_by": self.extrapolated_by, "gap": self.gap}
        edges = [link.to_dict() for link in self.links]
        return {**super().to_dict(stamps=stamps), **policy_use, "edges": edges}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> UncertainTransform:
        """The answer from which `to_dict` made `data`.

        Raises
        ------
        ValueError
            As `TransformStamped.from_dict`; or if an edge is none, or does not lead on from the one before it.

        Examples
        --------
        >>> tree = TransformTree()
        >>> _ = tree.insert(UncertainSample("map", "base", 0, Transform(), covariance=Covariance.of(xyz=0.5)))
        >>> found = tree.lookup("map", "base", covariance=True)
        >>> UncertainTransform.from_dict(found.to_dict()).covariance == found.covariance
        True
        """
        given = dict(data)
        links = from_plain(tuple[Link, ...], given.pop("edges", None), "UncertainTransform.edges")
        for link, following in pairwise(links):
            if link.ends[1] != following.ends[0]:
                raise ValueError(f"an edge from {following.ends[0]!r} does not lead on from {link.ends[1]!r}")
        return uncertain(super().from_dict(given), links)

    def __reduce__(self) -> tuple[Any, ...]:
        return _restored, (self._fields, self.links, self._policy_use)


def uncertain(answer: TransformStamped, links: Iterable[Link]) -> UncertainTransform:
    """An answer with the edges that it was made of."""
    return _restored(answer._fields, tuple(links), (answer.extrapolated_by, answer.gap))


def _restored(fields: Any, links: tuple[Link, ...], policy_use: tuple[int, int | None]) -> UncertainTransform:
    found = UncertainTransform.__new__(UncertainTransform)
    found._fields, found.links, found._policy_use = fields, links, policy_use
    return found


class UncertainTransformArray(TransformArray):
    """The answers of a ``lookup_many`` with ``covariance=True``.

    Attributes
    ----------
    covariances : array of shape (n, 6, 6)
        One for each answer, in the order of `Covariance`; NaN where there is no answer.
    exact : tuple of (str, str)
        The edges, as (parent, child), that gave no covariance at one of the stamps, and count as exact there.

    Examples
    --------
    >>> tree = TransformTree()
    >>> for stamp, sigma in ((0, 1.0), (10, 2.0)):
    ...     _ = tree.insert(UncertainSample("a", "b", stamp, Transform(), covariance=Covariance.of(xyz=sigma)))
    >>> tree.lookup_many("a", "b", [0, 5, 10], covariance=True).covariances[:, 0, 0].tolist()
    [1.0, 2.5, 4.0]
    """

    __slots__ = ("covariances", "exact")
    covariances: Matrix
    exact: tuple[Name, ...]


def with_covariances(transforms: TransformArray, covariances: Matrix, exact: Iterable[Name]) -> UncertainTransformArray:
    """An array of answers with the covariances of each."""
    found = UncertainTransformArray.__new__(UncertainTransformArray)
    found._known_columns, found._known_stamps = transforms._columns, transforms._stamps
    found._known_policy_use = transforms._policy_use
    found.covariances = locked(covariances)
    found.exact = tuple(exact)
    return found


class _Use(NamedTuple):
    """One use of an edge by one of several answers."""

    answer: int
    error: EdgeError
    jacobian: Matrix


class JointAnswers:
    """Several answers together, with what their errors have in common.

    Parameters
    ----------
    answers : sequence of UncertainTransform

    Attributes
    ----------
    answers : tuple of UncertainTransform

    Examples
    --------
    >>> tree = TransformTree()
    >>> _ = tree.insert(UncertainSample("map", "base", 0, Transform(), static=True, covariance=Covariance.of(xyz=0.1)))
    >>> found = tree.lookup("map", "base", covariance=True)
    >>> together = joint([found, found])
    >>> together.covariance.shape, together.difference(0, 1).any().item()
    ((12, 12), False)
    """

    def __init__(self, answers: Iterable[UncertainTransform]) -> None:
        self.answers = tuple(answers)
        for answer in self.answers:
            if not isinstance(answer, UncertainTransform):
                raise TypeError(f"joint takes answers of lookups with covariance=True, not {answer!r}")

    @cached_property
    def covariance(self) -> Matrix:
        """Of all errors, shape (6 n, 6 n): the six numbers of each answer along its own target's axes, in order."""
        size = 6 * len(self.answers)
        found = np.zeros((size, size))
        for _, matrix in self._by_edge():
            found += matrix
        return 0.5 * (found + found.T)

    def difference(self, i: int, j: int) -> Matrix:
        """The covariance of error j less error i, shape (6, 6); the two answers should have the same target.

        Examples
        --------
        >>> tree = TransformTree()
        >>> for stamp, sigma in ((0, 3.0), (10, 5.0)):
        ...     error = Covariance.of(xyz=sigma)
        ...     _ = tree.insert(UncertainSample("odom", "base", stamp, Transform(), covariance=error, kind="drift"))
        >>> both = joint([tree.lookup("odom", "base", stamp, covariance=True) for stamp in (0, 10)])
        >>> both.difference(0, 1)[0, 0].item()
        16.0
        """
        a, b = slice(6 * i, 6 * i + 6), slice(6 * j, 6 * j + 6)
        whole = self.covariance
        return np.asarray(whole[a, a] + whole[b, b] - whole[a, b] - whole[b, a])

    def sample(self, n: int, rng: np.random.Generator | int | None = None) -> tuple[TransformArray, ...]:
        """`n` draws of each answer; draw k of one answer has the same errors of edges as draw k of another.

        Examples
        --------
        >>> tree = TransformTree()
        >>> _ = tree.insert(UncertainSample("map", "base", 0, Transform(), covariance=Covariance.of(xyz=0.5)))
        >>> found = tree.lookup("map", "base", covariance=True)
        >>> [len(drawn) for drawn in joint([found, found]).sample(3)]
        [3, 3]
        """
        source = np.random.default_rng(rng)
        drawn: dict[tuple[Name, int], Matrix] = {}
        for name, errors in self._errors().items():
            size = 6 * len(errors)
            matrix = covariances(errors).swapaxes(1, 2).reshape(size, size)
            unit = np.sqrt(np.maximum(matrix.diagonal(), 0.0))
            unit[unit == 0.0] = 1.0
            root = root_of(matrix / np.outer(unit, unit)) * unit[:, None]
            draws = (source.standard_normal((n, size)) @ root.T).reshape(n, len(errors), 6)
            drawn |= {(name, error.stamp): draws[:, i] for i, error in enumerate(errors)}
        return tuple(from_columns(_drawn(answer.links, drawn, n)) for answer in self.answers)

    def _uses(self) -> dict[Name, list[_Use]]:
        uses: dict[Name, list[_Use]] = {}
        for number, answer in enumerate(self.answers):
            known = [link for link in answer.links if link.error is not None]
            for link, jacobian in zip(known, jacobians_of(answer.links), strict=True):
                use = _Use(number, cast(EdgeError, link.error), jacobian)
                uses.setdefault((link.parent, link.child), []).append(use)
        return uses

    def _errors(self) -> dict[Name, list[EdgeError]]:
        """The errors of each edge at different stamps, in their order."""
        found: dict[Name, dict[int, EdgeError]] = {}
        for answer in self.answers:
            for link in answer.links:
                if link.error is not None:
                    found.setdefault((link.parent, link.child), {})[link.error.stamp] = link.error
        return {name: [errors[stamp] for stamp in sorted(errors)] for name, errors in found.items()}

    def _by_edge(self) -> Iterable[tuple[Name, Matrix]]:
        """The covariance that each edge contributes, shape (6 n, 6 n)."""
        errors = self._errors()
        for name, uses in self._uses().items():
            own = errors[name]
            place = {error.stamp: i for i, error in enumerate(own)}
            between = covariances(own)
            jacobian = np.zeros((6 * len(self.answers), len(own), 6))
            for use in uses:
                jacobian[6 * use.answer : 6 * use.answer + 6, place[use.error.stamp]] += use.jacobian
            size = 6 * len(own)
            flat = jacobian.reshape(-1, size)
            yield name, flat @ between.swapaxes(1, 2).reshape(size, size) @ flat.T


def joint(answers: Iterable[UncertainTransform]) -> JointAnswers:
    """Several answers together, whose errors share edges.

    Raises
    ------
    TypeError
        If one has no covariance.

    Examples
    --------
    >>> joint([]).covariance.shape
    (0, 0)
    """
    return JointAnswers(answers)


def jacobians_of(links: Sequence[Link]) -> Matrix:
    """J of each link that has an error, shape (n, 6, 6); see the head of this module."""
    known = np.array([link.error is not None for link in links], bool)
    sign, turns, places = np.ones(len(links)), np.empty((len(links), 4)), np.empty((len(links), 3))
    here = IDENTITY
    for i, link in enumerate(links):
        before = here
        here = compose(here, invert(link.row) if link.climbs else link.row)
        at_parent, at_child = (here, before) if link.climbs else (before, here)
        turns[i], places[i] = at_parent[3:], at_child[:3]
        sign[i] = -1.0 if link.climbs else 1.0
    turns, arms = turns[known], (np.array(here[:3]) - places)[known]
    return sign[known, None, None] * (lever_arm(arms) @ turned(rotation_matrices(turns)))


def rotation_matrices(quaternions: Matrix) -> Matrix:
    """The matrices of quaternions (x, y, z, w), which need not have unit length; shape (..., 3, 3)."""
    square = (quaternions * quaternions).sum(axis=-1)[..., None, None]
    x, y, z, w = np.moveaxis(quaternions, -1, 0)
    rows = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    return np.asarray(np.moveaxis(np.array(rows), (0, 1), (-2, -1)) / square)


def _drawn(links: Sequence[Link], drawn: dict[tuple[Name, int], Matrix], n: int) -> Matrix:
    """The columns, shape (7, n), of n transforms, with the errors of the edges that were drawn."""
    here: Columns = tuple(np.full(n, number) for number in IDENTITY)  # type: ignore[assignment]
    for link in links:
        edge: Columns = link.row
        if link.error is not None:
            edge = disturbed(link.row, drawn[(link.parent, link.child), link.error.stamp])
        here = compose(here, invert(edge) if link.climbs else edge)
    found: Matrix = np.stack(here)
    found[3:] /= np.sqrt((found[3:] * found[3:]).sum(axis=0))
    return found


def disturbed(row: Row, errors: Matrix) -> Columns:
    """The columns of (p + d, Exp(w) R) for errors (d, w) of shape (n, 6)."""
    shift, turn = errors[:, :3], errors[:, 3:]
    half = 0.5 * np.sqrt((turn * turn).sum(axis=1))
    axis = (0.5 * np.sinc(half / math.pi))[:, None] * turn
    rotation = compose((0.0, 0.0, 0.0, *axis.T, np.cos(half)), (0.0, 0.0, 0.0, *row[3:]))[3:]
    return (*(place + moved for place, moved in zip(row[:3], shift.T, strict=True)), *rotation)
