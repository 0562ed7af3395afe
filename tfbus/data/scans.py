"""`LaserScan`, a scan of a planar laser."""

import math
from dataclasses import KW_ONLY, dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from tfbus.data.clouds import PointCloud
from tfbus.data.dispatch import CopiedByFields, as_floats, check_header, made
from tfbus.geometry.transform_array import read_only
from tfbus.plain import PlainData
from tfbus.stamps import SECOND, Latest, as_array, as_stamp, from_seconds, is_real


@dataclass(frozen=True, slots=True, eq=False)
class LaserScan(CopiedByFields, PlainData):
    """One sweep of a planar laser, with the fields of sensor_msgs/LaserScan. Equal only to itself.

    Ray i goes in the plane z = 0 of `frame` at the angle ``angle_min + i * angle_increment``, counterclockwise from x
    as seen from +z, at the instant ``stamp + i * time_increment``. A scan cannot be transformed, but the cloud that
    `to_points` gives can. The arrays are held as read-only views, not copied: their owner must not change them.

    Parameters
    ----------
    frame : str
    stamp : int or LATEST
        ns, of the first ray.
    ranges : array of shape (n,)
        In m. Floats keep their dtype, integers become float64. NaN, infinity and ranges outside of the limits give no
        points.
    angle_min, angle_increment : float
        In rad; the increment is negative for a laser that sweeps clockwise.
    angle_max : float, optional
        In rad, of the last ray; computed by default. It is not used, because drivers round it differently.
    time_increment : float
        From ray to ray, in s.
    scan_time : float
        From scan to scan, in s. It is not used.
    range_min, range_max : float
        The limits of a valid range in m, inclusive.
    intensities : array of shape (n,), optional
        In the units of the device. An empty array becomes None, as in the message.

    Raises
    ------
    ValueError
        If lengths differ, an angle or the time increment is not finite, all rays have the same angle, the limits are
        the wrong way round, or the last ray is beyond stamps of 64 bits.
    TypeError
        If a value is not a number.

    Examples
    --------
    >>> scan = LaserScan("laser", 0, np.array([1.0, 2.0]), angle_min=0.0, angle_increment=np.pi / 2)
    >>> scan.to_points().points.round(3)
    array([[1., 0., 0.],
           [0., 2., 0.]])
    """

    frame: str
    stamp: int | Latest
    ranges: npt.NDArray[Any]
    _: KW_ONLY
    angle_min: float
    angle_increment: float
    angle_max: float | None = None
    time_increment: float = 0.0
    scan_time: float = 0.0
    range_min: float = 0.0
    range_max: float = math.inf
    intensities: npt.NDArray[Any] | None = None

    def __post_init__(self) -> None:
        check_header(self)
        ranges = read_only(as_floats(self.ranges, "ranges"))
        if ranges.ndim != 1:
            raise ValueError(f"ranges must have shape (n,), got {ranges.shape}")
        object.__setattr__(self, "ranges", ranges)
        self._check_numbers(last=max(0, len(ranges) - 1))
        if self.intensities is not None:
            intensities = read_only(as_array(self.intensities, "intensities"))
            if intensities.shape not in ((0,), ranges.shape):
                raise ValueError(f"intensities must have shape {ranges.shape}, as the ranges, got {intensities.shape}")
            object.__setattr__(self, "intensities", intensities if intensities.size else None)

    def _check_numbers(self, last: int) -> None:
        """Check everything but the arrays; `last` is the index of the last ray."""
        for name in ("angle_min", "angle_increment", "time_increment", "scan_time", "range_min", "range_max"):
            object.__setattr__(self, name, _number(getattr(self, name), name))
        for name in ("angle_min", "angle_increment", "time_increment"):
            if not math.isfinite(getattr(self, name)):
                raise ValueError(f"{name} must be finite, got {getattr(self, name)!r}")
        if last and not self.angle_increment:
            raise ValueError(f"angle_increment must not be 0 for a scan of {last + 1} rays")
        if not self.range_min <= self.range_max:
            raise ValueError(f"range_min must not be above range_max, got {self.range_min!r} and {self.range_max!r}")
        computed = self.angle_min + last * self.angle_increment
        angle_max = computed if self.angle_max is None else _number(self.angle_max, "angle_max")
        object.__setattr__(self, "angle_max", angle_max)
        sweep = from_seconds(last * self.time_increment)
        if not isinstance(self.stamp, Latest):
            as_stamp(self.stamp + sweep)

    def to_points(self) -> PointCloud:
        """Convert to a cloud of the points that the rays hit, with the same frame and stamp.

        Returns
        -------
        PointCloud
            The points of the m rays with a valid range, shape (m, 3), in the dtype of the ranges. `stamps` has the
            instants of the rays; it is None if the stamp of the scan is `LATEST`. The field "index" has the index of
            each ray in the scan, and "intensities" its intensity, if the scan has them; both are named as in
            laser_geometry.

        Examples
        --------
        >>> scan = LaserScan("laser", 0, np.array([1.0, np.inf]), angle_min=0.0, angle_increment=0.1, range_max=30.0)
        >>> scan.to_points().points
        array([[1., 0., 0.]])
        """
        ranges = self.ranges
        low, high = self.range_min, self.range_max
        if ranges.dtype != np.float64:
            # The limits are rounded as the ranges are, so a range at a limit is valid. A huge one becomes infinite.
            with np.errstate(over="ignore"):
                low, high = np.array((low, high)).astype(ranges.dtype)
        above = ranges > low if low == -math.inf else ranges >= low
        below = ranges < high if high == math.inf else ranges <= high
        index = (above & below).nonzero()[0]
        if len(index) < len(ranges):
            ranges = ranges[index]
        angles = index * self.angle_increment
        angles += self.angle_min
        points = np.zeros((len(index), 3), ranges.dtype)
        np.multiply(ranges, np.cos(angles), points[:, 0])
        np.multiply(ranges, np.sin(angles), points[:, 1])
        stamps = None
        if not isinstance(self.stamp, Latest):
            stamps = np.empty(len(index), np.int64)
            # Half the time of `np.full`.
            stamps.fill(self.stamp)
            if self.time_increment:
                stamps += np.rint(index * self.time_increment * SECOND).astype(np.int64)
            stamps = read_only(stamps)
        fields = {"index": read_only(index)}
        if self.intensities is not None:
            fields["intensities"] = read_only(self.intensities[index])
        return made(PointCloud, self.frame, self.stamp, read_only(points), stamps, MappingProxyType(fields))


def _number(value: object, name: str) -> float:
    if not is_real(value):
        raise TypeError(f"{name} must be a number, not {value!r}")
    return float(value)  # type: ignore[arg-type]
