import pytest
from rosbags.typesys import Stores, get_typestore

from tfbus.links.rmw_zenoh.rmw_zenoh_link import (
    CLOCK_HASH,
    HASH,
    JOINT_HASH,
    JOINT_TYPE,
    TEXT_HASH,
    Attachment,
    endpoint_token,
    node_token,
    other_token,
    pack,
    publisher_of,
    topic_expression,
    topic_key,
)


def test_the_hash_is_that_of_the_type() -> None:
    hash_of = get_typestore(Stores.ROS2_JAZZY).hash_rihs01
    assert hash_of("tf2_msgs/msg/TFMessage") == HASH
    assert hash_of("sensor_msgs/msg/JointState") == JOINT_HASH
    assert hash_of("rosgraph_msgs/msg/Clock") == CLOCK_HASH
    assert hash_of("std_msgs/msg/String") == TEXT_HASH


def test_keys_and_tokens_are_those_of_rmw_zenoh() -> None:
    kind = "tf2_msgs::msg::dds_::TFMessage_"
    assert topic_key(7, "/tf") == f"7/tf/{kind}/{HASH}"
    assert topic_key(0, "/robot1/tf_static") == f"0/robot1/tf_static/{kind}/{HASH}"
    assert topic_expression(7, "/tf") == f"7/tf/{kind}/*"
    assert node_token(7, "ab12", "tfbus") == "@ros2_lv/7/ab12/0/0/NN/%/%/tfbus"
    common = f"{kind}/{HASH}"
    assert topic_expression(7, "/j", JOINT_TYPE) == "7/j/sensor_msgs::msg::dds_::JointState_/*"
    joints = other_token(7, "ab12", 5, "tfbus", "/a/j", JOINT_TYPE, JOINT_HASH)
    assert joints == f"@ros2_lv/7/ab12/0/5/MS/%/%/tfbus/%a%j/{JOINT_TYPE}/{JOINT_HASH}/::,100:,:,:,,"
    moving = endpoint_token(7, "ab12", 3, "tfbus", "/tf", static=False, publishes=False)
    assert moving == f"@ros2_lv/7/ab12/0/3/MS/%/%/tfbus/%tf/{common}/::,100:,:,:,,"
    static = endpoint_token(7, "ab12", 4, "tfbus", "/r/tf_static", static=True, publishes=True)
    assert static == f"@ros2_lv/7/ab12/0/4/MP/%/%/tfbus/%r%tf_static/{common}/:1:,1:,:,:,,"


def test_an_attachment_tells_the_publisher() -> None:
    data = pack(Attachment(5, 7, bytes(range(16))))
    assert data == b"\x05" + bytes(7) + b"\x07" + bytes(7) + b"\x10" + bytes(range(16))
    assert publisher_of(data) == bytes(range(16))


@pytest.mark.parametrize("data", [b"", b"sequence_number", bytes(33), pack(Attachment(1, 2, bytes(16))) + b"\0"])
def test_another_attachment_tells_none(data: bytes) -> None:
    assert publisher_of(data) is None
