"""Data that carry their frame and their stamp, and how a transform moves them.

``do_transform(data, transform)`` gives new data in the transform's target frame; inputs are never changed. It is a
`functools.singledispatch` function: register your own types with ``@do_transform.register``.
"""

from dataclasses import dataclass
from functools import singledispatch
from typing import Any, Protocol

from tfbus.geometry import Transform, Vector
from tfbus.stamped import TransformStamped, check_frame
from tfbus.stamps import LATEST, Latest, as_stamp


class Stamped(Protocol):
    """Anything with a frame and a stamp."""

    @property
    def frame(self) -> str:
        """The frame that the data are in."""

    @property
    def stamp(self) -> int | Latest:
        """ns, or `LATEST`."""


@dataclass(frozen=True, slots=True)
class PointStamped:
    """A position.

    Parameters
    ----------
    frame : str
    stamp : int or LATEST
        ns.
    point : sequence of 3 floats
        (x, y, z) in m. NaN is allowed: it is what a sensor sends for "nothing there".
    """

    frame: str
    stamp: int | Latest
    point: Vector

    def __post_init__(self) -> None:
        _check_header(self)
        object.__setattr__(self, "point", _three_numbers(self.point, "point"))


@dataclass(frozen=True, slots=True)
class Vector3Stamped:
    """A direction with a length, such as a velocity or a normal: a transform turns it and does not shift it.

    Parameters
    ----------
    frame : str
    stamp : int or LATEST
        ns.
    vector : sequence of 3 floats
        (x, y, z) in whatever unit; it stays.
    """

    frame: str
    stamp: int | Latest
    vector: Vector

    def __post_init__(self) -> None:
        _check_header(self)
        object.__setattr__(self, "vector", _three_numbers(self.vector, "vector"))


@dataclass(frozen=True, slots=True)
class PoseStamped:
    """A position and an orientation.

    Parameters
    ----------
    frame : str
    stamp : int or LATEST
        ns.
    pose : Transform
        Maps coordinates of the posed body into `frame`.
    """

    frame: str
    stamp: int | Latest
    pose: Transform

    def __post_init__(self) -> None:
        _check_header(self)
        if not isinstance(self.pose, Transform):
            raise TypeError(f"pose must be a Transform, not {self.pose!r}")


def _check_header(data: PointStamped | Vector3Stamped | PoseStamped) -> None:
    check_frame(data.frame)
    if data.stamp is not LATEST:
        object.__setattr__(data, "stamp", as_stamp(data.stamp))


def _three_numbers(value: Any, name: str) -> Vector:
    if isinstance(value, (str, bytes)) or not hasattr(value, "__len__"):
        raise TypeError(f"{name} must be three numbers, not {value!r}")
    if len(value) != 3:
        raise ValueError(f"{name} must be three numbers, got shape ({len(value)},)")
    if any(isinstance(part, str) for part in value):
        raise TypeError(f"{name} must be three numbers, not {value!r}")
    x, y, z = value
    return float(x), float(y), float(z)


def check_registered(data: object) -> None:
    """Raise `TypeError` unless `do_transform` knows the type of `data`; the message says how to register it."""
    if do_transform.dispatch(type(data)) is do_transform.dispatch(object):
        kind = type(data).__name__
        raise TypeError(f"cannot transform a {kind}: register a function with @do_transform.register({kind})")


@singledispatch
def do_transform(data: Any, transform: TransformStamped) -> Any:  # noqa: ARG001 - the registered functions use it
    """`data` in the target frame of `transform`, with its stamp.

    Parameters
    ----------
    data : PointStamped, Vector3Stamped, PoseStamped, or a registered type
    transform : TransformStamped
        From the frame of `data` into the target.

    Raises
    ------
    TypeError
        If the type is not registered. The message says how to register it.
    ValueError
        If the data are not in the frame that the transform is from.
    """
    check_registered(data)


def _check_source(data: Stamped, transform: TransformStamped) -> None:
    if data.frame != transform.child:
        raise ValueError(f"the data are in frame {data.frame!r}, but the transform is from {transform.child!r}")


@do_transform.register
def _(data: PointStamped, transform: TransformStamped) -> PointStamped:
    _check_source(data, transform)
    return PointStamped(transform.parent, transform.stamp, transform.transform.apply(data.point))


@do_transform.register
def _(data: Vector3Stamped, transform: TransformStamped) -> Vector3Stamped:
    _check_source(data, transform)
    turn = Transform((0.0, 0.0, 0.0), transform.transform.rotation)
    return Vector3Stamped(transform.parent, transform.stamp, turn.apply(data.vector))


@do_transform.register
def _(data: PoseStamped, transform: TransformStamped) -> PoseStamped:
    _check_source(data, transform)
    return PoseStamped(transform.parent, transform.stamp, transform.transform @ data.pose)
