"""`compare`, which compares the trajectories of a frame in two trees."""

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass

import numpy as np
import numpy.typing as npt

from tfbus.geometry.transform import Transform
from tfbus.geometry.transform_array import TransformArray, from_columns
from tfbus.rows import Columns, compose, invert
from tfbus.stamps import as_duration, from_seconds, time_between
from tfbus.tree.tree import TransformTree, moving_edges

_Points = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Alignment:
    """A motion with a scale: ``transform`` after ``scale``.

    Parameters
    ----------
    transform : Transform
    scale : float

    Examples
    --------
    >>> from tfbus.analysis import Alignment
    >>> Alignment(Transform((1.0, 0.0, 0.0)), scale=2.0).scale
    2.0
    """

    transform: Transform
    scale: float

    @classmethod
    def between(cls, points: _Points, reference: _Points, with_scale: bool = False) -> "Alignment":
        """The alignment with the least squared distances.

        The method is Umeyama's, "Least-squares estimation of transformation parameters between two point patterns",
        IEEE PAMI 13(4), 1991, equations 34 to 43.

        Parameters
        ----------
        points, reference : float64 arrays of shape (n, 3)
            m.
        with_scale : bool
            Whether the points are scaled as well; else the scale is 1.

        Raises
        ------
        ValueError
            If the points do not determine a rotation, because all of them are on a line.

        Examples
        --------
        >>> from tfbus.analysis import Alignment
        >>> corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        >>> alignment = Alignment.between(corners, corners + (1.0, 0.0, 0.0), False)
        >>> alignment.transform.is_close(Transform((1.0, 0.0, 0.0)))
        True
        """
        mean, mean_reference = points.mean(axis=0), reference.mean(axis=0)
        centred = points - mean
        u, d, v = np.linalg.svd((reference - mean_reference).T @ centred / len(points))
        if np.count_nonzero(d > np.finfo(np.float64).eps * max(1.0, float(d[0]))) < 2:
            raise ValueError("the trajectories cannot be aligned: their points lie on a line")
        signs = np.array([1.0, 1.0, math.copysign(1.0, np.linalg.det(u) * np.linalg.det(v))])
        rotation = u * signs @ v
        scale = float((d * signs).sum() / (centred**2).sum(axis=1).mean()) if with_scale else 1.0
        matrix = np.eye(4)
        matrix[:3, :3] = rotation
        matrix[:3, 3] = mean_reference - scale * rotation @ mean
        return cls(Transform.from_matrix(matrix), scale)


@dataclass(frozen=True, slots=True)
class Statistics:
    """Statistics of errors, in m or rad; `std` is the standard deviation of the population.

    Examples
    --------
    >>> from tfbus.analysis import compare
    >>> truth, slam = TransformTree(), TransformTree()
    >>> for step in range(4):
    ...     _ = truth.insert(TransformStamped("map", "base", step, Transform((float(step), 0.0, 0.0))))
    ...     _ = slam.insert(TransformStamped("map", "base", step, Transform((float(step), 0.5, 0.0))))
    >>> compare(truth, slam, "map", "base").absolute.statistics()[0].rmse
    0.5
    """

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float


@dataclass(frozen=True, slots=True, eq=False)
class PoseErrors:
    """The error of each pose, or of each step between two poses.

    Parameters
    ----------
    stamps : int64 array of shape (n,)
        The stamps in the reference, in ns; for a step, the stamp of its end.
    translation : float64 array of shape (n,)
        m.
    rotation : float64 array of shape (n,)
        rad, from 0 to pi.

    Examples
    --------
    >>> from tfbus.analysis import PoseErrors
    >>> errors = PoseErrors(np.array([0, 1]), np.array([0.1, 0.3]), np.zeros(2))
    >>> round(errors.statistics()[0].mean, 6)
    0.2
    """

    stamps: npt.NDArray[np.int64]
    translation: npt.NDArray[np.float64]
    rotation: npt.NDArray[np.float64]

    def statistics(self) -> tuple[Statistics, Statistics]:
        """The statistics of translation and rotation.

        Raises
        ------
        ValueError
            If there are no errors, because there is only one pose.

        Examples
        --------
        >>> from tfbus.analysis import PoseErrors
        >>> translation, rotation = PoseErrors(np.array([0]), np.array([0.5]), np.array([0.0])).statistics()
        >>> translation.rmse, rotation.max
        (0.5, 0.0)
        """
        if not len(self.stamps):
            raise ValueError("there are no errors: a step needs two poses")
        return _statistics(self.translation), _statistics(self.rotation)


