"""The settings that all links to ROS share: topics, names of frames, and who takes joints, a description, the time.

`RosOptions` are the arguments of a link, as a user writes them; `settings_of` checks them and makes the `RosSettings`
that a carrier reads. `FrameNames` puts the prefix of a robot in front of its frames and moves stamps by an offset, and
undoes both.
"""

import os
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal, TypedDict

from tfbus.clock import SimulatedClock
from tfbus.errors import InvalidTransformError
from tfbus.frames import Prefix, as_prefix
from tfbus.geometry.stamped import TransformStamped, shifted
from tfbus.links.endpoint import HearsTime, check_options
from tfbus.stamps import as_offset
from tfbus.tf_message import refusal

_TOPIC = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")


def as_topics(topics: str | Iterable[str], name: str) -> tuple[str, ...]:
    """One topic or several, each with a slash in front.

    Raises
    ------
    ValueError
        If there is none, or one cannot be the name of a topic.
    TypeError
        If one is no string.
    """
    several = (topics,) if isinstance(topics, str) else tuple(topics)
    for topic in several:
        if not isinstance(topic, str):
            raise TypeError(f"a topic must be a str, not {topic!r}")
    found = tuple(dict.fromkeys(topic if topic.startswith("/") else f"/{topic}" for topic in several))
    for topic in found:
        if not _TOPIC.fullmatch(topic):
            raise ValueError(f"{topic!r} cannot be the name of a topic: words of letters, digits and _, with / between")
    if not found:
        raise ValueError(f"{name} must name a topic")
    return found


class FrameNames:
    """The names of frames on the bus for those in ROS, and the other way round.

    Parameters
    ----------
    prefix : str or None
        In front of each name on the bus, and of none in ROS.
    shared : iterable of str
        Names without it.
    offset : float
        How far stamps on the bus are ahead of those in ROS, in s.
    """

    def __init__(self, prefix: str | None = None, shared: Iterable[str] = (), offset: float = 0.0) -> None:
        self._prefix: Prefix | None = as_prefix(prefix, shared)
        self.offset: int = as_offset(offset)

    def put_on_bus(self, sample: TransformStamped) -> None:
        """Give a sample that nobody else has yet the names on the bus.

        Raises
        ------
        InvalidTransformError
            With the reason ``"prefix"``, for a name that has the prefix in ROS too: another link has brought it there.
        """
        if self.offset:
            sample._fields = shifted(sample, self.offset)._fields
        if self._prefix is None:
            return
        parent, child, stamp, row, authority, static = sample._fields
        for name in (parent, child):
            if name.startswith(self._prefix.prefix):
                raise InvalidTransformError(
                    f"frame name {name!r} has the prefix {self._prefix.prefix!r} in ROS already",
                    reason="prefix",
                    parent=parent,
                    child=child,
                    authority=authority,
                )
        sample._fields = self._prefix.on_bus(parent), self._prefix.on_bus(child), stamp, row, authority, static

    def is_local(self, child: str) -> bool:
        """Whether a child on the bus has a name in ROS; without the prefix it is another robot's."""
        return self._prefix is None or not self._prefix.local(child).startswith("/")

    def localise(self, sample: TransformStamped) -> TransformStamped:
        """A sample with its names in ROS.

        Raises
        ------
        InvalidTransformError
            With the reason ``"prefix"``, if the parent has no name there; or if the stamp fits no message.
        """
        if self.offset:
            sample = shifted(sample, -self.offset)
            if (error := refusal(sample)) is not None:
                raise error
        if self._prefix is None:
            return sample
        parent, child, stamp, row, authority, static = sample._fields
        local = self._prefix.local(parent)
        if local.startswith("/"):
            raise InvalidTransformError(
                f"frame {child!r} has the prefix {self._prefix.prefix!r}, its parent {parent!r} has not:"
                f" shared={{{parent!r}}} lets it pass",
                reason="prefix",
                parent=parent,
                child=child,
                authority=authority,
            )
        renamed = TransformStamped.__new__(TransformStamped)
        renamed._fields = local, self._prefix.local(child), stamp, row, authority, static
        return renamed


_LAST_DOMAIN = 232

Other = Literal["joints", "clock", "description", "odometry"]
"""The topics beside those of transforms: positions of joints, the time, the URDF of a robot, and odometry."""

