"""The settings that all links to ROS share."""

import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TypedDict

from tfbus.clock import SimulatedClock
from tfbus.links._clock_follower import HearsTime
from tfbus.links.ros._names import FrameNames, as_topics

_LAST_DOMAIN = 232


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
    clock: SimulatedClock | HearsTime | None
    drop_lost: bool
    max_frames: int
    capacity: int


@dataclass(frozen=True, slots=True)
class RosSettings:
    """The settings that a carrier to ROS needs.

    Attributes
    ----------
    tf, tf_static : tuple of str
        The topics that are heard; what goes out goes to the first.
    names : FrameNames
    send : bool
        Whether anything goes out.
    authority : str or None
        That of all samples that come in; None for the node that has published them, where it is known.
    joint_states : callable or None
        Takes the positions of joints that come in.
    joint_topic : tuple of str
        The topic of these, if somebody takes them.
    robot_description : callable or None
        Takes the URDF of the robot.
    description_topic : tuple of str
        The topic of that, if somebody takes it.
    clock_topic : tuple of str
        The topic of the time, if a clock follows it.
    """

    tf: tuple[str, ...] = ("/tf",)
    tf_static: tuple[str, ...] = ("/tf_static",)
    names: FrameNames = FrameNames()  # noqa: RUF009 - it never changes
    send: bool = True
    authority: str | None = None
    joint_states: JointStates | None = None
    joint_topic: tuple[str, ...] = ()
    clock_topic: tuple[str, ...] = ()
    robot_description: TakesDescription | None = None
    description_topic: tuple[str, ...] = ()


def settings_of(options: RosOptions) -> RosSettings:
    """The settings that some options make.

    Raises
    ------
    ValueError, TypeError
        If an option is not valid.
    """
    authority = options.get("authority")
    if authority is not None and not isinstance(authority, str):
        raise TypeError(f"authority must be a str, not {authority!r}")
    joint_states = options.get("joint_states")
    if joint_states is not None and not callable(joint_states):
        raise TypeError(f"joint_states must be callable, such as the publish of a robot, not {joint_states!r}")
    description = options.get("robot_description")
    if description is not None and not callable(description):
        raise TypeError(f"robot_description must be callable, not {description!r}")
    return RosSettings(
        as_topics(options.get("tf", "/tf"), "tf"),
        as_topics(options.get("tf_static", "/tf_static"), "tf_static"),
        FrameNames(options.get("prefix"), options.get("shared", ())),
        bool(options.get("send", True)),
        authority,
        joint_states,
        () if joint_states is None else as_topics(options.get("joint_topic", "/joint_states"), "joint_topic"),
        () if options.get("clock") is None else ("/clock",),
        description,
        ()
        if description is None
        else as_topics(options.get("description_topic", "/robot_description"), "description_topic"),
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
