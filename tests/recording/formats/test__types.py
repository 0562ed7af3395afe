from hashlib import md5

import pytest

from tfbus.recording.formats.copies import MessageTypes, types_with_header
from tfbus.recording.formats.storage import Channel


@pytest.mark.parametrize(("kind", "name"), [("a/B", "a/msg/B"), ("a/msg/B", "a/msg/B")])
def test_types_have_the_names_of_ros_2(kind: str, name: str) -> None:
    assert MessageTypes.name(kind) == name
    with pytest.raises(ValueError, match="no name of a type"):
        MessageTypes.name("B")


def test_a_type_that_the_file_defines_is_converted() -> None:
    cdr = Channel("/a", "my_msgs/msg/Pair", "cdr", "ros2msg", b"uint8 a\nuint32 b\n")
    ros1 = Channel("/a", "my_msgs/Pair", "ros1", "ros1msg", b"uint8 a\nuint32 b\n")
    payload = b"\0\1\0\0\7\0\0\0\5\0\0\0"
    assert MessageTypes().convert(cdr, payload) == b"\7\5\0\0\0"
    assert MessageTypes().convert(ros1, b"\7\5\0\0\0") == payload
    definition, digest = MessageTypes().ros1_definition(cdr)
    assert "uint32 b" in definition
    assert len(digest) == 32


def test_what_is_not_known_or_damaged_is_an_error() -> None:
    unknown = Channel("/a", "my_msgs/msg/Pair", "cdr")
    types = MessageTypes()
    with pytest.raises(ValueError, match="cannot be converted"):
        types.convert(unknown, b"\0\1\0\0")
    with pytest.raises(ValueError, match="has no definition"):
        types.ros1_definition(unknown)
    damaged = Channel("/a", "my_msgs/msg/Pair", "cdr", "ros2msg", b"\xff{{")
    with pytest.raises(ValueError, match="cannot be read"):
        types.convert(damaged, b"")
    # Told once, and then it is a type without a definition.
    with pytest.raises(ValueError, match="cannot be converted"):
        types.convert(damaged, b"")


def test_the_errors_of_long_names_are_cut() -> None:
    for schema in (b"", b"\xff{{"):
        channel = Channel("/a", "my_msgs/msg/" + "x" * 300, "cdr", "ros2msg", schema)
        for call in (lambda channel: MessageTypes().convert(channel, b""), MessageTypes().ros1_definition):
            with pytest.raises(ValueError, match="x" * 99) as raised:
                call(channel)
            assert len(str(raised.value)) == 200


def test_a_definition_of_ros_1_is_passed_on_with_its_digest() -> None:
    own = Channel("/a", "my_msgs/Pair", "ros1", "ros1msg", b"uint8 a\n", {"md5sum": "1234"})
    assert MessageTypes().ros1_definition(own) == ("uint8 a\n", "1234")
    # Without one, it is that of the definition: the MD5 sum of its text, by ROS.
    other = Channel("/a", "my_msgs/Pair", "ros1", "ros1msg", b"uint8 a\n")
    assert MessageTypes().ros1_definition(other) == ("uint8 a\n", md5(b"uint8 a").hexdigest())


@pytest.mark.parametrize(
    ("kind", "digest"),
    [
        ("std_msgs/msg/String", "992ce8a1687cec8c8bd883ec73ca41d1"),
        ("std_msgs/msg/Header", "2176decaecbce78abc3b96ef049fabed"),
        ("geometry_msgs/msg/PointStamped", "c63aecb41bfdfd6b7e1fac37c7cbe7bf"),
        ("nav_msgs/msg/Odometry", "cd5e73d190d741a2f92e81eda573aca7"),
        ("tf2_msgs/msg/TFMessage", "94810edda583a504dfda3829e70d7eec"),
    ],
)
def test_the_definition_of_a_type_of_ros_2_has_the_digest_of_ros_1(kind: str, digest: str) -> None:
    definition, found = MessageTypes().ros1_definition(Channel("/a", kind, "cdr"))
    assert found == digest
    # A header counts the messages there, which ROS 2 has given up.
    assert ("uint32 seq\ntime stamp\nstring frame_id\n" in definition) == (kind != "std_msgs/msg/String")


def test_types_with_a_header_are_known() -> None:
    assert "sensor_msgs/msg/LaserScan" in types_with_header()
    assert "geometry_msgs/msg/Twist" not in types_with_header()
