"""The keys and attachments of rmw_zenoh, from version 0.2.4 on.

Its design document and its source tell them: a topic is the key ``<domain>/<topic>/<type>/<hash of the type>``; nodes,
publishers and subscriptions are liveliness tokens under ``@ros2_lv``, in which ``%`` stands for a slash; a message goes
with its number, its time, and the id of its publisher.
"""

import struct
from typing import Final, NamedTuple

TYPE: Final = "tf2_msgs::msg::dds_::TFMessage_"
HASH: Final = "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"
"""Of ``tf2_msgs/msg/TFMessage``, by REP 2016."""
JOINT_TYPE: Final = "sensor_msgs::msg::dds_::JointState_"
JOINT_HASH: Final = "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e"
"""Of ``sensor_msgs/msg/JointState``."""
CLOCK_TYPE: Final = "rosgraph_msgs::msg::dds_::Clock_"
CLOCK_HASH: Final = "RIHS01_692f7a66e93a3c83e71765d033b60349ba68023a8c689a79e48078bcb5c58564"
"""Of ``rosgraph_msgs/msg/Clock``."""
TEXT_TYPE: Final = "std_msgs::msg::dds_::String_"
TEXT_HASH: Final = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
"""Of ``std_msgs/msg/String``."""
NODE_ID: Final = 0

_ATTACHMENT = struct.Struct("<qqB16s")
_ID_SIZE = 16
_MOVING_QOS = "::,100:,:,:,,"
_STATIC_QOS = ":1:,1:,:,:,,"
"""Reliable, volatile and a depth of 100; reliable, transient local and a depth of 1."""


class Attachment(NamedTuple):
    """The number, time and sender that go with a message."""

    number: int
    time: int
    """ns."""
    publisher: bytes
    """16 bytes."""


def pack(attachment: Attachment) -> bytes:
    """The bytes of an attachment."""
    return _ATTACHMENT.pack(attachment.number, attachment.time, _ID_SIZE, attachment.publisher)


def publisher_of(attachment: bytes) -> bytes | None:
    """The id of the publisher of a message; None if it does not tell it in this way."""
    if len(attachment) != _ATTACHMENT.size:
        return None
    _, _, size, publisher = _ATTACHMENT.unpack(attachment)
    return publisher if size == _ID_SIZE else None


def topic_key(domain: int, topic: str) -> str:
    """The key at which messages are published."""
    return f"{domain}/{topic.strip('/')}/{TYPE}/{HASH}"


def topic_expression(domain: int, topic: str, kind: str = TYPE) -> str:
    """The keys at which messages come: ROS 2 Humble has no hash."""
    return f"{domain}/{topic.strip('/')}/{kind}/*"


def node_token(domain: int, session: str, node: str) -> str:
    """The liveliness token of a node."""
    return f"@ros2_lv/{domain}/{session}/{NODE_ID}/{NODE_ID}/NN/%/%/{node}"


def endpoint_token(domain: int, session: str, number: int, node: str, topic: str, static: bool, publishes: bool) -> str:
    """The liveliness token of a publisher or a subscription of a node."""
    kind, qos = "MP" if publishes else "MS", _STATIC_QOS if static else _MOVING_QOS
    name = topic.replace("/", "%")
    return f"@ros2_lv/{domain}/{session}/{NODE_ID}/{number}/{kind}/%/%/{node}/{name}/{TYPE}/{HASH}/{qos}"


def other_token(
    domain: int, session: str, number: int, node: str, topic: str, kind: str, digest: str, latched: bool = False
) -> str:
    """The liveliness token of a subscription to messages of another type, with the hash of that."""
    name, qos = topic.replace("/", "%"), _STATIC_QOS if latched else _MOVING_QOS
    return f"@ros2_lv/{domain}/{session}/{NODE_ID}/{number}/MS/%/%/{node}/{name}/{kind}/{digest}/{qos}"