def _statistics(values: npt.NDArray[np.float64]) -> Statistics:
    return Statistics(
        float(np.sqrt(np.mean(values**2))),
        float(np.mean(values)),
        float(np.median(values)),
        float(np.std(values)),
        float(np.min(values)),
        float(np.max(values)),
    )


_Rows = npt.NDArray[np.float64]
_Stamps = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Comparison:
    """The errors of a trajectory.

    Parameters
    ----------
    poses : int
        The number of poses that were compared.
    of : tuple of int
        The number of poses in the reference and in the estimate.
    alignment : Alignment or None
        The motion that was applied to the estimate; None without alignment.
    absolute : PoseErrors
        The errors of the poses (ATE, APE).
    relative : PoseErrors
        The errors of the steps from one pose to a later one (RPE).
    reference, estimate : TransformArray
        The poses that were compared, with the stamps of the reference; the estimate after alignment.

    Examples
    --------
    >>> from tfbus.analysis import compare
    >>> truth, slam = TransformTree(), TransformTree()
    >>> for step in range(4):
    ...     _ = truth.insert(TransformStamped("map", "base", step, Transform((float(step), 0.0, 0.0))))
    ...     _ = slam.insert(TransformStamped("map", "base", step, Transform((float(step), 0.5, 0.0))))
    >>> found = compare(truth, slam, "map", "base")
    >>> found.poses, found.absolute.translation
    (4, array([0.5, 0.5, 0.5, 0.5]))
    """

    poses: int
    of: tuple[int, int]
    alignment: Alignment | None
    absolute: PoseErrors
    relative: PoseErrors
    reference: TransformArray
    estimate: TransformArray

    def __str__(self) -> str:
        lines = [f"{self.poses:,} poses of {self.of[0]:,} and {self.of[1]:,}"]
        lines[0] += ", not aligned" if self.alignment is None else f", aligned with scale {self.alignment.scale:g}"
        lines.append(" " * 24 + "".join(f"{name:>10}" for name in Statistics.__match_args__))
        for name, errors in (("absolute", self.absolute), ("relative", self.relative)):
            found = errors.statistics() if len(errors.stamps) else ()
            for part, values in zip(("translation [m]", "rotation [rad]"), found, strict=False):
                lines.append(f"{name} {part:<15}" + "".join(f"{value:10.4g}" for value in astuple(values)))
        return "\n".join(lines)

    def __repr__(self) -> str:
        return f"<Comparison of {self.poses:,} poses>"

    def _repr_html_(self) -> str:
        return f"<pre>{self}</pre>"


