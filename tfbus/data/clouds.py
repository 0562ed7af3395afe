"""`PointCloud`, many points at once."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from tfbus.data.dispatch import CopiedByFields, as_points, check_header, do_transform, made, moved_header
from tfbus.geometry.stamped import TransformStamped
from tfbus.geometry.transform_array import read_only
from tfbus.plain import PlainData
from tfbus.stamps import Latest, as_array, as_stamps


@dataclass(frozen=True, slots=True, eq=False)
class PointCloud(CopiedByFields, PlainData):
    """Points of a sensor, optionally with an instant for each. Equal only to itself.

    The arrays are held as read-only views and not copied: their owner must not change them any more.

    Parameters
    ----------
    frame : str
    stamp : int or LATEST
        ns.
    points : array of shape (n, 3)
        In m. Floats keep their dtype, integers become float64; NaN is allowed.
    stamps : integer array of shape (n,), optional
        The instant of each point, in ns, as int64.
    fields : mapping of str to array of shape (n, ...), optional
        Further values of each point, such as its intensity; a transform does not change them.

    Raises
    ------
    ValueError
        If a shape is wrong. The message has the shape.
    TypeError
        If points are not numbers, or stamps not integers: convert seconds with `from_seconds`.

    Notes
    -----
    A transform moves all points as if they had been seen at its own stamp. It does not change `stamps` and `fields`.

    Examples
    --------
    >>> cloud = PointCloud("laser", 0, np.array([[1.0, 0.0, 0.0]], np.float32))
    >>> do_transform(cloud, TransformStamped("base", "laser", 0, Transform((0.0, 0.0, 1.0)))).points
    array([[1., 0., 1.]], dtype=float32)
    """

    frame: str
    stamp: int | Latest
    points: npt.NDArray[Any]
    stamps: npt.NDArray[np.int64] | None = None
    fields: Mapping[str, npt.NDArray[Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_header(self)
        points = read_only(as_points(self.points))
        object.__setattr__(self, "points", points)
        if self.stamps is not None:
            stamps = read_only(as_stamps(self.stamps))
            if len(stamps) != len(points):
                raise ValueError(f"stamps must have shape ({len(points)},), one for each point, got {stamps.shape}")
            object.__setattr__(self, "stamps", stamps)
        columns = {name: _column(name, values, len(points)) for name, values in self.fields.items()}
        object.__setattr__(self, "fields", MappingProxyType(columns))

    def __len__(self) -> int:
        return len(self.points)


def _column(name: object, values: npt.ArrayLike, length: int) -> npt.NDArray[Any]:
    if not isinstance(name, str):
        raise TypeError(f"the name of a field must be a str, not {name!r}")
    column = as_array(values, f"field {name!r}")
    if column.shape[:1] != (length,):
        raise ValueError(f"field {name!r} must have shape ({length}, ...), one for each point, got {column.shape}")
    return read_only(column)


@do_transform.register
def _(data: PointCloud, transform: TransformStamped) -> PointCloud:
    header = moved_header(data, transform)
    points = read_only(transform.transform.apply(data.points))
    return made(PointCloud, *header, points, data.stamps, data.fields)
