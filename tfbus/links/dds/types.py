"""The types of ROS 2 that go over DDS, by the names that ROS 2 gives them.

Links send and hear bytes: `tfbus.tf_message` reads and writes them many times faster than the library does. The fields
that are declared here are for other programs, which DDS tells the type.
"""

import struct
from dataclasses import dataclass
from typing import Any, Self, TypeVar

from cyclonedds.core import Entity
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import array, bounded_str, float64, int32, sequence, uint8, uint32

_GID = 16
_LEAST_NODE = 16
"""Bytes of four lengths."""


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    """``builtin_interfaces/msg/Time``."""

    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    """``std_msgs/msg/Header``."""

    stamp: Time
    frame_id: str


@dataclass
class Vector3(IdlStruct, typename="geometry_msgs::msg::dds_::Vector3_"):
    """``geometry_msgs/msg/Vector3``."""

    x: float64
    y: float64
    z: float64


@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs::msg::dds_::Quaternion_"):
    """``geometry_msgs/msg/Quaternion``."""

    x: float64
    y: float64
    z: float64
    w: float64


@dataclass
class Transform(IdlStruct, typename="geometry_msgs::msg::dds_::Transform_"):
    """``geometry_msgs/msg/Transform``."""

    translation: Vector3
    rotation: Quaternion


@dataclass
class TransformStamped(IdlStruct, typename="geometry_msgs::msg::dds_::TransformStamped_"):
    """``geometry_msgs/msg/TransformStamped``."""

    header: Header
    child_frame_id: str
    transform: Transform


@dataclass
class RawTFMessage(IdlStruct, typename="tf2_msgs::msg::dds_::TFMessage_"):
    """``tf2_msgs/msg/TFMessage`` as its bytes, in CDR with the header."""

    transforms: sequence[TransformStamped]
    payload = b""

    @classmethod
    def of(cls, payload: bytes) -> Self:
        """The message of some bytes."""
        nothing: Any = []
        message = cls(nothing)
        message.payload = payload
        return message

    def serialize(self, *_: Any, **__: Any) -> bytes:
        """The bytes."""
        return self.payload

    @classmethod
    def deserialize(cls, data: bytes, *_: Any, **__: Any) -> Self:
        """The message of the bytes that have come."""
        return cls.of(bytes(data))

    @classmethod
    def deserialize_key(cls, data: bytes, *_: Any, **__: Any) -> Self:  # noqa: ARG003 - the type has no key
        """An empty message, for a writer that has gone."""
        return cls.of(b"")


T = TypeVar("T")


def staying_bytes(kind: type[T]) -> type[T]:
    """Have the messages of a type become their bytes, `payload`, when they come."""

    def of(data: bytes, *_: Any, **__: Any) -> T:
        message: Any = kind.__new__(kind)
        message.payload = bytes(data)
        made: T = message
        return made

    # The type has no key: there is one message without any bytes, for a writer that has gone.
    for name, read in (("deserialize", of), ("deserialize_key", lambda *_, **__: of(b""))):
        setattr(kind, name, staticmethod(read))
    return kind


@dataclass
class Point(IdlStruct, typename="geometry_msgs::msg::dds_::Point_"):
    """``geometry_msgs/msg/Point``."""

    x: float64
    y: float64
    z: float64


@dataclass
class Pose(IdlStruct, typename="geometry_msgs::msg::dds_::Pose_"):
    """``geometry_msgs/msg/Pose``."""

    position: Point
    orientation: Quaternion


@dataclass
class PoseWithCovariance(IdlStruct, typename="geometry_msgs::msg::dds_::PoseWithCovariance_"):
    """``geometry_msgs/msg/PoseWithCovariance``."""

    pose: Pose
    covariance: array[float64, 36]


@dataclass
class Twist(IdlStruct, typename="geometry_msgs::msg::dds_::Twist_"):
    """``geometry_msgs/msg/Twist``."""

    linear: Vector3
    angular: Vector3


