"""``tfbus robot``."""

import difflib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from tfbus.bus.bus import Bus
from tfbus.cli.domain import LOCAL, LinkOptions, UnusableError, say
from tfbus.cli.options import Rate
from tfbus.cli.printable import printable
from tfbus.errors import InvalidRobotError, InvalidTransformError
from tfbus.geometry.transform import Transform
from tfbus.robot.joint import Joint, Position
from tfbus.robot.model import RobotModel
from tfbus.tree.history import Edge
from tfbus.tree.rendering import Branch, branches

AUTHORITY = "robot"


def robot(
    file: Path,
    /,
    *position: str,
    tree: Annotated[bool, Parameter(negative="")] = False,
    rate: Rate = 10.0,
    prefix: str = "",
    link: LinkOptions = LOCAL,
) -> None:
    """Publish a robot, its joints at zero or where they are told to be, until Ctrl-C; or print its frames.

    Fixed joints are published once, the others again and again. What is beyond a limit is told, and published as it is.

    Example: tfbus robot arm.urdf shoulder=0.5 elbow=-1.2 --tree

    Parameters
    ----------
    file
        A URDF.
    position
        As NAME=NUMBER, the position of a joint in rad or m. Of a planar joint it is x,y,angle, of a floating one
        x,y,z,qx,qy,qz,qw.
    tree
        Print the tree of frames with joints and positions, and end.
    rate
        How often moving joints are published, in Hz.
    prefix
        Put before the names of all frames, such as robot1/.
    """
    model = _model(file)
    positions = {**model.zeros(), **dict(_positions(model, position))}
    try:
        count = len(model.transforms(positions, 0, AUTHORITY, prefix))
        violations = model.violations(positions)
    except InvalidTransformError as error:
        raise UnusableError(str(error)) from None
    for violation in violations:
        say(f"tfbus: {violation}")
    if tree:
        print("\n".join(picture(model, positions, prefix)))
        return

    async def publish(bus: Bus) -> None:
        say(f"publishing {count} frames of {model.name!r} on domain {link.domain!r} at {rate:g} Hz, until Ctrl-C")
        bus.publish(model.fixed_transforms(bus.clock.now(), AUTHORITY, prefix))
        async for _ in bus.clock.ticks(rate):
            bus.publish(model.moving_transforms(positions, bus.clock.now(), AUTHORITY, prefix))

    link.run(publish)


def picture(model: RobotModel, positions: Mapping[str, Position], prefix: str = "") -> Iterator[str]:
    """The frames of a robot as an indented tree, a line each, with joint, type and position."""
    above = {joint.child: joint for joint in model.joints}
    resolved = {joint.name: position for joint, position in model.resolve(positions)}
    edges = [Edge(joint.parent, joint.child, joint.kind == "fixed", 0, None, None, "") for joint in model.joints]
    rows = []
    for guides, frame, edge in branches(edges) if edges else [Branch("", model.root, None)]:
        row = [guides + printable(prefix + frame), "", "", ""]
        if edge is not None:
            joint = above[frame]
            row[1:3] = printable(joint.name), joint.kind
            if joint.name in resolved:
                row[3] = _shown(joint, resolved[joint.name])
                if joint.mimic is not None and joint.name not in positions:
                    row[3] += f", mimics {printable(joint.mimic.joint)}"
        rows.append(row)
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        yield "  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)).rstrip()


def _shown(joint: Joint, position: Position) -> str:
    if isinstance(position, Transform):
        return f"xyz {_plain(position.translation)} m, rpy {_plain(position.as_rpy())} rad"
    if isinstance(position, Sequence):
        return f"xy {_plain(position[:2])} m, angle {_plain(position[2:])} rad"
    return f"{_plain([position])} {'m' if joint.kind == 'prismatic' else 'rad'}"


def _plain(numbers: Iterable[float]) -> str:
    # Zero is added because there is a -0.
    return " ".join(f"{number + 0.0:g}" for number in numbers)


def _model(file: Path) -> RobotModel:
    try:
        return RobotModel.from_urdf(file)
    except OSError as error:
        raise UnusableError(f"cannot read {file}: {error.strerror}") from None
    except InvalidRobotError as error:
        raise UnusableError(f"{file}: {error}") from None
    except ImportError as error:
        raise UnusableError(str(error)) from None


def _positions(model: RobotModel, pairs: Sequence[str]) -> Iterator[tuple[str, Position]]:
    """What the pairs on the command line say."""
    joints = {joint.name: joint for joint in model.joints}
    seen = set()
    for pair in pairs:
        name, equals, text = pair.rpartition("=")
        if not equals:
            raise UnusableError(f"a position is NAME=NUMBER, such as elbow=0.5, not {pair!r}")
        if name not in joints:
            moving = [joint.name for joint in model.joints if joint.kind != "fixed"]
            hint = " or ".join(map(repr, difflib.get_close_matches(name, moving)))
            raise UnusableError(f"{model.name!r} has no joint {name!r}" + (f", did you mean {hint}?" if hint else ""))
        if joints[name].kind == "fixed":
            raise UnusableError(f"joint {name!r} is fixed and has no position")
        if name in seen:
            raise UnusableError(f"joint {name!r} has two positions")
        seen.add(name)
        yield name, _position(joints[name], text)


def _position(joint: Joint, text: str) -> Position:
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        raise UnusableError(f"joint {joint.name!r}: position {text!r} is not a number") from None
    if joint.kind == "planar":
        return numbers
    if joint.kind == "floating":
        try:
            return Transform(numbers[:3], numbers[3:])
        except InvalidTransformError as error:
            raise UnusableError(f"joint {joint.name!r}: {error}") from None
    if len(numbers) > 1:
        raise UnusableError(f"joint {joint.name!r}: position {text!r} is not one number")
    return numbers[0]
