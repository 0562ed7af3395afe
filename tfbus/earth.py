"""Places on the earth: latitude, longitude and height, earth-centred coordinates, and local maps.

All are of WGS 84. Heights are above its ellipsoid. Heights above the sea (a geoid) and grids such as UTM are not here:
pyproj has them.

Earth-centred, earth-fixed coordinates (ECEF) have x to latitude 0 and longitude 0, y to longitude 90, z to the north
pole: the frame ``earth`` of REP 105.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from tfbus.data.points import NavSatFix, PointStamped
from tfbus.geometry.stamped import TransformStamped
from tfbus.geometry.transform import Transform

SEMI_MAJOR = 6_378_137.0
"""The radius of the equator in m."""
FLATTENING = 1.0 / 298.257_223_563
_E2 = FLATTENING * (2.0 - FLATTENING)
_E4 = _E2 * _E2

Floats = npt.NDArray[np.float64]


def to_ecef(latitude: npt.ArrayLike, longitude: npt.ArrayLike, height: npt.ArrayLike = 0.0) -> Floats:
    """Earth-centred coordinates of places.

    Parameters
    ----------
    latitude, longitude : float or array of shape (...)
        In degrees.
    height : float or array of shape (...)
        In m above the ellipsoid.

    Returns
    -------
    array of shape (..., 3)
        In m.

    Examples
    --------
    >>> to_ecef(0.0, 90.0).round(3) + 0.0
    array([      0., 6378137.,       0.])
    """
    phi, lam = np.radians(latitude), np.radians(longitude)
    height = np.asarray(height, np.float64)
    normal = SEMI_MAJOR / np.sqrt(1.0 - _E2 * np.sin(phi) ** 2)
    flat = (normal + height) * np.cos(phi)
    up = (normal * (1.0 - _E2) + height) * np.sin(phi)
    return np.stack(np.broadcast_arrays(flat * np.cos(lam), flat * np.sin(lam), up), axis=-1)


def from_ecef(points: npt.ArrayLike) -> tuple[Any, Any, Any]:
    """Latitude and longitude in degrees, and height in m above the ellipsoid, of earth-centred coordinates.

    Parameters
    ----------
    points : array of shape (..., 3)
        In m.

    Returns
    -------
    tuple of 3 floats or arrays of shape (...)
        NaN for a point within some 43 km of the centre of the earth, where the formula does not hold.

    Notes
    -----
    The closed form of Vermeille, "Direct transformation from geocentric coordinates to geodetic coordinates", Journal
    of Geodesy 76, 2002, pages 451 to 454.

    Examples
    --------
    >>> [round(number, 6) for number in from_ecef((0.0, 6_378_137.0, 0.0))]
    [0.0, 90.0, 0.0]
    """
    x, y, z = np.moveaxis(np.asarray(points, np.float64), -1, 0)
    flat = np.hypot(x, y)
    p = (flat / SEMI_MAJOR) ** 2
    q = (1.0 - _E2) * (z / SEMI_MAJOR) ** 2
    r = (p + q - _E4) / 6.0
    with np.errstate(invalid="ignore", divide="ignore"):
        s = np.where(r > 0.0, _E4 * p * q / (4.0 * r**3), np.nan)
        t = np.cbrt(1.0 + s + np.sqrt(s * (2.0 + s)))
        u = r * (1.0 + t + 1.0 / t)
        v = np.sqrt(u**2 + _E4 * q)
        w = _E2 * (u + v - q) / (2.0 * v)
        k = np.sqrt(u + v + w**2) - w
        d = k * flat / (k + _E2)
        height = (k + _E2 - 1.0) / k * np.hypot(d, z)
        latitude = np.degrees(2.0 * np.arctan2(z, d + np.hypot(d, z)))
    found = latitude, np.degrees(np.arctan2(y, x)), height
    return found if np.ndim(flat) else tuple(map(float, found))  # type: ignore[return-value]


@dataclass(frozen=True, slots=True)
class Datum:
    """A place on the earth at which a local map begins.

    Parameters
    ----------
    latitude, longitude : float
        In degrees.
    height : float
        In m above the ellipsoid.
    ned : bool
        Whether the axes of the map are north, east and down; by default they are east, north and up.

    Examples
    --------
    >>> datum = Datum(48.0, 11.0, 500.0)
    >>> fix = NavSatFix("gps", 0, 48.001, 11.0, 500.0)
    >>> [round(number, 3) + 0.0 for number in datum.point(fix).point]
    [0.0, 111.199, -0.001]
    """

    latitude: float
    longitude: float
    height: float = 0.0
    ned: bool = False

    def __post_init__(self) -> None:
        if not (abs(self.latitude) <= 90.0 and np.isfinite((self.longitude, self.height)).all()):
            raise ValueError(
                f"a datum needs a latitude from -90 to 90, a longitude and a height, got {self.latitude!r}, "
                f"{self.longitude!r} and {self.height!r}"
            )

    @property
    def earth_from_map(self) -> Transform:
        """The transform that maps coordinates of the map into earth-centred ones."""
        phi, lam = np.radians((self.latitude, self.longitude))
        east = np.array((-np.sin(lam), np.cos(lam), 0.0))
        north = np.array((-np.sin(phi) * np.cos(lam), -np.sin(phi) * np.sin(lam), np.cos(phi)))
        up = np.array((np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)))
        matrix = np.eye(4)
        matrix[:3, :3] = np.stack((north, east, -up) if self.ned else (east, north, up), axis=1)
        matrix[:3, 3] = to_ecef(self.latitude, self.longitude, self.height)
        return Transform.from_matrix(matrix)

    def sample(
        self, frame: str = "map", *, earth: str = "earth", stamp: int = 0, authority: str = ""
    ) -> TransformStamped:
        """The static sample that hangs the map below the earth, for `Bus.publish`.

        Examples
        --------
        >>> sample = Datum(0.0, 0.0).sample("map")
        >>> sample.parent, sample.child, sample.static
        ('earth', 'map', True)
        """
        return TransformStamped(earth, frame, stamp, self.earth_from_map, authority, static=True)

    def to_map(self, latitude: npt.ArrayLike, longitude: npt.ArrayLike, height: npt.ArrayLike = 0.0) -> Floats:
        """The coordinates of places in the map, shape (..., 3), in m; see `to_ecef`.

        Examples
        --------
        >>> Datum(48.0, 11.0).to_map(48.0, 11.0, 2.0).round(6) + 0.0
        array([0., 0., 2.])
        """
        return self.earth_from_map.inverse().apply(to_ecef(latitude, longitude, height))

    def from_map(self, points: npt.ArrayLike) -> tuple[Any, Any, Any]:
        """Latitude and longitude in degrees, and height in m, of points of the map, shape (..., 3).

        Examples
        --------
        >>> [round(number, 6) for number in Datum(48.0, 11.0).from_map((0.0, 0.0, 2.0))]
        [48.0, 11.0, 2.0]
        """
        return from_ecef(self.earth_from_map.apply(np.asarray(points, np.float64)))

    def point(self, fix: NavSatFix, frame: str = "map") -> PointStamped:
        """The place of the antenna in the map.

        Raises
        ------
        ValueError
            If the fix has a status below 0: the receiver had no position.

        Examples
        --------
        >>> point = Datum(48.0, 11.0).point(NavSatFix("gps", 5, 48.0, 11.0, 2.0))
        >>> point.frame, round(point.point[2], 6)
        ('map', 2.0)
        """
        if fix.status < 0:
            raise ValueError("the receiver had no position: the status of the fix is -1")
        return PointStamped(frame, fix.stamp, self.to_map(fix.latitude, fix.longitude, fix.altitude))
