"""``tfbus robot``."""

import difflib
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AsyncExitStack
from functools import partial
from pathlib import Path

from tfbus.cli.arguments import Flag, Rate, UsageError, usage_errors
from tfbus.cli.domain import DEFAULT_LINK, LinkOptions, publish_static
from tfbus.cli.lazy_imports import lazy_imports
from tfbus.cli.output import (
    Column,
    cells,
    format_numbers,
    format_transform,
    narrow_guides,
    say,
    shorten,
    table_lines,
    terminal_width,
    warn,
)

with lazy_imports():
    import anyio

    from tfbus.bus.bus import Bus
    from tfbus.errors import InvalidRobotError, InvalidTransformError
    from tfbus.geometry.stamped import MAX_TRANSLATION, check_translations
    from tfbus.geometry.transform import Transform
    from tfbus.plain import printable
    from tfbus.robot.model import Joint, Position, RobotModel
    from tfbus.robot.state_publisher import RobotStatePublisher
    from tfbus.tree.history import Edge
    from tfbus.tree.rendering import Branch, branches

AUTHORITY = "robot"
_ALIKE = 0.7
"""The least ratio of equal letters in a misspelt name and a suggested one."""
_LEAST_POSITION = 16
"""The least width, in columns, to which a position is shortened to make room for the frames."""
_COLUMNS = (Column("frame"), Column("joint", importance=2), Column("type", importance=1), Column("position"))


def robot(
    file: Path | None = None,
    /,
    *position: str,
    tree: Flag = False,
    follow: Flag = False,
    rate: Rate = 10.0,
    prefix: str = "",
    link: LinkOptions = DEFAULT_LINK,
) -> None:
    """Publish the frames of a robot until Ctrl-C, or print them as a tree.

    Joints without a position are at zero; with --follow, they are not published until ROS tells their positions. Fixed
    joints are published once, the others again and again. If a frame is refused, because it conflicts with an
    edge of another program, it is tried again. A position beyond the limits of its joint is reported, but published.

    Example: tfbus robot arm.urdf shoulder=0.5 elbow=-1.2 --tree

    Parameters
    ----------
    file
        A URDF. Without one, --follow takes the URDF from /robot_description of ROS.
    position
        As NAME=NUMBER, the position of a joint in rad or m; for a planar joint x,y,angle, for a floating one
        x,y,z,qx,qy,qz,qw.
    tree
        Print the tree of frames with joints and positions, and exit.
    follow
        Take the positions from /joint_states of ROS, with --ros, as they come.
    rate
        How often moving joints are published, in Hz.
    prefix
        A prefix for the names of all frames, such as robot1/.
    """
    if file is None and not (follow and link.ros):
        raise UsageError("give a URDF, or take the URDF of ROS with --follow and --ros")
    if file is not None and "=" in file.name and not file.exists():
        raise UsageError(f"the URDF comes first: tfbus robot FILE {file}")
    if follow and not link.ros:
        raise UsageError("--follow takes positions from ROS: give --ros, such as --ros dds")
    if follow and position:
        raise UsageError("--follow takes positions from ROS: give none")
    if file is None:
        if tree:
            raise UsageError("--tree prints the frames of a URDF: give one")
        link.run(partial(_follow, link=link, model=None, prefix=prefix))
        return
    model = _read_model(file)
    positions = {**model.zeros(), **_parse_positions(model, position)}
    with usage_errors():
        transforms = model.transforms(positions, 0, AUTHORITY, prefix)
        check_translations(tuple(transforms), MAX_TRANSLATION)
        violations = model.violations(positions)
    for violation in violations:
        warn(str(violation))
    if tree:
        print("\n".join(tree_lines(model, positions, prefix, terminal_width())))
        return

    async def publish(bus: Bus) -> None:
        where = f"on {link.place} at {rate:g} Hz"
        say(f"publishing {len(transforms)} frames of {model.name!r} {where}, until Ctrl-C")
        async with anyio.create_task_group() as tasks:
            await tasks.start(publish_static, bus, model.fixed_transforms(bus.clock.now(), AUTHORITY, prefix))
            async for _ in bus.clock.ticks(rate):
                bus.publish(model.moving_transforms(positions, bus.clock.now(), AUTHORITY, prefix), invalid="drop")

    link.run(partial(_follow, link=link, model=model, prefix=prefix) if follow else publish)


async def _follow(bus: Bus, link: LinkOptions, model: RobotModel | None, prefix: str) -> None:
    """Publish a robot as ROS moves it, and as ROS describes it if no model is given."""
    if model is None:
        model = await _model_of_ros(bus, link)
    publisher = RobotStatePublisher(bus, model, prefix, AUTHORITY, invalid="drop")
    say(f"publishing the frames of {model.name!r} as /joint_states of {link.place} says, until Ctrl-C")
    async with AsyncExitStack() as stack:
        for place in link.ros:
            # This link carries the positions only; other links carry the frames.
            positions_only = link.ros_link(bus, place, send=False, frames=(), joint_states=publisher.publish)
            await stack.enter_async_context(positions_only)
        await anyio.sleep_forever()


