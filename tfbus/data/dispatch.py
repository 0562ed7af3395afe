"""`do_transform`, which moves data of any registered type into another frame."""

from functools import singledispatch
from typing import Any

from tfbus.data._header import Stamped
from tfbus.geometry.stamped import TransformStamped


def check_registered(data: object) -> None:
    """Raise `TypeError` unless `do_transform` knows the type of `data`; the message says how to register it."""
    if do_transform.dispatch(type(data)) is do_transform.dispatch(object):
        kind = type(data).__name__
        instead = "transform its to_points() instead, or " if hasattr(data, "to_points") else ""
        raise TypeError(f"cannot transform a {kind}: {instead}register a function with @do_transform.register({kind})")


@singledispatch
def do_transform(data: Any, transform: TransformStamped) -> Any:  # noqa: ARG001 - the registered functions use it
    """`data` in the target frame of `transform`, with its stamp.

    Parameters
    ----------
    data : any type of `tfbus.data` but LaserScan, or a registered type
        A subclass that is not registered itself comes back as its base class.
    transform : TransformStamped
        From the frame of `data` into the target.

    Returns
    -------
    same type as `data`
        New data; the given ones are not changed.

    Raises
    ------
    TypeError
        If the type is not registered. The message says how to register it.
    ValueError
        If the data are not in the frame that the transform is from.
    """
    check_registered(data)


def moved_header(data: Stamped, transform: TransformStamped) -> tuple[str, int]:
    """Frame and stamp that `data` have once `transform` has moved them.

    Raises
    ------
    ValueError
        If the data are not in the frame that the transform is from.
    """
    if data.frame != transform.child:
        raise ValueError(f"the data are in frame {data.frame!r}, but the transform is from {transform.child!r}")
    return transform.parent, transform.stamp