def compare(
    reference: TransformTree,
    estimate: TransformTree,
    target: str,
    source: str,
    *,
    estimate_frames: tuple[str, str] | None = None,
    align: bool = False,
    scale: bool = False,
    max_difference: float = 0.01,
    delta: int = 1,
) -> Comparison:
    """Compare where `source` was in `target`, in two trees.

    A trajectory has a pose at each stamp of one moving edge between the two frames: the edge with the most samples.
    Each pose of the shorter trajectory is compared with the nearest pose in time of the other one.

    Parameters
    ----------
    reference, estimate : TransformTree
    target, source : str
    estimate_frames : tuple of str, optional
        Target and source in the estimate, if their names are others there.
    align : bool
        Move the estimate as near as possible to the reference first, by Umeyama's method.
    scale : bool
        With `align`, scale it as well.
    max_difference : float
        The greatest difference of two stamps, in s.
    delta : int
        The number of poses from the beginning to the end of a step; each step begins at the end of the last one.

    Returns
    -------
    Comparison

    Raises
    ------
    UnknownFrameError, DisconnectedError
        If there is no path in one of the trees.
    ValueError
        If there are no two poses at about the same stamp, the trajectories cannot be aligned, or `delta` is less than
        one, or `max_difference` negative.

    Examples
    --------
    >>> from tfbus.analysis import compare
    >>> wanted, found = TransformTree(), TransformTree()
    >>> for stamp in range(3):
    ...     _ = wanted.insert(TransformStamped("map", "cart", stamp, Transform((stamp, 0.0, 0.0))))
    ...     _ = found.insert(TransformStamped("map", "cart", stamp, Transform((stamp, 0.5, 0.0))))
    >>> print(compare(wanted, found, "map", "cart"))
    3 poses of 3 and 3, not aligned
                                  rmse      mean    median       std       min       max
    absolute translation [m]       0.5       0.5       0.5         0       0.5       0.5
    absolute rotation [rad]          0         0         0         0         0         0
    relative translation [m]         0         0         0         0         0         0
    relative rotation [rad]          0         0         0         0         0         0
    """
    if delta < 1:
        raise ValueError(f"delta must be at least 1, got {delta}")
    limit = from_seconds(as_duration(max_difference, "max_difference"))
    ours = _trajectory(reference, target, source)
    theirs = _trajectory(estimate, *(estimate_frames or (target, source)))
    first, second = _match(ours[0], theirs[0], limit)
    if not len(first):
        raise ValueError(
            f"no pose of {source!r} in {target!r} is at the same stamp within {max_difference:g} s: "
            f"{_span(ours[0])} in the reference, {_span(theirs[0])} in the estimate"
        )
    stamps, wanted, found = ours[0][first], ours[1][first], theirs[1][second]
    alignment = None
    if align:
        alignment = Alignment.between(found[:, :3], wanted[:, :3], scale)
        found = found.copy()
        found[:, :3] *= alignment.scale
        found = _stack(compose(_columns_of(alignment.transform._row, len(found)), _columns(found)))
    absolute = _stack(compose(invert(_columns(wanted)), _columns(found)))
    # The difference of positions, and not the length of the relative transform, which rounds once more.
    distances = np.linalg.norm(found[:, :3] - wanted[:, :3], axis=1)
    starts = np.arange(0, len(stamps) - delta, delta)
    ends = starts + delta
    steps = [compose(invert(_columns(rows[starts])), _columns(rows[ends])) for rows in (wanted, found)]
    relative = _stack(compose(invert(steps[0]), steps[1]))
    return Comparison(
        len(stamps),
        (len(ours[0]), len(theirs[0])),
        alignment,
        PoseErrors(stamps, distances, _angles(absolute)),
        PoseErrors(stamps[ends], np.linalg.norm(relative[:, :3], axis=1), _angles(relative)),
        *(from_columns(np.ascontiguousarray(rows.T), stamps=stamps) for rows in (wanted, found)),
    )


def _trajectory(tree: TransformTree, target: str, source: str) -> tuple[_Stamps, _Rows]:
    """The stamps and the poses of a trajectory; stamps without an answer are left out."""
    stamps = tree.stamps(target, source)
    if not moving_edges(tree, target, source):
        raise ValueError(f"{source!r} does not move in {target!r}")
    found = tree.lookup_many(target, source, stamps, out_of_range="nan")
    valid = found.valid
    rows = np.hstack([found.translations[valid], found.rotations[valid]])
    return stamps[valid], rows


def _match(first: _Stamps, second: _Stamps, limit: int) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """The places of matching stamps: for each stamp of the shorter array, the nearest stamp of the other."""
    if len(second) > len(first):
        return _nearest(first, second, limit)
    places, others = _nearest(second, first, limit)
    return others, places


def _nearest(short: _Stamps, long: _Stamps, limit: int) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    if not len(short):
        return np.array([], np.intp), np.array([], np.intp)
    after = np.clip(np.searchsorted(long, short, side="right"), 1, len(long) - 1) if len(long) > 1 else None
    if after is None:
        best = np.zeros(len(short), np.intp)
    else:
        # Of two stamps that are equally near, the earlier one.
        nearer = time_between(short, long[after]) < time_between(long[after - 1], short)
        best = np.where(nearer, after, after - 1)
    near = np.flatnonzero(np.abs(time_between(short, long[best])) <= limit)
    return near, best[near]


def _columns(rows: _Rows) -> Columns:
    x, y, z, i, j, k, w = rows.T
    return x, y, z, i, j, k, w


def _columns_of(row: Sequence[float], count: int) -> Columns:
    return _columns(np.tile(np.array(row), (count, 1)))


def _stack(columns: Columns) -> _Rows:
    return np.stack(columns, axis=1)


def _angles(rows: _Rows) -> _Rows:
    """The angle of each rotation; exact for small ones as well."""
    angles: _Rows = 2.0 * np.arctan2(np.linalg.norm(rows[:, 3:6], axis=1), np.abs(rows[:, 6]))
    return angles


def _span(stamps: _Stamps) -> str:
    if not len(stamps):
        return "none"
    return f"{len(stamps):,} from {stamps[0] / 1e9:.3f} s to {stamps[-1] / 1e9:.3f} s"
