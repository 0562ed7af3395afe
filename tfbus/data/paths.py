"""Many poses in one frame: a set of them, and a path with a stamp for each."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from tfbus.data.dispatch import CopiedByFields, check_header, construct, do_transform, moved_header
from tfbus.geometry.stamped import TransformStamped
from tfbus.geometry.transform_array import TransformArray
from tfbus.plain import PlainData
from tfbus.stamps import AtLike, Latest, StampsLike


@dataclass(frozen=True, slots=True, eq=False)
class PoseArray(CopiedByFields, PlainData):
    """Poses in one frame, such as the particles of a filter, as geometry_msgs/PoseArray. Equal only to itself.

    Parameters
    ----------
    frame : str
    stamp : int or LATEST
        ns, of all poses.
    positions : array of shape (n, 3)
        In m. Copied.
    orientations : array of shape (n, 4)
        Unit quaternions (x, y, z, w). A norm within 1 % of one is normalised. Copied.

    Raises
    ------
    InvalidTransformError
        If a shape is wrong, or a row is not finite, or too far from a unit quaternion.

    Examples
    --------
    >>> particles = PoseArray("map", 0, [[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]], [[0.0, 0.0, 0.0, 1.0]] * 2)
    >>> particles.poses[1]
    Transform(translation=(2.0, 0.0, 0.0), rotation=(0.0, 0.0, 0.0, 1.0))
    """

    frame: str
    stamp: int | Latest
    positions: npt.NDArray[np.float64]
    orientations: npt.NDArray[np.float64]

    def __init__(self, frame: str, stamp: AtLike, positions: npt.ArrayLike, orientations: npt.ArrayLike) -> None:
        construct(self, frame, stamp, positions, orientations)

    def __post_init__(self) -> None:
        _check_poses(self, None)

    @property
    def poses(self) -> TransformArray:
        """The poses as transforms; each maps coordinates of the posed body into `frame`."""
        return TransformArray(self.positions, self.orientations)

    def __len__(self) -> int:
        return len(self.positions)


@dataclass(frozen=True, slots=True, eq=False)
class Path(CopiedByFields, PlainData):
    """Poses in one frame, each with a stamp, in their order, as nav_msgs/Path. Equal only to itself.

    Parameters
    ----------
    frame : str
    stamp : int or LATEST
        ns, of the path.
    positions : array of shape (n, 3)
        In m. Copied.
    orientations : array of shape (n, 4)
        Unit quaternions (x, y, z, w). A norm within 1 % of one is normalised. Copied.
    stamps : array of shape (n,)
        ns, of each pose. Copied. A transform does not change them: it moves all poses by one transform.

    Raises
    ------
    InvalidTransformError
        If a shape is wrong, or a row is not finite, or too far from a unit quaternion.
    ValueError
        If there is not one stamp for each pose.

    Examples
    --------
    >>> path = Path("map", 0, [[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]], [[0.0, 0.0, 0.0, 1.0]] * 2, [10, 20])
    >>> path.poses.stamps
    array([10, 20])
    """

    frame: str
    stamp: int | Latest
    positions: npt.NDArray[np.float64]
    orientations: npt.NDArray[np.float64]
    stamps: npt.NDArray[np.int64]

    def __init__(
        self,
        frame: str,
        stamp: AtLike,
        positions: npt.ArrayLike,
        orientations: npt.ArrayLike,
        stamps: StampsLike,
    ) -> None:
        construct(self, frame, stamp, positions, orientations, stamps)

    def __post_init__(self) -> None:
        _check_poses(self, self.stamps)

    @property
    def poses(self) -> TransformArray:
        """The poses as transforms with their stamps; each maps coordinates of the posed body into `frame`."""
        return TransformArray(self.positions, self.orientations, self.stamps)

    def __len__(self) -> int:
        return len(self.positions)


def _check_poses(data: Any, stamps: StampsLike | None) -> None:
    check_header(data)
    # Nobody can write to the columns of an array of transforms.
    poses = TransformArray(_rows(data.positions, 3), _rows(data.orientations, 4), stamps)
    object.__setattr__(data, "positions", poses.translations)
    object.__setattr__(data, "orientations", poses.rotations)
    if stamps is not None:
        object.__setattr__(data, "stamps", poses.stamps)


def _rows(value: npt.ArrayLike, width: int) -> npt.ArrayLike:
    """An empty list as no rows."""
    return np.empty((0, width)) if isinstance(value, (list, tuple)) and not value else value


@do_transform.register
def _(data: PoseArray, transform: TransformStamped) -> PoseArray:
    moved = transform.transform @ data.poses
    return PoseArray(*moved_header(data, transform), moved.translations, moved.rotations)


@do_transform.register
def _(data: Path, transform: TransformStamped) -> Path:
    moved = transform.transform @ data.poses
    return Path(*moved_header(data, transform), moved.translations, moved.rotations, data.stamps)