@dataclass
class TwistWithCovariance(IdlStruct, typename="geometry_msgs::msg::dds_::TwistWithCovariance_"):
    """``geometry_msgs/msg/TwistWithCovariance``."""

    twist: Twist
    covariance: array[float64, 36]


@staying_bytes
@dataclass
class RawOdometry(IdlStruct, typename="nav_msgs::msg::dds_::Odometry_"):
    """``nav_msgs/msg/Odometry``, which becomes its bytes when it comes."""

    header: Header
    child_frame_id: str
    pose: PoseWithCovariance
    twist: TwistWithCovariance
    payload = b""


@staying_bytes
@dataclass
class RawJointState(IdlStruct, typename="sensor_msgs::msg::dds_::JointState_"):
    """``sensor_msgs/msg/JointState``, which becomes its bytes when it comes."""

    header: Header
    name: sequence[str]
    position: sequence[float64]
    velocity: sequence[float64]
    effort: sequence[float64]
    payload = b""


@staying_bytes
@dataclass
class RawClock(IdlStruct, typename="rosgraph_msgs::msg::dds_::Clock_"):
    """``rosgraph_msgs/msg/Clock``, which becomes its bytes when it comes."""

    clock: Time
    payload = b""


@staying_bytes
@dataclass
class RawString(IdlStruct, typename="std_msgs::msg::dds_::String_"):
    """``std_msgs/msg/String``, which becomes its bytes when it comes."""

    data: str
    payload = b""


@dataclass
class Gid(IdlStruct, typename="rmw_dds_common::msg::dds_::Gid_"):
    """``rmw_dds_common/msg/Gid``: the id of a participant or of a writer, as DDS has it."""

    data: array[uint8, 16]

    @classmethod
    def of(cls, entity: Entity) -> Self:
        """The id of an entity of this process."""
        data: Any = list(entity.guid.bytes)
        return cls(data)


@dataclass
class NodeEntitiesInfo(IdlStruct, typename="rmw_dds_common::msg::dds_::NodeEntitiesInfo_"):
    """``rmw_dds_common/msg/NodeEntitiesInfo``: one node, its subscriptions and its publishers."""

    node_namespace: bounded_str[256]
    node_name: bounded_str[256]
    reader_gid_seq: sequence[Gid]
    writer_gid_seq: sequence[Gid]


@dataclass
class ParticipantEntitiesInfo(IdlStruct, typename="rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_"):
    """``rmw_dds_common/msg/ParticipantEntitiesInfo``: all nodes of one participant."""

    gid: Gid
    node_entities_info_seq: sequence[NodeEntitiesInfo]


@staying_bytes
@dataclass
class RawEntitiesInfo(IdlStruct, typename="rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_"):
    """`ParticipantEntitiesInfo`, which stays bytes when it comes, so that one that cannot be read spoils no others."""

    gid: Gid
    node_entities_info_seq: sequence[NodeEntitiesInfo]
    payload = b""

    def read(self) -> tuple[str, list[tuple[str, list[str]]]]:
        """The id of the participant, and its nodes, each with its publishers.

        The library itself would believe a false count of four billion publishers.

        Raises
        ------
        ValueError, struct.error
            If the bytes are no such message.
        """
        body = self.payload[4:]
        number = struct.Struct(">I" if self.payload[1:2] == b"\0" else "<I")
        at = _GID
        own = body[:at].hex()

        def count(size: int) -> int:
            nonlocal at
            at += -at % 4
            (found,) = number.unpack_from(body, at)
            at += 4
            if found * size > len(body) - at:
                raise ValueError(f"{found} entries in {len(body) - at} bytes")
            return int(found)

        def take(size: int) -> bytes:
            nonlocal at
            at += size
            return body[at - size : at]

        nodes: list[tuple[str, list[str]]] = []
        for _ in range(count(_LEAST_NODE)):
            namespace, name = (take(count(1)).rstrip(b"\0").decode() for _ in range(2))
            take(_GID * count(_GID))
            nodes.append((f"{namespace.rstrip('/')}/{name}", [take(_GID).hex() for _ in range(count(_GID))]))
        return own, nodes
