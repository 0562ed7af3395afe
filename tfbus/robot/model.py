"""`RobotModel`, a robot as a tree of links and joints."""

import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from tfbus.errors import InvalidRobotError
from tfbus.frames import is_frame
from tfbus.geometry.stamped import TransformStamped
from tfbus.geometry.transform import from_row
from tfbus.robot._urdf import read_urdf
from tfbus.robot.joint import Joint, Position, element
from tfbus.stamps import StampLike


@dataclass(frozen=True, slots=True)
class LimitViolation:
    """A joint whose position is outside of its limits; in rad or m."""

    joint: str
    position: float
    lower: float | None
    upper: float | None

    def __str__(self) -> str:
        lower = "" if self.lower is None else f" from {self.lower:g}"
        upper = "" if self.upper is None else f" to {self.upper:g}"
        return f"joint {self.joint!r}: position {self.position:g} is outside its limits,{lower}{upper}"


@dataclass(frozen=True, slots=True)
class RobotModel:
    """A tree of links and joints: plain data, from a URDF or built by hand.

    Parameters
    ----------
    name : str
    links : sequence of str
        The names of the links, which are also those of their frames.
    joints : sequence of Joint

    Attributes
    ----------
    root : str
        The link without a parent.

    Raises
    ------
    InvalidRobotError
        If a name occurs twice or is no frame name, a joint has an unknown link, a link has two parents, the links form
        a loop or have several roots, or a joint mimics an unknown joint, itself over others, or a joint whose position
        is not one number. The message names the element.

    Examples
    --------
    >>> elbow = Joint("elbow", "revolute", "upper_arm", "forearm", Transform((0.4, 0.0, 0.0)), axis=(0, 0, 1))
    >>> arm = RobotModel("arm", ["upper_arm", "forearm"], [elbow])
    >>> [sample] = arm.transforms({"elbow": 0.0}, stamp=0)
    >>> sample
    TransformStamped('upper_arm', 'forearm', 0, Transform(translation=(0.4, 0.0, 0.0), rotation=(0.0, 0.0, 0.0, 1.0)))
    """

    name: str
    links: Sequence[str]
    joints: Sequence[Joint]
    root: str = field(init=False)
    _fixed: tuple[Joint, ...] = field(init=False, compare=False)
    _resolved: tuple[tuple[Joint, Joint | None], ...] = field(init=False, compare=False)
    _names: frozenset[str] = field(init=False, compare=False)

    def __post_init__(self) -> None:
        def set_field(name: str, value: object) -> None:
            object.__setattr__(self, name, value)

        set_field("links", tuple(self.links))
        set_field("joints", tuple(self.joints))
        _check_links(self)
        set_field("root", _root(self))
        ordered = _leaders_first(self.joints)
        named = {joint.name: joint for joint in ordered}
        leaders = {joint.mimic.joint for joint in ordered if joint.mimic is not None}
        set_field("_fixed", tuple(joint for joint in self.joints if joint.kind == "fixed"))
        set_field(
            "_resolved",
            tuple(
                (joint, named[joint.mimic.joint] if joint.mimic else None)
                for joint in ordered
                if joint.kind != "fixed" or joint.name in leaders
            ),
        )
        set_field("_names", frozenset(named))

    def __repr__(self) -> str:
        moving = sum(joint.kind != "fixed" for joint in self.joints)
        return f"<RobotModel {self.name!r}: {len(self.links)} links below {self.root!r}, {moving} moving joints>"

    @classmethod
    def from_urdf(cls, source: str | os.PathLike[str]) -> "RobotModel":
        """Read a URDF file, or its text.

        Elements other than links, joints and materials are ignored, such as ``<transmission>`` and ``<gazebo>``. Needs
        ``pip install "tfbus[urdf]"``.

        Parameters
        ----------
        source : str or path
            The text itself if it is a string with a ``<`` in it, otherwise the path of the file.

        Raises
        ------
        InvalidRobotError
            If the source is not XML, not URDF or not yet expanded by xacro, an element is malformed, or the elements
            do not form a robot. The message names the element.
        OSError
            If the file cannot be read.
        ImportError
            If urdf-parser-py is not installed.
        """
        name, links, joints = read_urdf(source)
        return cls(name, links, joints)

    def transforms(
        self, positions: Mapping[str, Position], stamp: StampLike, authority: str = "", prefix: str = ""
    ) -> list[TransformStamped]:
        """The transforms of all links, each in its parent.

        Parameters
        ----------
        positions : mapping of str to float, sequence of floats, or Transform
            By name of joint, as `Joint.transform` takes them. A moving joint without a position is left out, unless it
            mimics a joint that has one. Positions of fixed and of unknown joints are ignored: see `unknown_joints`.
        stamp : int
            ns.
        authority : str
            The sender.
        prefix : str
            Put before the names of all frames, such as ``"robot1/"``.

        Returns
        -------
        list of TransformStamped
            First the static ones of the fixed joints, then those of the moving joints.

        Raises
        ------
        InvalidTransformError
            If a position is not finite, has a wrong length or holds no unit quaternion, or the prefix or the stamp is
            invalid. The message has the name of the joint.
        TypeError
            If a position has a type that its joint does not accept.
        """
        return [
            *self.fixed_transforms(stamp, authority, prefix),
            *self.moving_transforms(positions, stamp, authority, prefix),
        ]

    def fixed_transforms(self, stamp: StampLike, authority: str = "", prefix: str = "") -> list[TransformStamped]:
        """The static ones of `transforms`."""
        return [
            TransformStamped(prefix + joint.parent, prefix + joint.child, stamp, joint.origin, authority, static=True)
            for joint in self._fixed
        ]

    def moving_transforms(
        self, positions: Mapping[str, Position], stamp: StampLike, authority: str = "", prefix: str = ""
    ) -> list[TransformStamped]:
        """The moving ones of `transforms`."""
        return [
            TransformStamped(
                prefix + joint.parent, prefix + joint.child, stamp, from_row(joint.row(position)), authority
            )
            for joint, position in self.resolve(positions)
        ]

    def resolve(self, positions: Mapping[str, Position]) -> list[tuple[Joint, Position]]:
        """Pair each moving joint that has a position, or mimics a joint that has one, with its position.

        Raises
        ------
        InvalidTransformError, TypeError
            If the position of a mimicked joint is not one finite number.
        """
        found: dict[str, Position] = {}
        moving = []
        for joint, leader in self._resolved:
            name, mimic = joint.name, joint.mimic
            if name in positions:
                position = positions[name]
            elif leader is not None and mimic is not None and leader.name in found:
                position = mimic.multiplier * leader.number(found[leader.name]) + mimic.offset
            else:
                continue
            found[name] = position
            if joint.kind != "fixed":
                moving.append((joint, position))
        return moving

    def violations(self, positions: Mapping[str, Position]) -> list[LimitViolation]:
        """The joints whose positions are outside of their limits, including those that mimic another.

        Raises
        ------
        InvalidTransformError, TypeError
            As `transforms`.
        """
        found = []
        for joint, position in self.resolve(positions):
            lower, upper = joint.lower, joint.upper
            if lower is None and upper is None:
                continue
            number = joint.number(position)
            if (lower is not None and number < lower) or (upper is not None and number > upper):
                found.append(LimitViolation(joint.name, number, lower, upper))
        return found

    def unknown_joints(self, names: Iterable[str]) -> list[str]:
        """The given names that no joint has."""
        return [name for name in names if name not in self._names]

    def zeros(self) -> dict[str, Position]:
        """The zero position of every moving joint, without those that mimic another."""
        return {joint.name: joint.zero for joint in self.joints if joint.kind != "fixed" and joint.mimic is None}