JointStates = Callable[[Mapping[str, float], int], object]
"""Takes the positions of joints by their names, in rad or m, and the stamp in ns."""


TakesDescription = Callable[[str], object]
"""Takes the URDF of a robot."""


class RosOptions(TypedDict, total=False):
    """The arguments that all links to ROS share; `RosLink` describes them."""

    tf: str | Iterable[str]
    tf_static: str | Iterable[str]
    prefix: str | None
    shared: Iterable[str]
    frames: Iterable[str] | None
    send: bool
    authority: str | None
    joint_states: JointStates | None
    joint_topic: str
    robot_description: TakesDescription | None
    description_topic: str
    odometry: str | Iterable[str]
    invert: bool
    clock: SimulatedClock | HearsTime | None
    drop_lost: bool
    max_frames: int
    capacity: int
    offset: float


@dataclass(frozen=True, slots=True)
class RosSettings:
    """The settings that a carrier to ROS needs.

    Attributes
    ----------
    tf, tf_static : tuple of str
        The topics that are heard; the link publishes on the first.
    names : FrameNames
    send : bool
        Whether anything goes out.
    authority : str or None
        The authority of all samples that come in; None for the node that has published them, where it is known.
    joint_states : callable or None
        Takes the positions of joints that come in.
    robot_description : callable or None
        Takes the URDF of the robot.
    invert : bool
        Whether the child of odometry becomes the parent.
    others : dict of str to tuple of str
        The other topics that somebody takes, by what they have.
    """

    tf: tuple[str, ...] = ("/tf",)
    tf_static: tuple[str, ...] = ("/tf_static",)
    names: FrameNames = FrameNames()  # noqa: RUF009 - it never changes
    send: bool = True
    authority: str | None = None
    joint_states: JointStates | None = None
    robot_description: TakesDescription | None = None
    invert: bool = False
    others: dict[Other, tuple[str, ...]] = field(default_factory=dict)


def settings_of(options: RosOptions) -> RosSettings:
    """The settings that some options make.

    Raises
    ------
    ValueError, TypeError
        If an option is not valid.
    """
    check_options(options, RosOptions)
    authority = options.get("authority")
    if authority is not None and not isinstance(authority, str):
        raise TypeError(f"authority must be a str, not {authority!r}")
    joint_states = options.get("joint_states")
    if joint_states is not None and not callable(joint_states):
        raise TypeError(f"joint_states must be callable, such as the publish of a robot, not {joint_states!r}")
    description = options.get("robot_description")
    if description is not None and not callable(description):
        raise TypeError(f"robot_description must be callable, not {description!r}")
    others: dict[Other, tuple[str, ...]] = {}
    if joint_states is not None:
        others["joints"] = as_topics(options.get("joint_topic", "/joint_states"), "joint_topic")
    if options.get("clock") is not None:
        others["clock"] = ("/clock",)
    if description is not None:
        others["description"] = as_topics(options.get("description_topic", "/robot_description"), "description_topic")
    if "odometry" in options:
        others["odometry"] = as_topics(options["odometry"], "odometry")
    return RosSettings(
        as_topics(options.get("tf", "/tf"), "tf"),
        as_topics(options.get("tf_static", "/tf_static"), "tf_static"),
        FrameNames(options.get("prefix"), options.get("shared", ()), options.get("offset", 0.0)),
        bool(options.get("send", True)),
        authority,
        joint_states,
        description,
        bool(options.get("invert", False)),
        others,
    )


def as_domain(domain: int | None) -> int:
    """A domain of ROS 2, by default that of the variable ``ROS_DOMAIN_ID``, or else 0.

    Raises
    ------
    ValueError, TypeError
        If it is out of range, or no number.
    """
    if domain is None:
        text = os.environ.get("ROS_DOMAIN_ID") or "0"
        if not text.isdecimal():
            raise ValueError(f"the variable ROS_DOMAIN_ID must be a number, got {text!r}")
        domain = int(text)
    if isinstance(domain, bool) or not isinstance(domain, int):
        raise TypeError(f"a domain must be an int, not {domain!r}")
    if not 0 <= domain <= _LAST_DOMAIN:
        raise ValueError(f"a domain must be from 0 to {_LAST_DOMAIN}, got {domain}")
    return domain
