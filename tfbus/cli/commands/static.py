"""``tfbus static``."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from tfbus.cli.arguments import Quaternion, UsageError, Vector, is_number, usage_errors
from tfbus.cli.domain import DEFAULT_LINK, LinkOptions, publish_static
from tfbus.cli.lazy_imports import lazy_imports
from tfbus.cli.output import format_numbers, format_transform, say, warn

with lazy_imports():
    import anyio

    from tfbus.bus.bus import Bus
    from tfbus.geometry.stamped import MAX_TRANSLATION, TransformStamped, check_translations
    from tfbus.geometry.transform import Transform
    from tfbus.recording.static_frames import load_static
    from tfbus.tf_message import refusal

_FILES = (".json", ".yaml", ".yml")


def static(
    parent: str,
    child: str | None = None,
    /,
    *further: Annotated[str, Parameter(show=False)],
    xyz: Vector = (0.0, 0.0, 0.0),
    rpy: Vector | None = None,
    rpy_deg: Vector | None = None,
    quaternion: Quaternion | None = None,
    authority: str = "tfbus static",
    link: LinkOptions = DEFAULT_LINK,
) -> None:
    """Publish the static transform of CHILD in PARENT, or all transforms of a file, until Ctrl-C.

    Programs that join later receive it too. If it conflicts with an edge of another program, it is tried again once a
    second. After Ctrl-C, programs that have it keep it; programs that join later do not get it.

    Example: tfbus static base_link base_laser --xyz 0.1 0 0.2 --rpy 0 0 1.5708

    Example: tfbus static calibration.yaml

    Parameters
    ----------
    parent
        The frame in which the numbers are expressed; or, without CHILD, a file of YAML or JSON: a list whose entries
        have a parent, a child, xyz, and rpy, rpy_deg or quaternion, as `save_static` writes it. Entries with
        translation and rotation are read too, as `tfbus convert --static-to-yaml` writes them, and those of
        `TransformStamped.to_dict`.
    child
        The frame to place.
    xyz
        The origin of CHILD in PARENT: x y z, in m.
    rpy
        The rotation of CHILD as roll, pitch and yaw about the fixed axes x, y and z of PARENT, in rad.
    rpy_deg
        The same in degrees.
    quaternion
        The rotation of CHILD as a unit quaternion x y z w.
    authority
        The sender that tools show.
    """
    _check_habits((parent, *([] if child is None else [child]), *further))
    if child is None:
        if any(given is not None for given in (rpy, rpy_deg, quaternion)) or any(xyz):
            raise UsageError("CHILD is missing; without it, transforms come from a file, and no option gives numbers")
        samples = _from_file(Path(parent), authority)
    else:
        samples = [_sample(parent, child, _transform(xyz, rpy, rpy_deg, quaternion), authority)]

    async def publish(bus: Bus) -> None:
        for sample in samples:
            what = f"{sample.child!r} in {sample.parent!r} on {link.place}"
            # In two lines, for one is wider than many terminals.
            say(f"publishing {what}, until Ctrl-C:")
            say(f"  {format_transform(sample.transform)}")
        stamp = bus.clock.now()
        await publish_static(bus, [sample.replace(stamp=stamp) for sample in samples])
        await anyio.sleep_forever()

    link.run(publish)


def _check_habits(words: Sequence[str]) -> None:
    """Raise an error with the right form, if the words are arguments of tf2's static_transform_publisher."""
    if len(words) <= 2:
        return
    count = next((at for at, word in enumerate(words) if not is_number(word)), len(words))
    frames = words[count : count + 2]
    if count not in (6, 7) or len(frames) < 2:
        raise UsageError(f"expected PARENT and CHILD, or a file, but there is {words[2]!r} as well")
    numbers = words[:count]
    # tf2 has yaw first.
    rotation = f"--quaternion {' '.join(numbers[3:])}" if count == 7 else f"--rpy {' '.join(numbers[:2:-1])}"
    raise UsageError(
        f"tf2's order of arguments is another one: type tfbus static {' '.join(frames)} "
        f"--xyz {' '.join(numbers[:3])} {rotation}"
    )


def _from_file(file: Path, authority: str) -> list[TransformStamped]:
    if file.suffix not in _FILES and not file.exists():
        raise UsageError(f"CHILD is missing: tfbus static {file} CHILD, or a file that ends in {' or '.join(_FILES)}")
    with usage_errors():
        samples = load_static(file, authority=authority)
    if not samples:
        raise UsageError(f"there is no transform in {file}")
    for sample in samples:
        _check(sample)
    return samples


def _transform(xyz: Vector, rpy: Vector | None, rpy_deg: Vector | None, quaternion: Quaternion | None) -> Transform:
    given = {"--rpy": rpy, "--rpy-deg": rpy_deg, "--quaternion": quaternion}
    names = [name for name, value in given.items() if value is not None]
    if len(names) > 1:
        raise UsageError(f"{' and '.join(names)} are ways to say the same: give one of them")
    with usage_errors():
        if quaternion is not None:
            return Transform(xyz, quaternion)
        angles: Sequence[float] = (0.0, 0.0, 0.0) if rpy is None else rpy
        if rpy_deg is not None:
            angles = [math.radians(angle) for angle in rpy_deg]
        elif any(math.inf > abs(angle) > 2 * math.pi for angle in angles):
            warn(f"--rpy {format_numbers(angles)} is in rad and more than a turn: are these degrees, for --rpy-deg?")
        return Transform.from_xyz_rpy(xyz, angles)


def _sample(parent: str, child: str, transform: Transform, authority: str) -> TransformStamped:
    with usage_errors():
        sample = TransformStamped(parent, child, 0, transform, authority, static=True)
    _check(sample)
    return sample


def _check(sample: TransformStamped) -> None:
    with usage_errors():
        check_translations((sample,), MAX_TRANSLATION)
    unsendable = refusal(sample)
    if unsendable is not None:
        raise UsageError(str(unsendable))
