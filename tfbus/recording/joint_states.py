"""`load_joint_states`, the tree of a robot from the positions of its joints, for recordings without transforms."""

import os
from collections import Counter
from pathlib import Path

from tfbus.errors import InvalidTransformError, RecordingError
from tfbus.recording.formats.storage import Channel
from tfbus.recording.formats.transforms import bounded
from tfbus.recording.recording import Problems, open_storage
from tfbus.robot.joint_state_message import decode_joint_state
from tfbus.robot.model import RobotModel
from tfbus.tf_message import MalformedMessageError
from tfbus.tree.tree import TransformTree

_TYPES = ("sensor_msgs/msg/JointState", "sensor_msgs/JointState")


def load_joint_states(
    path: str | os.PathLike[str],
    robot: RobotModel | str | os.PathLike[str],
    topic: str = "/joint_states",
    since: int | None = None,
    until: int | None = None,
    *,
    prefix: str = "",
    problems: Counter[str] | None = None,
) -> TransformTree:
    """Read the positions of joints from a recording, and give the transforms of all links, as a state publisher would.

    Parameters
    ----------
    path : str or path-like
        As `open_recording`.
    robot : RobotModel, str or path-like
        The robot, or its URDF as `RobotModel.from_urdf` takes it.
    topic : str
        A topic of ``sensor_msgs/JointState``.
    since, until : int, optional
        The first and the last log time, in ns.
    prefix : str
        A prefix for the names of all frames.
    problems : Counter, optional
        Gets the number of positions and messages that were left out: ``"unknown joint"``, the reasons of
        `InvalidTransformError`, and the reasons of damage.

    Returns
    -------
    TransformTree
        With ``keep=None``. Fixed joints are static.

    Raises
    ------
    RecordingError
        If the recording cannot be read, or nothing of that type is on the topic.
    InvalidRobotError, OSError, ImportError
        As `RobotModel.from_urdf`.

    Examples
    --------
    >>> from tfbus.recording import load_joint_states
    >>> model = RobotModel("rig", ["rail", "cart"], [Joint("slide", "prismatic", "rail", "cart")])
    >>> try:
    ...     tree = load_joint_states("small.bag", model, "/arm/joint_states")
    ... except RecordingError as error:
    ...     print(error.reason)
    no such topic
    """
    model = robot if isinstance(robot, RobotModel) else RobotModel.from_urdf(robot)
    counted = Problems()
    tree = TransformTree(keep=None)
    name = topic.removeprefix("/")
    read = 0
    storage = open_storage(Path(path))
    try:
        for _, channel, payload in storage.messages(lambda each: _is_wanted(each, name), since, until):
            if isinstance(channel, MalformedMessageError):
                counted.note((channel,))
                continue
            read += 1
            try:
                stamp, positions = decode_joint_state(bounded(payload), ros1=channel.encoding == "ros1")
            except MalformedMessageError as error:
                counted[error.reason] += 1
                continue
            unknown = len(model.unknown_joints(positions))
            if unknown:
                counted["unknown joint"] += unknown
            try:
                tree.insert_many(model.moving_transforms(positions, stamp, prefix=prefix))
            except InvalidTransformError as error:
                counted[error.reason] += 1
        there = sorted({channel.topic for channel in storage.channels if channel.type in _TYPES})
    finally:
        storage.close()
    if not read:
        problem = f"no positions of joints are on topic {topic!r}; topics with them: {', '.join(there) or 'none'}"
        raise RecordingError(problem, path=os.fspath(path), reason="no such topic")
    tree.insert_many(model.fixed_transforms(0, prefix=prefix))
    if problems is not None:
        problems.update(counted)
    return tree


def _is_wanted(channel: Channel, name: str) -> bool:
    return channel.topic.removeprefix("/") == name and channel.type in _TYPES and channel.encoding in ("cdr", "ros1")
