"""A robot as a tree of links and joints, and the transforms that the positions of its joints give."""

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


@dataclass(frozen=True, slots=True)
class LimitViolation:
    """A joint that is where it is not meant to be; rad or m."""

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
    """Links joined by joints to one tree: plain data, from a URDF or made by hand.

    Parameters
    ----------
    name : str
    links : sequence of str
        The names of the links, which are those of their frames.
    joints : sequence of Joint

    Attributes
    ----------
    root : str
        The link that has no parent.

    Raises
    ------
    InvalidRobotError
        If a name is there twice or cannot be that of a frame, a joint has a link that is not there, a link two parents,
        the links form a loop or have several roots, or a joint mimics one that is not there, itself over others, or one
        that has not one number for a position. The message names the element.

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
    _fixed: tuple[Joint, ...] = field(init=False, repr=False, compare=False)
    _resolved: tuple[tuple[Joint, Joint | None], ...] = field(init=False, repr=False, compare=False)
    _names: frozenset[str] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        def put(name: str, value: object) -> None:
            object.__setattr__(self, name, value)

        put("links", tuple(self.links))
        put("joints", tuple(self.joints))
        _check_links(self)
        put("root", _root(self))
        ordered = _leaders_first(self.joints)
        named = {joint.name: joint for joint in ordered}
        leaders = {joint.mimic.joint for joint in ordered if joint.mimic is not None}
        put("_fixed", tuple(joint for joint in self.joints if joint.kind == "fixed"))
        put(
            "_resolved",
            tuple(
                (joint, named[joint.mimic.joint] if joint.mimic else None)
                for joint in ordered
                if joint.kind != "fixed" or joint.name in leaders
            ),
        )
        put("_names", frozenset(named))

    @classmethod
    def from_urdf(cls, source: str | os.PathLike[str]) -> "RobotModel":
        """From a URDF file, or its text.

        Elements that have nothing to do with links, joints and materials are passed over, such as ``<transmission>``
        and ``<gazebo>``. Needs ``pip install "tfbus[urdf]"``.

        Parameters
        ----------
        source : str or path
            The text itself, if it is a string with a ``<`` in it; else where the file is.

        Raises
        ------
        InvalidRobotError
            If it is not XML, not URDF or not expanded yet by xacro, an element is malformed, or the elements do not
            make a robot. The message names the element.
        OSError
            If the file cannot be read.
        ImportError
            If urdf-parser-py is not installed.
        """
        name, links, joints = read_urdf(source)
        return cls(name, links, joints)

    def transforms(
        self, positions: Mapping[str, Position], stamp: int, authority: str = "", prefix: str = ""
    ) -> list[TransformStamped]:
        """Where each link is, seen from its parent.

        Parameters
        ----------
        positions : mapping of str to float, sequence of floats, or Transform
            By name of joint, as `Joint.transform` takes them. A moving joint without one is left out, unless it mimics
            one that has one. Positions of fixed joints, and of names that are not there, count for nothing: see
            `unknown_joints`.
        stamp : int
            ns.
        authority : str
            Who says so.
        prefix : str
            Put before the names of all frames, such as ``"robot1/"``.

        Returns
        -------
        list of TransformStamped
            First those of the fixed joints, which are static, then those of the moving ones.

        Raises
        ------
        InvalidTransformError
            If a position is not finite, has a wrong length or holds no unit quaternion, or the prefix or the stamp is
            bad. The message has the name of the joint.
        TypeError
            If a position is of a type that its joint has no use for.
        """
        return [
            *self.fixed_transforms(stamp, authority, prefix),
            *self.moving_transforms(positions, stamp, authority, prefix),
        ]

    def fixed_transforms(self, stamp: int, authority: str = "", prefix: str = "") -> list[TransformStamped]:
        """Those of `transforms` that are static."""
        return [
            TransformStamped(prefix + joint.parent, prefix + joint.child, stamp, joint.origin, authority, static=True)
            for joint in self._fixed
        ]

    def moving_transforms(
        self, positions: Mapping[str, Position], stamp: int, authority: str = "", prefix: str = ""
    ) -> list[TransformStamped]:
        """Those of `transforms` that are not static."""
        return [
            TransformStamped(
                prefix + joint.parent, prefix + joint.child, stamp, from_row(joint.row(position)), authority
            )
            for joint, position in self.resolve(positions)
        ]

    def resolve(self, positions: Mapping[str, Position]) -> list[tuple[Joint, Position]]:
        """The moving joints that `positions` move, each with its position: its own, or the one that mimicking gives.

        Raises
        ------
        InvalidTransformError, TypeError
            If a position that another joint mimics is not one finite number.
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
        """The joints that `positions` take beyond their limits, mimicking ones included.

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
        """Those of some names that no joint has."""
        return [name for name in names if name not in self._names]

    def zeros(self) -> dict[str, Position]:
        """Positions that put every moving joint at its origin; without those that mimic another."""
        return {joint.name: joint.zero for joint in self.joints if joint.kind != "fixed" and joint.mimic is None}


def _check_links(model: RobotModel) -> None:
    """Raise `InvalidRobotError` for a name that is there twice, or cannot be that of a frame."""
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
    """The link without a parent; `InvalidRobotError` unless all links hang on one."""
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
    good: set[str] = set()
    for link in model.links:
        climbed: dict[str, Joint] = {}
        while link in above and link not in good:
            if link in climbed:
                names = list(climbed)
                loop = [*names[names.index(link) :], link]
                text = " -> ".join(map(repr, loop))
                raise InvalidRobotError(f"the links {text} form a loop", element=above[link].element)
            climbed[link] = above[link]
            link = above[link].parent
        good.update(climbed)
    roots = [link for link in model.links if link not in above]
    if len(roots) > 1:
        raise InvalidRobotError(
            f"it has several roots: {', '.join(map(repr, roots))}", element=element("robot", model.name)
        )
    return roots[0]


def _leaders_first(joints: Sequence[Joint]) -> list[Joint]:
    """The joints, each behind the one that it mimics; `InvalidRobotError` where that cannot be."""
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
            for one in (joint, leader):
                if one.kind in ("planar", "floating"):
                    raise InvalidRobotError(
                        f"it mimics {leader.name!r}, but {one.name!r} is {one.kind}: only one number can be mimicked",
                        element=joint.element,
                    )
            joint = leader
        ordered.update(reversed(chain.items()))
    return list(ordered.values())
