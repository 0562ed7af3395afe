"""`Alignment`, the rigid motion that brings one trajectory as near as possible to another."""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tfbus.geometry.transform import Transform

_Points = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Alignment:
    """A motion with a scale: ``transform`` after ``scale``.

    Parameters
    ----------
    transform : Transform
    scale : float
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
