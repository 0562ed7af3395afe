"""A real robot, a PR2: its URDF, its recorded joints, and what the real robot_state_publisher made of them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import pytest
from rosbags.highlevel import AnyReader
from support.recorded import REAL

from tfbus import SECOND, Transform

URDF = REAL / "pr2.urdf"
BAG = REAL / "pr2_tf.bag"

needed = pytest.mark.skipif(
    not (URDF.is_file() and BAG.is_file()),
    reason="no pr2.urdf and pr2_tf.bag: set RECORDINGS to a folder that has them",
)


@dataclass(frozen=True)
class JointState:
    stamp: int
    names: Sequence[str]
    positions: Any


@dataclass(frozen=True)
class Recorded:
    """Of the transforms, each stamp's by parent and child."""

    states: list[JointState] = field(default_factory=list)
    moving: dict[int, dict[tuple[str, str], Transform]] = field(default_factory=dict)
    static: dict[tuple[str, str], Transform] = field(default_factory=dict)


@cache
def recorded() -> Recorded:
    """All that is in the bag."""
    found = Recorded()
    with AnyReader([BAG]) as reader:
        for connection, _, raw in reader.messages():
            message: Any = reader.deserialize(raw, connection.msgtype)
            if connection.topic == "/joint_states":
                found.states.append(JointState(_stamp(message.header), message.name, message.position))
                continue
            for stamp, edge, transform in _transforms(message):
                latched = connection.topic == "/tf_static"
                (found.static if latched else found.moving.setdefault(stamp, {}))[edge] = transform
    return found


def _transforms(message: Any) -> Iterator[tuple[int, tuple[str, str], Transform]]:
    for sent in message.transforms:
        place, turn = sent.transform.translation, sent.transform.rotation
        transform = Transform((place.x, place.y, place.z), (turn.x, turn.y, turn.z, turn.w))
        yield _stamp(sent.header), (sent.header.frame_id, sent.child_frame_id), transform


def _stamp(header: Any) -> int:
    return int(header.stamp.sec) * SECOND + int(header.stamp.nanosec)
