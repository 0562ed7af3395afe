"""`do_transform`, which transforms data of any registered type into another frame."""

from collections.abc import Callable
from functools import singledispatch
from typing import Any, Protocol, TypeVar, cast, overload

from tfbus.geometry.stamped import TransformStamped
from tfbus.stamps import Latest


class Stamped(Protocol):
    """Any object with a frame and a stamp."""

    @property
    def frame(self) -> str:
        """The frame of the data."""

    @property
    def stamp(self) -> int | Latest:
        """ns, or `LATEST`."""


DataT = TypeVar("DataT")
FunctionT = TypeVar("FunctionT", bound=Callable[..., Any])


class DoTransform(Protocol):
    """The type of `do_transform`: a ``singledispatch`` function that returns what it is given."""

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
    return cast(DoTransform, singledispatch(function))


def check_registered(data: object) -> None:
    """Raise `TypeError` unless `do_transform` knows the type of `data`; the message says how to register it."""
    if do_transform.dispatch(type(data)) is do_transform.dispatch(object):
        kind = type(data).__name__
        instead = "transform its to_points() instead, or " if hasattr(data, "to_points") else ""
        raise TypeError(f"cannot transform a {kind}: {instead}register a function with @do_transform.register({kind})")


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
        If the type is not registered. The message says how to register it.
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