def _check_links(model: RobotModel) -> None:
    """Raise `InvalidRobotError` for a name that occurs twice, or is no frame name."""
    robot = element("robot", model.name)
    if not model.links:
        raise InvalidRobotError("it has no links", element=robot)
    for link in model.links:
        if not is_frame(link):
            raise InvalidRobotError("a frame name must not be empty or start with '/'", element=element("link", link))
    for tag, names in (("link", model.links), ("joint", [joint.name for joint in model.joints])):
        for name, count in Counter(names).items():
            if count > 1:
                raise InvalidRobotError(f"there are {count} of this name", element=element(tag, name))


def _root(model: RobotModel) -> str:
    """The link without a parent; raises `InvalidRobotError` unless the links form one tree."""
    above: dict[str, Joint] = {}
    known = set(model.links)
    for joint in model.joints:
        for end, link in (("parent", joint.parent), ("child", joint.child)):
            if link not in known:
                raise InvalidRobotError(f"{end} link {link!r} is not there", element=joint.element)
        if joint.child in above:
            first = above[joint.child]
            raise InvalidRobotError(
                f"link {joint.child!r} has two parents: {first.parent!r} by joint {first.name!r}, and {joint.parent!r}",
                element=joint.element,
            )
        above[joint.child] = joint
    in_tree: set[str] = set()
    for link in model.links:
        climbed: dict[str, Joint] = {}
        while link in above and link not in in_tree:
            if link in climbed:
                names = list(climbed)
                loop = [*names[names.index(link) :], link]
                text = " -> ".join(map(repr, loop))
                raise InvalidRobotError(f"the links {text} form a loop", element=above[link].element)
            climbed[link] = above[link]
            link = above[link].parent
        in_tree.update(climbed)
    roots = [link for link in model.links if link not in above]
    if len(roots) > 1:
        raise InvalidRobotError(
            f"it has several roots: {', '.join(map(repr, roots))}", element=element("robot", model.name)
        )
    return roots[0]


def _leaders_first(joints: Sequence[Joint]) -> list[Joint]:
    """Order the joints so that each comes after the one that it mimics; raises `InvalidRobotError` if that fails."""
    named = {joint.name: joint for joint in joints}
    ordered: dict[str, Joint] = {}
    for joint in joints:
        chain: dict[str, Joint] = {}
        while joint.name not in ordered:
            if joint.name in chain:
                names = list(chain)
                text = " -> ".join(map(repr, [*names[names.index(joint.name) :], joint.name]))
                raise InvalidRobotError(f"the joints {text} mimic each other", element=joint.element)
            chain[joint.name] = joint
            if joint.mimic is None:
                break
            leader = named.get(joint.mimic.joint)
            if leader is None:
                raise InvalidRobotError(f"it mimics {joint.mimic.joint!r}, which is not there", element=joint.element)
            for each in (joint, leader):
                if each.kind in ("planar", "floating"):
                    raise InvalidRobotError(
                        f"it mimics {leader.name!r}, but {each.name!r} is {each.kind}: only one number can be mimicked",
                        element=joint.element,
                    )
            joint = leader
        ordered.update(reversed(chain.items()))
    return list(ordered.values())
