"""`do_transform`, which transforms data of any registered type into another frame."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from functools import singledispatch, wraps
from itertools import repeat
from types import MappingProxyType
from typing import Any, Protocol, TypeVar, cast, overload

import numpy as np
import numpy.typing as npt

from tfbus.frames import check_frame
from tfbus.geometry.stamped import TransformStamped
from tfbus.geometry.transform import Transform
from tfbus.geometry.transform_array import locked
from tfbus.rows import Vector
from tfbus.stamps import LATEST, Latest, as_array, as_stamp


def as_floats(value: npt.ArrayLike, name: str) -> npt.NDArray[Any]:
    """An array of floats: floats are not copied, integers become float64.

    Raises
    ------
    TypeError
        If they are not numbers. The message names `name` and the dtype.
    ValueError
        If an element is masked.
    """
    array = as_array(value, name)
    if array.dtype.kind in "iu":
        return array.astype(np.float64)
    if array.dtype.kind != "f":
        raise TypeError(f"{name} must be numbers, not of dtype {array.dtype}")
    return array


def as_points(value: npt.ArrayLike) -> npt.NDArray[Any]:
    """Points as an array of shape (n, 3) of floats, converted by `as_floats`.

    Raises
    ------
    ValueError
        If the shape is another. The message has the shape.
    TypeError
        If they are not numbers.
    """
    array = as_floats(value, "points")
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(f"points must have shape (n, 3), got {array.shape}")
    return array


def as_covariance(value: npt.ArrayLike, name: str, size: int) -> npt.NDArray[np.float64]:
    """A read-only copy of a covariance, shape (size, size), of a matrix or of its numbers row by row.

    Raises
    ------
    ValueError
        If the shape is another. The message has the shape.
    """
    covariance: npt.NDArray[Any] = as_floats(value, name).astype(np.float64)
    if covariance.shape not in ((size, size), (size * size,)):
        raise ValueError(f"{name} must have shape ({size}, {size}) or ({size * size},), got {covariance.shape}")
    return locked(covariance.reshape(size, size))


class CopiedByFields:
    """A base of dataclasses: copies and unpickled objects are built from the fields, so that arrays are read-only."""

    __slots__ = ()

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        values = {field.name: getattr(self, field.name) for field in fields(self)}  # type: ignore[arg-type]
        for name, value in values.items():
            if isinstance(value, MappingProxyType):
                values[name] = dict(value)
        return _build, (type(self), values)


def _build(kind: type, values: dict[str, Any]) -> Any:
    return kind(**values)


class Stamped(Protocol):
    """Any object with a frame and a stamp.

    Examples
    --------
    >>> point: Stamped = PointStamped("laser", 0, (1.0, 2.0, 3.0))
    >>> point.frame, point.stamp
    ('laser', 0)
    """

    @property
    def frame(self) -> str:
        """The frame of the data."""

    @property
    def stamp(self) -> int | Latest:
        """ns, or `LATEST`."""


DataT = TypeVar("DataT")
FunctionT = TypeVar("FunctionT", bound=Callable[..., Any])


class DoTransform(Protocol):
    """The type of `do_transform`: a ``singledispatch`` function whose result has the type of its first argument."""

    def __call__(self, data: DataT, transform: TransformStamped) -> DataT: ...

    @overload
    def register(self, cls: FunctionT) -> FunctionT: ...
    @overload
    def register(self, cls: type[Any]) -> Callable[[FunctionT], FunctionT]: ...
    @overload
    def register(self, cls: type[Any], func: FunctionT) -> FunctionT: ...
    def register(self, cls: Any, func: Any = None) -> Any:
        """Register a function for the type of its first parameter, or for `cls`."""

    def dispatch(self, cls: type[Any]) -> Callable[..., Any]:
        """The function for a type."""


def _dispatched(function: Callable[[Any, TransformStamped], Any]) -> DoTransform:
    generic = singledispatch(function)
    registered = generic.registry.get

    @wraps(generic)
    def dispatch(data: Any, transform: TransformStamped) -> Any:
        try:
            # Its own search takes longer than to move a point, even for a type that is registered itself.
            return (registered(type(data)) or generic)(data, transform)
        except (AttributeError, TypeError):
            check_transform(data, transform)
            raise

    return cast(DoTransform, dispatch)


def is_message(thing: object) -> bool:
    """Whether something looks like a stamped message of ROS, an object or a mapping."""
    return "header" in thing if isinstance(thing, Mapping) else hasattr(thing, "header")


def check_registered(data: object) -> None:
    """Raise `TypeError` unless `do_transform` knows the type of `data`; the message says how to register it."""
    if do_transform.dispatch(type(data)) is do_transform.dispatch(object):
        kind = type(data).__name__
        if is_message(data):
            raise TypeError(f"cannot transform a {kind}: convert a ROS message with from_message first")
        instead = "transform its to_points() instead, or " if hasattr(data, "to_points") else ""
        raise TypeError(f"cannot transform a {kind}: {instead}register a function with @do_transform.register({kind})")


def check_transform(data: object, transform: object) -> None:
    """Raise `TypeError` unless `transform` is a `TransformStamped`; the message says what the arguments look like."""
    if isinstance(transform, TransformStamped):
        return
    if isinstance(data, TransformStamped):
        raise TypeError("do_transform takes the data first: do_transform(data, transform)") from None
    if isinstance(transform, Transform):
        raise TypeError(
            "a Transform has no frames and no stamp: give do_transform a TransformStamped, as a lookup does, or move "
            "bare points by transform.apply(points)"
        ) from None
    raise TypeError(f"do_transform takes a TransformStamped, not {transform!r}") from None


@_dispatched
def do_transform(data: Any, transform: TransformStamped) -> Any:  # noqa: ARG001 - the registered functions use it
    """Transform `data` into the target frame of `transform`; the result has the stamp of `transform`.

    Parameters
    ----------
    data : any type of `tfbus.data` but LaserScan, or a registered type
        A subclass that is not registered itself is transformed as its base class.
    transform : TransformStamped
        From the frame of `data` into the target.

    Returns
    -------
    same type as `data`
        New data; `data` are not changed.

    Raises
    ------
    TypeError
        If the type is not registered, whose message says how to register it, or `transform` is not a
        `TransformStamped`.
    ValueError
        If the frame of the data is not the source frame of the transform.

    Examples
    --------
    >>> base_from_laser = TransformStamped("base_link", "laser", 0, Transform((0.1, 0.0, 0.2)))
    >>> do_transform(PointStamped("laser", 0, (1.0, 0.2, 0.0)), base_from_laser)
    PointStamped(frame='base_link', stamp=0, point=(1.1, 0.2, 0.2))
    """
    check_registered(data)


def moved_header(data: Stamped, transform: TransformStamped) -> tuple[str, int]:
    """The frame and the stamp of `data` after the transform.

    Raises
    ------
    ValueError
        If the frame of the data is not the source frame of the transform.
    """
    if data.frame != transform.child:
        raise ValueError(f"the data are in frame {data.frame!r}, but the transform is from {transform.child!r}")
    return transform.parent, transform.stamp


def construct(data: Any, *values: object) -> None:
    """Set the fields of a frozen dataclass and check them, as its own ``__init__`` does.

    A class writes its ``__init__`` for the types of its arguments, which are wider than the types of its fields.
    """
    # The fields of a subclass begin with the fields of its base.
    for name, value in zip(data.__match_args__, values, strict=False):
        object.__setattr__(data, name, value)
    data.__post_init__()


def made(kind: type[DataT], *values: object) -> DataT:
    """Data of a frozen dataclass, made of valid fields; nothing is checked."""
    data = object.__new__(kind)
    # Half the time of a loop over pairs.
    for _ in map(object.__setattr__, repeat(data), kind.__match_args__, values):  # type: ignore[attr-defined]
        pass
    return data


def check_header(data: Stamped) -> None:
    """Check the frame and the stamp of a frozen dataclass under construction; the stamp becomes a plain ``int``.

    Raises
    ------
    InvalidTransformError
        If the frame is empty or starts with ``/``.
    TypeError, ValueError
        If the stamp is neither `LATEST` nor an integer of 64 bits.
    """
    check_frame(data.frame)
    if data.stamp is not LATEST:
        object.__setattr__(data, "stamp", as_stamp(data.stamp))


def check_pose(pose: object) -> None:
    """Raise `TypeError` unless `pose` is a `Transform`."""
    if not isinstance(pose, Transform):
        raise TypeError(f"pose must be a Transform, not {pose!r}")


def as_triple(value: Any, name: str) -> Vector:
    """Three numbers as a tuple of floats; NaN and infinity are allowed, because sensors send them.

    Raises
    ------
    ValueError
        If there are not three. The message has the shape.
    TypeError
        If they are not numbers in a sequence or an array.
    """
    if isinstance(value, (str, bytes)) or not isinstance(value, (Sequence, np.ndarray)):
        raise TypeError(f"{name} must be three numbers, not {value!r}")
    shape = getattr(value, "shape", (len(value),))
    if shape != (3,):
        raise ValueError(f"{name} must be three numbers, got shape {shape}")
    try:
        for part in value:
            # `float` would read digits in a string.
            math.isnan(part)
    except TypeError:
        raise TypeError(f"{name} must be three numbers, not {value!r}") from None
    x, y, z = value
    return float(x), float(y), float(z)


def set_triples(data: object, *names: str) -> None:
    """Convert some fields of a frozen dataclass under construction by `as_triple`."""
    for name in names:
        object.__setattr__(data, name, as_triple(getattr(data, name), name))
