"""Poses and points in another frame, with their own error and that of the transform."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tfbus.data import (
    Odometry,
    PointStamped,
    PointWithCovarianceStamped,
    PoseStamped,
    PoseWithCovarianceStamped,
    TwistWithCovarianceStamped,
    do_transform,
)
from tfbus.geometry.covariance import Matrix, lever_arm
from tfbus.uncertainty.answers import UncertainTransform


@dataclass(frozen=True, slots=True, eq=False)
class UncertainTwist(TwistWithCovarianceStamped):
    """A velocity with its covariance, as `TransformTree.twist` gives it with ``covariance=True``.

    Attributes
    ----------
    exact : tuple of (str, str)
        The edges, as (parent, child), that gave no covariance, and count as exact.

    Examples
    --------
    >>> tree = TransformTree()
    >>> for second, sigma in ((0, 0.0), (1, 0.1)):
    ...     stamp, error = second * SECOND, Covariance.of(xyz=sigma)
    ...     _ = tree.insert(UncertainSample("odom", "base", stamp, Transform(), covariance=error, kind="drift"))
    >>> found = tree.twist("base", "odom", covariance=True)
    >>> found.covariance[0, 0].round(9).item(), found.exact
    (0.01, ())
    """

    exact: tuple[tuple[str, str], ...] = ()


def with_error_of(data: Any, transform: UncertainTransform) -> Any:
    """`data` in the transform's target, with the sum of their own covariance and the transform's at their place.

    The two are taken as independent. Data without a covariance count as exact; a covariance that is unknown, because a
    variance in it is negative, stays unknown.

    Raises
    ------
    TypeError
        If the data are neither a pose nor a point.

    Examples
    --------
    >>> tree = TransformTree()
    >>> _ = tree.insert(UncertainSample("map", "base", 0, Transform(), covariance=Covariance.of(rpy=0.1)))
    >>> found = with_error_of(PointStamped("base", 0, (2.0, 0.0, 0.0)), tree.lookup("map", "base", covariance=True))
    >>> found.covariance.diagonal().round(9).tolist()
    [0.0, 0.04, 0.04]
    """
    moved: Any = do_transform(data, transform)
    turn = transform.transform.matrix()[:3, :3]
    is_point = isinstance(data, (PointStamped, PointWithCovarianceStamped))
    if not is_point and not isinstance(data, (PoseStamped, PoseWithCovarianceStamped, Odometry)):
        raise TypeError(
            f"a {type(data).__name__} has no place for a covariance: look the transform up with covariance=True instead"
        )
    jacobian = lever_arm(turn @ data.point)[:3] if is_point else lever_arm(turn @ data.pose.translation)
    error = jacobian @ transform.covariance.matrix @ jacobian.T
    if isinstance(moved, Odometry):
        return replace(moved, pose_covariance=_added(moved.pose_covariance, error))
    covariance = _added(getattr(moved, "covariance", None), error)
    if is_point:
        return PointWithCovarianceStamped(moved.frame, moved.stamp, moved.point, covariance)
    return PoseWithCovarianceStamped(moved.frame, moved.stamp, moved.pose, covariance)


def _added(own: Matrix | None, error: Matrix) -> Matrix:
    if own is None:
        return error
    return own if (own.diagonal() < 0.0).any() else np.asarray(own + error)