async def _model_of_ros(bus: Bus, link: LinkOptions) -> RobotModel:
    """Wait for the URDF on /robot_description; raises `UsageError` if it is not a robot."""
    described = anyio.Event()
    texts: list[str] = []

    def take(text: str) -> None:
        texts.append(text)
        described.set()

    say(f"waiting for /robot_description of {link.place}")
    async with AsyncExitStack() as stack:
        for place in link.ros:
            description_only = link.ros_link(bus, place, send=False, frames=(), robot_description=take)
            await stack.enter_async_context(description_only)
        await described.wait()
    # A text without a tag would be taken for a path.
    if "<" not in texts[0]:
        raise UsageError("/robot_description holds no URDF")
    try:
        return RobotModel.from_urdf(texts[0])
    except InvalidRobotError as error:
        raise UsageError(f"/robot_description: {error}") from None
    except ImportError as error:
        raise UsageError(str(error)) from None


def tree_lines(
    model: RobotModel, positions: Mapping[str, Position], prefix: str = "", width: int | None = None
) -> Iterator[str]:
    """The tree of frames, one a line, with the name, the type and the position of the joint above each.

    Where they do not fit the width, types are left out first, then the names of joints.
    """
    joint_above = {joint.child: joint for joint in model.joints}
    resolved = {joint.name: position for joint, position in model.resolve(positions)}
    edges = [Edge(joint.parent, joint.child, joint.kind == "fixed", 0, None, None, "") for joint in model.joints]
    rows = []
    for guides, frame, edge in branches(edges) if edges else [Branch("", model.root, None)]:
        name = kind = position = ""
        if edge is not None:
            joint = joint_above[frame]
            name, kind = joint.name, joint.kind
            if joint.name in resolved:
                position = _format_position(joint, resolved[joint.name])
                if joint.mimic is not None and joint.name not in positions:
                    position += f", mimics {joint.mimic.joint}"
        rows.append((guides, printable(prefix + frame), name, kind, position))
    step, room = _layout(rows, width)
    return table_lines(
        _COLUMNS,
        [(narrow_guides(row[0], step) + row[1], *row[2:4], shorten(row[4], room)) for row in rows],
        width,
        titles=False,
    )


def _layout(rows: Sequence[tuple[str, str, str, str, str]], width: int | None) -> tuple[int, int]:
    """The widths of a level and of the positions; if the frames do not fit, the positions are shortened first."""
    positions = max(cells(row[4]) for row in rows)
    least = min(_LEAST_POSITION, positions)
    for step in (4, 2, 1):
        room = (
            positions if width is None else width - 2 - max(cells(narrow_guides(row[0], step) + row[1]) for row in rows)
        )
        if room >= least:
            break
    return step, max(room, least)


def _format_position(joint: Joint, position: Position) -> str:
    if isinstance(position, Transform):
        return format_transform(position)
    if isinstance(position, Sequence):
        return f"xy {format_numbers(position[:2])} m, angle {format_numbers(position[2:])} rad"
    return f"{format_numbers([position])} {'m' if joint.kind == 'prismatic' else 'rad'}"


def _read_model(file: Path) -> RobotModel:
    try:
        return RobotModel.from_urdf(file)
    except OSError as error:
        raise UsageError(f"cannot read {file}: {error.strerror}") from None
    except InvalidRobotError as error:
        raise UsageError(f"{file}: {error}") from None
    except ImportError as error:
        raise UsageError(str(error)) from None


def _parse_positions(model: RobotModel, assignments: Sequence[str]) -> dict[str, Position]:
    """The positions by joint from assignments such as ``elbow=0.5``."""
    joints = {joint.name: joint for joint in model.joints}
    positions: dict[str, Position] = {}
    for assignment in assignments:
        name, equals, text = assignment.rpartition("=")
        if not equals:
            raise UsageError(f"a position is NAME=NUMBER, such as elbow=0.5, not {assignment!r}")
        if name not in joints:
            moving = [joint.name for joint in model.joints if joint.kind != "fixed"]
            hint = " or ".join(map(repr, _similar(name, moving)))
            raise UsageError(f"{model.name!r} has no joint {name!r}" + (f", did you mean {hint}?" if hint else ""))
        if joints[name].kind == "fixed":
            raise UsageError(f"joint {name!r} is fixed and has no position")
        if name in positions:
            raise UsageError(f"joint {name!r} has two positions")
        positions[name] = _parse_position(joints[name], text)
    return positions


def _similar(name: str, names: Sequence[str]) -> list[str]:
    """At most three names that are like a misspelt one, as a whole or in one of their words."""

    def likeness(known: str) -> float:
        parts = [known, *re.split(r"[_\-/ ]+", known)]
        return max(difflib.SequenceMatcher(None, name.lower(), part.lower()).ratio() for part in parts)

    return sorted((known for known in names if likeness(known) >= _ALIKE), key=likeness, reverse=True)[:3]


def _parse_position(joint: Joint, text: str) -> Position:
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        raise UsageError(f"joint {joint.name!r}: position {text!r} is not a number") from None
    if joint.kind == "planar":
        return numbers
    if joint.kind == "floating":
        try:
            return Transform(numbers[:3], numbers[3:])
        except InvalidTransformError as error:
            raise UsageError(f"joint {joint.name!r}: {error}") from None
    if len(numbers) > 1:
        raise UsageError(f"joint {joint.name!r}: position {text!r} is not one number")
    return numbers[0]
