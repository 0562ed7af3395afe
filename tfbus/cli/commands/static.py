"""``tfbus static``."""

from typing import Annotated

import anyio
from cyclopts import Parameter

from tfbus.bus.bus import Bus
from tfbus.cli.domain import LOCAL, LinkOptions, UnusableError, say
from tfbus.errors import InvalidTransformError
from tfbus.geometry.rows import Quaternion, Vector
from tfbus.geometry.stamped import TransformStamped
from tfbus.geometry.transform import Transform
from tfbus.tf_message import refusal


def static(
    parent: str,
    child: str,
    /,
    *,
    xyz: Annotated[Vector, Parameter(negative="")] = (0.0, 0.0, 0.0),
    rpy: Annotated[Vector | None, Parameter(negative="")] = None,
    quaternion: Annotated[Quaternion | None, Parameter(negative="")] = None,
    authority: str = "tfbus static",
    link: LinkOptions = LOCAL,
) -> None:
    """Publish where CHILD is, seen from PARENT, once and for all, for as long as this runs; Ctrl-C ends it.

    Whoever joins later gets it too. After the end, those who have it keep it, and those who join do not get it.

    Example: tfbus static base_link base_laser --xyz 0.1 0 0.2 --rpy 0 0 1.5708

    Parameters
    ----------
    parent
        The frame that the numbers are told in.
    child
        The frame that is placed.
    xyz
        The origin of CHILD in PARENT: x y z, in m.
    rpy
        Its rotation as roll, pitch and yaw about the fixed axes x, y and z of PARENT, in rad.
    quaternion
        Its rotation as a unit quaternion x y z w.
    authority
        Who says so, as shown by tools.
    """
    sample = _sample(parent, child, xyz, rpy, quaternion, authority)

    async def publish(bus: Bus) -> None:
        bus.publish(sample.replace(stamp=bus.clock.now()))
        say(f"publishing {child!r} in {parent!r} on domain {link.domain!r}, until Ctrl-C: {describe(sample.transform)}")
        await anyio.sleep_forever()

    link.run(publish)


def describe(transform: Transform) -> str:
    """A transform in a few words, with its units."""
    xyz, rpy = (" ".join(f"{x:g}" for x in numbers) for numbers in (transform.translation, transform.as_rpy()))
    return f"xyz {xyz} m, rpy {rpy} rad"


def _sample(
    parent: str, child: str, xyz: Vector, rpy: Vector | None, quaternion: Quaternion | None, authority: str
) -> TransformStamped:
    if rpy is not None and quaternion is not None:
        raise UnusableError("--rpy and --quaternion are two ways to say the same: give one of them")
    try:
        transform = (
            Transform(xyz, quaternion) if quaternion is not None else Transform.from_xyz_rpy(xyz, rpy or (0, 0, 0))
        )
        sample = TransformStamped(parent, child, 0, transform, authority, static=True)
    except InvalidTransformError as error:
        raise UnusableError(str(error)) from None
    if (unsendable := refusal(sample)) is not None:
        raise UnusableError(str(unsendable))
    return sample
