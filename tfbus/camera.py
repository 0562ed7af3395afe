"""Pixels: where a point is in the picture of a camera, and where a pixel looks.

A camera looks along z of its optical frame, with x to the right and y down; `tfbus.axes.OPTICAL_FROM_BODY` leads
there. A point (x, y, z) of that frame becomes (x / z, y / z), which the lens distorts, and the camera matrix makes a
pixel of it. The models of a lens are those of ROS's ``sensor_msgs/CameraInfo``, with the formulas of OpenCV's calib3d:

* ``plumb_bob`` and ``rational_polynomial`` (Brown 1966, and a quotient of polynomials of the squared radius),
* ``equidistant``, a fisheye lens (Kannala and Brandt, "A generic camera model and calibration method for conventional,
  wide-angle, and fish-eye lenses", IEEE PAMI 28(8), 2006, with four coefficients).

A pixel is undistorted by Newton's method, to the last digits.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from tfbus.buffer.buffer import Buffer
from tfbus.data.clouds import PointCloud
from tfbus.data.dispatch import as_points, construct
from tfbus.data.messages import get, has
from tfbus.frames import check_frame
from tfbus.geometry.transform import Transform
from tfbus.geometry.transform_array import TransformArray
from tfbus.stamps import SECOND, StampLike, as_stamp, from_seconds

Floats = npt.NDArray[np.float64]
_Lens = Callable[[Floats, Floats, Floats], tuple[Floats, Floats, Floats]]

_MOST_COEFFICIENTS = {"plumb_bob": 5, "rational_polynomial": 12, "equidistant": 4}
_ALIASES = {"": "plumb_bob", "fisheye": "equidistant"}
_IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_STEPS = 30
_CONVERGED = 1e-12
_SAME_RAY = 1e-6


class Picture(NamedTuple):
    """Points of a cloud in a picture.

    Attributes
    ----------
    pixels : array of shape (n, 2)
        Column and row of each point; (0, 0) is the centre of the first pixel. NaN behind the camera.
    depth : array of shape (n,)
        In m, along z of the optical frame.
    visible : array of bool, shape (n,)
        Whether the point is in front of the camera and inside of the picture. Things in front of it are not considered.

    Examples
    --------
    >>> Picture(np.array([[370.0, 265.0]]), np.array([2.0]), np.array([True])).depth
    array([2.])
    """

    pixels: Floats
    depth: Floats
    visible: npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """A calibrated camera.

    Parameters
    ----------
    frame : str
        Its optical frame.
    width, height : int
        Of the picture, in pixels.
    matrix : array of shape (3, 3)
        Camera matrix, in pixels: ``[[fx, skew, cx], [0, fy, cy], [0, 0, 1]]``.
    model : str
        ``"plumb_bob"``, ``"rational_polynomial"`` or ``"equidistant"``.
    distortion : sequence of float
        The coefficients of the lens in the order of ``CameraInfo``: (k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4),
        or (k1, k2, k3, k4) for an equidistant one. Missing ones are 0.
    rotation : array of shape (3, 3), optional
        From the optical frame into that of the rectified picture.
    shift : sequence of 3 floats, optional
        Added after `rotation`, in m: the other camera of a stereo pair.

    Raises
    ------
    ValueError
        If the model is unknown, a shape or a number of coefficients is wrong, or the matrix cannot be inverted.
    InvalidTransformError
        If the frame has no name.

    Examples
    --------
    >>> camera = Camera("camera_optical", 640, 480, [[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]])
    >>> camera.project([[0.2, 0.1, 2.0]])
    (array([[370., 265.]]), array([2.]))
    >>> camera.deproject([[370.0, 265.0]], [2.0])
    array([[0.2, 0.1, 2. ]])
    """

    frame: str
    width: int
    height: int
    matrix: Floats
    model: str
    distortion: tuple[float, ...]
    rotation: Floats
    shift: Floats

    def __init__(
        self,
        frame: str,
        width: int,
        height: int,
        matrix: npt.ArrayLike,
        model: str = "plumb_bob",
        distortion: Sequence[float] = (),
        *,
        rotation: npt.ArrayLike = _IDENTITY,
        shift: npt.ArrayLike = (0.0, 0.0, 0.0),
    ) -> None:
        construct(self, frame, width, height, matrix, model, distortion, rotation, shift)

    def __post_init__(self) -> None:
        check_frame(self.frame)
        model = _ALIASES.get(self.model, self.model)
        coefficients = tuple(map(float, self.distortion))
        if model not in _MOST_COEFFICIENTS:
            known = ", ".join(map(repr, _MOST_COEFFICIENTS))
            raise ValueError(f"the model of the lens is {self.model!r}, not one of {known}")
        while coefficients and coefficients[-1] == 0.0:
            coefficients = coefficients[:-1]
        if len(coefficients) > _MOST_COEFFICIENTS[model]:
            raise ValueError(
                f"a lens of the model {model!r} has {_MOST_COEFFICIENTS[model]} coefficients, got {len(coefficients)}"
            )
        arrays = {"matrix": (3, 3), "rotation": (3, 3), "shift": (3,)}
        for name, shape in arrays.items():
            array = np.array(getattr(self, name), np.float64)
            if array.shape != shape:
                raise ValueError(f"{name} must have shape {shape}, got {array.shape}")
            object.__setattr__(self, name, array)
        if not (np.isfinite(self.matrix).all() and self.matrix[0, 0] and self.matrix[1, 1]):
            raise ValueError(f"the camera is not calibrated: its matrix is {self.matrix.tolist()}")
        object.__setattr__(self, "model", model)
        object.__setattr__(self, "distortion", coefficients)

    @classmethod
    def from_message(cls, message: object, *, rectified: bool = False) -> "Camera":
        """The camera of a ``sensor_msgs/CameraInfo``, an object or a mapping, of ROS 1 or ROS 2.

        Parameters
        ----------
        message : object or mapping
            Its region of interest and its binning count.
        rectified : bool
            Whether pixels are those of the rectified picture, ``image_rect``, which has no distortion; by default they
            are those of the picture as the camera takes it.

        Raises
        ------
        ValueError
            If the camera is not calibrated, or its model is unknown.
        TypeError
            If a field is missing.

        Examples
        --------
        >>> info = {"header": {"frame_id": "optical"}, "width": 640, "height": 480, "distortion_model": "plumb_bob",
        ...         "d": [], "k": [500.0, 0.0, 320.0, 0.0, 500.0, 240.0, 0.0, 0.0, 1.0],
        ...         "r": np.eye(3), "p": np.zeros(12)}
        >>> Camera.from_message(info).project([[0.0, 0.0, 1.0]])[0]
        array([[320., 240.]])
        """
        names = {name: name if has(message, name) else name.upper() for name in "dkrp"}
        d, k, r, p = (np.array(get(message, names[name]), np.float64).ravel() for name in "dkrp")
        x, y, width, height = 0, 0, int(get(message, "width")), int(get(message, "height"))
        if has(message, "roi"):
            region = get(message, "roi")
            x, y = int(get(region, "x_offset")), int(get(region, "y_offset"))
            # A region of no size is the whole picture.
            width, height = int(get(region, "width")) or width, int(get(region, "height")) or height
        across, down = (max(1, int(get(message, name))) if has(message, name) else 1 for name in _BINNING)
        whole = p.reshape(3, 4) if rectified else np.column_stack((k.reshape(3, 3), np.zeros(3)))
        # A pixel of the message's picture, of one of the whole picture.
        crop = np.array(((1.0 / across, 0.0, -x / across), (0.0, 1.0 / down, -y / down), (0.0, 0.0, 1.0)))
        matrix, last = crop @ whole[:, :3], crop @ whole[:, 3]
        frame = str(get(message, "header", "frame_id")).lstrip("/")
        if not rectified:
            model = str(get(message, "distortion_model"))
            return cls(frame, width // across, height // down, matrix, model, tuple(d.tolist()))
        if not matrix[0, 0]:
            raise ValueError("the camera is not calibrated: the projection matrix P of its message is zero")
        rotation, shift = r.reshape(3, 3), np.linalg.solve(matrix, last)
        return cls(frame, width // across, height // down, matrix, rotation=rotation, shift=shift)

    def project(self, points: npt.ArrayLike) -> tuple[Floats, Floats]:
        """The pixels of points.

        Parameters
        ----------
        points : array of shape (n, 3)
            In m, in the optical frame.

        Returns
        -------
        pixels : array of shape (n, 2)
            Column and row; NaN for points that are not in front of the camera. They may be outside of the picture.
        depth : array of shape (n,)
            In m, along z.

        Examples
        --------
        >>> camera = Camera("optical", 640, 480, [[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]])
        >>> camera.project([[0.2, 0.1, 2.0]])
        (array([[370., 265.]]), array([2.]))
        """
        x, y, depth = self._directions(as_points(points))
        return self._pixels(x, y), depth

    def ray(self, pixels: npt.ArrayLike) -> Floats:
        """Directions in which pixels look.

        Parameters
        ----------
        pixels : array of shape (n, 2)
            Column and row.

        Returns
        -------
        array of shape (n, 3)
            Unit vectors in the optical frame; NaN where the lens shows nothing. With a ``shift`` they begin beside its
            origin.

        Examples
        --------
        >>> camera = Camera("optical", 640, 480, [[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]])
        >>> camera.ray([[695.0, 240.0]])
        array([[0.6, 0. , 0.8]])
        """
        rays = self._straight(pixels)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        return rays @ self.rotation

    def deproject(self, pixels: npt.ArrayLike, depth: npt.ArrayLike) -> Floats:
        """The points of pixels at some depths, shape (n, 3), in m in the optical frame: `project` undone.

        Parameters
        ----------
        pixels : array of shape (n, 2)
        depth : array of shape (n,)
            In m, along z, as the pictures of depth cameras have it.

        Examples
        --------
        >>> camera = Camera("optical", 640, 480, [[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]])
        >>> camera.deproject([[370.0, 265.0]], [4.0])
        array([[0.4, 0.2, 4. ]])
        """
        points = self._straight(pixels) * np.asarray(depth, np.float64)[:, np.newaxis]
        return (points - self.shift) @ self.rotation

    async def project_cloud(
        self,
        buffer: Buffer,
        cloud: PointCloud,
        *,
        at: StampLike,
        fixed: str,
        row_time: float = 0.0,
        timeout: float | None = None,
    ) -> Picture:
        """A cloud of another sensor in a picture: each point seen at its own stamp, the picture taken at another.

        Parameters
        ----------
        buffer : Buffer
        cloud : PointCloud
            Points without stamps are all of the stamp of the cloud.
        at : int
            ns, when the first row of the picture was exposed.
        fixed : str
            The frame in which the things stand still, such as ``"odom"``.
        row_time : float
            The time in s from the exposure of one row to that of the next: a rolling shutter.
        timeout : float, optional
            In s on the bus's clock, for each of the two waits.

        Raises
        ------
        TransformError
            As `Buffer.lookup`.

        Examples
        --------
        >>> camera = Camera("optical", 640, 480, [[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]])
        >>> with Bus() as bus, Buffer(bus) as buffer:
        ...     TransformBroadcaster(bus).send_static("odom", "optical", Transform())
        ...     cloud = PointCloud("odom", 5, np.array([[0.2, 0.1, 2.0]]))
        ...     picture = await camera.project_cloud(buffer, cloud, at=5, fixed="odom")
        >>> picture.pixels, picture.visible
        (array([[370., 265.]]), array([ True]))
        """
        begin = as_stamp(at)
        end = begin + from_seconds(row_time * self.height)
        if cloud.stamps is None:
            in_fixed = await buffer.transform(cloud, fixed, timeout=timeout)
        else:
            in_fixed = await buffer.deskew(cloud, fixed, fixed=fixed, timeout=timeout)
        for instant in {min(begin, end), max(begin, end)}:
            await buffer.lookup(self.frame, fixed, instant, timeout=timeout)
        points = np.asarray(in_fixed.points, np.float64)
        rows = np.full(len(points), self.height // 2)
        # The row of a point says when it was exposed, and that moves it to another row: by less each time.
        for _ in range(_STEPS):
            exposed, which = np.unique(rows, return_inverse=True)
            stamps = begin + np.rint(exposed * row_time * SECOND).astype(np.int64)
            poses = [buffer.lookup_nowait(self.frame, fixed, stamp).transform for stamp in stamps.tolist()]
            seen = _array_of(poses)[which].apply(points)
            pixels, depth = self.project(seen)
            found = np.where(np.isnan(pixels[:, 1]), rows, np.clip(np.rint(pixels[:, 1]), 0, self.height - 1))
            if not row_time or (found == rows).all():
                break
            rows = found.astype(np.int64)
        return Picture(pixels, depth, self._visible(seen, pixels))

    def _directions(self, points: npt.NDArray[Any]) -> tuple[Floats, Floats, Floats]:
        x, y, z = (points.astype(np.float64) @ self.rotation.T + self.shift).T
        ahead = np.where(z > 0.0, z, np.nan)
        return x / ahead, y / ahead, z

    def _pixels(self, x: Floats, y: Floats) -> Floats:
        x, y = self._distorted(x, y)[:2]
        (fx, skew, cx), (_, fy, cy), _ = self.matrix
        return np.stack((fx * x + skew * y + cx, fy * y + cy), axis=-1)

    def _visible(self, points: Floats, pixels: Floats) -> npt.NDArray[np.bool_]:
        column, row = pixels.T
        inside: npt.NDArray[np.bool_] = (
            (column >= -0.5) & (column < self.width - 0.5) & (row >= -0.5) & (row < self.height - 0.5)
        )
        # Far outside of the picture, the polynomials of a lens turn round, and lead into the picture again.
        x, y, _ = self._directions(points[inside])
        rays = self._straight(pixels[inside])
        inside[inside] = np.hypot(rays[:, 0] - x, rays[:, 1] - y) <= _SAME_RAY * (1.0 + np.hypot(x, y))
        return inside

    def _straight(self, pixels: npt.ArrayLike) -> Floats:
        """The undistorted (x, y, 1) of pixels, shape (n, 3)."""
        array = np.asarray(pixels, np.float64)
        if array.ndim != 2 or array.shape[1] != 2:
            raise ValueError(f"pixels must have shape (n, 2), got {array.shape}")
        (fx, skew, cx), (_, fy, cy), _ = self.matrix
        seen_y = (array[:, 1] - cy) / fy
        seen_x = (array[:, 0] - cx - skew * seen_y) / fx
        x, y = seen_x.copy(), seen_y.copy()
        with np.errstate(all="ignore"):
            for _ in range(_STEPS if self.distortion or self.model == "equidistant" else 0):
                found_x, found_y, slopes = self._distorted(x, y)
                (xx, xy), (yx, yy) = slopes
                wrong_x, wrong_y = found_x - seen_x, found_y - seen_y
                determinant = xx * yy - xy * yx
                step_x = (yy * wrong_x - xy * wrong_y) / determinant
                step_y = (xx * wrong_y - yx * wrong_x) / determinant
                # Newton's step leads astray if it is longer than the way to the pixel.
                most = 0.5 * (0.1 + np.hypot(x, y))
                length = np.hypot(step_x, step_y)
                shorter = np.minimum(1.0, most / np.where(length > 0.0, length, 1.0))
                x, y = x - shorter * step_x, y - shorter * step_y
                if np.nanmax(length, initial=0.0) < _CONVERGED:
                    break
            found_x, found_y, slopes = self._distorted(x, y)
            lost = ~(np.hypot(found_x - seen_x, found_y - seen_y) < _SAME_RAY * 1e-3)
            lost |= ~(slopes[0, 0] * slopes[1, 1] - slopes[0, 1] * slopes[1, 0] > 0.0)
        x[lost] = y[lost] = np.nan
        return np.stack((x, y, np.ones_like(x)), axis=-1)

    def _distorted(self, x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
        """The places at which the lens shows (x, y), and their derivatives by x and y, shape (2, 2, n)."""
        lens: _Lens = _equidistant if self.model == "equidistant" else _polynomial
        wanted = 4 if self.model == "equidistant" else 12
        return lens(x, y, np.array((*self.distortion, *([0.0] * (wanted - len(self.distortion))))))


_BINNING = ("binning_x", "binning_y")


def _array_of(poses: list[Transform]) -> TransformArray:
    translations = np.array([pose.translation for pose in poses], np.float64).reshape(-1, 3)
    return TransformArray(translations, np.array([pose.rotation for pose in poses], np.float64).reshape(-1, 4))


def _polynomial(x: Floats, y: Floats, coefficients: Floats) -> tuple[Floats, Floats, Floats]:
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = coefficients.tolist()
    r2 = x * x + y * y
    above = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    below = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = above / below
    # By r2.
    slope = (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3) - radial * (k4 + r2 * (2.0 * k5 + 3.0 * r2 * k6))) / below
    found_x = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) + r2 * (s1 + r2 * s2)
    found_y = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y + r2 * (s3 + r2 * s4)
    mixed = 2.0 * x * y * slope + 2.0 * (p1 * x + p2 * y)
    prism_x, prism_y = 2.0 * (s1 + 2.0 * r2 * s2), 2.0 * (s3 + 2.0 * r2 * s4)
    xx = radial + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x + x * prism_x
    yy = radial + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x + y * prism_y
    return found_x, found_y, np.stack((np.stack((xx, mixed + y * prism_x)), np.stack((mixed + x * prism_y, yy))))


def _equidistant(x: Floats, y: Floats, coefficients: Floats) -> tuple[Floats, Floats, Floats]:
    k1, k2, k3, k4 = coefficients.tolist()
    r = np.hypot(x, y)
    angle = np.arctan(r)
    a2 = angle * angle
    shown = angle * (1.0 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))
    near = r < 1e-8
    safe = np.where(near, 1.0, r)
    scale = np.where(near, 1.0, shown / safe)
    # The derivative of `shown` by r.
    slope = (1.0 + a2 * (3.0 * k1 + a2 * (5.0 * k2 + a2 * (7.0 * k3 + a2 * 9.0 * k4)))) / (1.0 + r * r)
    across = np.where(near, 0.0, (slope - scale) / (safe * safe))
    mixed = across * x * y
    slopes = np.stack((np.stack((scale + across * x * x, mixed)), np.stack((mixed, scale + across * y * y))))
    return x * scale, y * scale, slopes
