"""``tfbus static``."""

from typing import Annotated

import anyio
from cyclopts import Parameter

from tfbus.bus.bus import Bus
from tfbus.cli._static_frames import publish_static
from tfbus.cli.arguments import UsageError
from tfbus.cli.domain import DEFAULT_LINK, LinkOptions
from tfbus.cli.output import format_transform, say
from tfbus.errors import InvalidTransformError
from tfbus.geometry.bounds import MAX_TRANSLATION, check_translations
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
    link: LinkOptions = DEFAULT_LINK,
) -> None:
    """Publish the static transform of CHILD in PARENT, until Ctrl-C.

    Programs that join later receive it too. If an edge of another program is in its way, it is tried again once a
    second. After the end, programs that have it keep it; those that join do not get
    it.

    Example: tfbus static base_link base_laser --xyz 0.1 0 0.2 --rpy 0 0 1.5708

    Parameters
    ----------
    parent
        The frame in which the numbers are expressed.
    child
        The frame to place.
    xyz
        The origin of CHILD in PARENT: x y z, in m.
    rpy
        The rotation of CHILD as roll, pitch and yaw about the fixed axes x, y and z of PARENT, in rad.
    quaternion
        The rotation of CHILD as a unit quaternion x y z w.
    authority
        The sender that tools show.
    """
    sample = _sample(parent, child, xyz, rpy, quaternion, authority)

    async def publish(bus: Bus) -> None:
        numbers = format_transform(sample.transform)
        say(f"publishing {child!r} in {parent!r} on {link.place}, until Ctrl-C: {numbers}")
        await publish_static(bus, [sample.replace(stamp=bus.clock.now())])
        await anyio.sleep_forever()

    link.run(publish)


def _sample(
    parent: str, child: str, xyz: Vector, rpy: Vector | None, quaternion: Quaternion | None, authority: str
) -> TransformStamped:
    if rpy is not None and quaternion is not None:
        raise UsageError("--rpy and --quaternion are two ways to say the same: give one of them")
    try:
        if quaternion is not None:
            transform = Transform(xyz, quaternion)
        else:
            transform = Transform.from_xyz_rpy(xyz, (0, 0, 0) if rpy is None else rpy)
        sample = TransformStamped(parent, child, 0, transform, authority, static=True)
        check_translations((sample,), MAX_TRANSLATION)
    except InvalidTransformError as error:
        raise UsageError(str(error)) from None
    unsendable = refusal(sample)
    if unsendable is not None:
        raise UsageError(str(unsendable))
    return sample
