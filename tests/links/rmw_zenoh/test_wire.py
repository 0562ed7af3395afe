""""""

from queue import Queue
from types import SimpleNamespace
from typing import Any

import anyio
import pytest
import zenoh
from rosbags.typesys import Stores, get_typestore
from support.processes import free_address, until
from support.samples import moving, static

from tfbus.links._carrier import Carrier, SendReport
from tfbus.links._receive_queue import Received
from tfbus.links.rmw_zenoh import rmw_zenoh_link
from tfbus.links.rmw_zenoh.rmw_zenoh_link import (
    CLOCK_HASH,
    CLOCK_TYPE,
    HASH,
    JOINT_HASH,
    JOINT_TYPE,
    TEXT_HASH,
    TEXT_TYPE,
    Attachment,
    RmwZenohCarrier,
    endpoint_token,
    node_token,
    other_token,
    pack,
    publisher_of,
    topic_expression,
    topic_key,
)
from tfbus.links.ros.ros_link import MAX_SIZE, RosMessage
from tfbus.links.ros.settings import settings_of
from tfbus.links.zenoh._settings import settings
from tfbus.tf_message import MalformedMessageError, encode


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


AS_A_CARRIER: type[Carrier] = RmwZenohCarrier
"""That it fits the protocol, mypy says."""


def carrier() -> tuple[RmwZenohCarrier, list[Received]]:
    made, items = RmwZenohCarrier(7, "tfbus", zenoh.Config(), settings_of({})), list[Received]()
    made._receive, made._report = items.append, SendReport(print)
    return made, items


def sample(payload: bytes, attachment: bytes | None) -> Any:
    return SimpleNamespace(payload=payload, attachment=attachment)


def test_messages_come_in_but_those_that_this_carrier_has_sent_itself() -> None:
    made, items = carrier()
    payload = encode([moving("map", "base", 5)])
    for own in made._ids.values():
        made._take(False, sample(payload, pack(Attachment(1, 2, own))))
    assert items == []
    made._take(True, sample(payload, None))
    made._take(False, sample(payload, pack(Attachment(1, 2, bytes(16)))))
    assert items == [
        Received("rmw_zenoh", RosMessage(payload, static, "rmw_zenoh"), len(payload), moving=not static)
        for static in (True, False)
    ]


def test_positions_of_joints_and_the_time_come_in() -> None:
    made, items = carrier()
    made._take_other("joints", sample(b"state", None))
    made._take_other("clock", sample(b"time", None))
    assert [(item.content.payload, item.content.joints, item.content.clock, item.moving) for item in items] == [
        (b"state", True, False, True),
        (b"time", False, True, True),
    ]


def test_a_message_that_is_too_large_is_refused() -> None:
    made, items = carrier()
    made._take(False, sample(bytes(MAX_SIZE), None))
    made._take(False, sample(bytes(MAX_SIZE + 1), None))
    assert [type(item.content) for item in items] == [RosMessage, MalformedMessageError]


def test_a_node_announces_its_topics_and_passes_messages_on_both_ways() -> None:
    address = free_address()
    nothing: Any = print
    options = settings_of({"joint_states": nothing, "clock": nothing, "robot_description": nothing})
    made, items = RmwZenohCarrier(7, "tfbus", settings(address, None, None, 2.0), options), Queue[Received]()
    errors = list[Exception]()
    made._receive, made._report = items.put, SendReport(errors.append)
    heard = Queue[zenoh.Sample]()
    made._join()
    assert made._session is not None
    zid = str(made._session.zid())
    with zenoh.open(settings(None, address, None, 2.0)) as other:
        tokens = {str(reply.ok.key_expr) for reply in other.liveliness().get("@ros2_lv/**") if reply.ok is not None}
        assert tokens == {
            node_token(7, zid, "tfbus"),
            *(endpoint_token(7, zid, 1 + n, "tfbus", "/tf_static", static=True, publishes=n == 1) for n in (0, 1)),
            *(endpoint_token(7, zid, 3 + n, "tfbus", "/tf", static=False, publishes=n == 1) for n in (0, 1)),
            other_token(7, zid, 5, "tfbus", "/joint_states", JOINT_TYPE, JOINT_HASH),
            other_token(7, zid, 6, "tfbus", "/clock", CLOCK_TYPE, CLOCK_HASH),
            other_token(7, zid, 7, "tfbus", "/robot_description", TEXT_TYPE, TEXT_HASH, latched=True),
        }
        subscriber = other.declare_subscriber(topic_expression(7, "/tf"), heard.put)
        sent = 0

        def send() -> bool:
            nonlocal sent
            sent += 1
            assert made._publish([moving("map", "base", sent)], static=False)
            return not heard.empty()

        # Until the other session is known to hear it; from then on nothing is lost.
        anyio.run(until, send)
        send()
        first = number = sent + 1
        while number != sent:
            received = heard.get(timeout=20.0)
            assert received.attachment is not None
            attachment = bytes(received.attachment)
            # The number in its sequence comes first.
            number = int.from_bytes(attachment[:8], "little")
            first = min(first, number)
            assert bytes(received.payload) == encode([moving("map", "base", number)])
            assert attachment[-16:] == made._ids[False]
        assert first < number
        subscriber.undeclare()
        for key in ("/tf", "/tf_static"):
            other.put(topic_key(7, key), encode([moving("a", "b", 1)]))
            item = items.get(timeout=20.0)
            assert (item.content.static, item.moving) == (key == "/tf_static", key == "/tf")
        for key, kind in (("/joint_states", JOINT_TYPE), ("/clock", CLOCK_TYPE), ("/robot_description", TEXT_TYPE)):
            other.put(topic_expression(7, key, kind).replace("*", "any"), b"content")
            content = items.get(timeout=20.0).content
            found = (content.joints, content.clock, content.description)
            assert found == (key == "/joint_states", key == "/clock", key == "/robot_description")
    anyio.run(made.close)
    assert made._publish([moving("map", "base", 3)], static=False) is False
    assert errors == [], "its end is no failure"
    assert made._close_at_exit is not None
    assert not made._close_at_exit.alive, "nothing is left to do when the program exits"


def test_whoever_comes_late_gets_the_last_message_of_static_frames_and_no_moving_ones() -> None:
    address = free_address()
    # Of several topics, the first is spoken to.
    several = settings_of({"tf": ["/tf", "/other/tf"], "tf_static": ["/tf_static", "/other/tf_static"]})
    early = RmwZenohCarrier(7, "early", settings(address, None, None, 2.0), several)
    late = RmwZenohCarrier(7, "late", settings(None, address, None, 2.0), settings_of({"send": False}))
    items = Queue[Received]()
    late._receive = items.put
    for made in (early, late):
        made._report = SendReport(print)
    early._join()
    for stamp in (1, 2):
        assert early._publish([static("map", "lidar", stamp=stamp)], static=True)
        assert early._publish([moving("map", "base", stamp)], static=False)
    late._join()
    assert items.get(timeout=20.0).content == RosMessage(
        encode([static("map", "lidar", stamp=2)]), static=True, authority="rmw_zenoh"
    )
    assert items.empty()
    # One that is not to send has no publisher.
    assert late._publish([static("map", "late")], static=True) is False
    for made in (late, early):
        anyio.run(made.close)


def test_what_cannot_be_sent_is_not_counted_as_sent() -> None:
    made, _ = carrier()
    errors: list[Exception] = []
    made._report = SendReport(errors.append)
    assert made._publish([static("map", "lidar")], static=True) is False

    def put(*_: object, **__: object) -> None:
        raise zenoh.ZError("the session is closed")

    closed: Any = SimpleNamespace(put=put)
    made._publishers[True] = closed
    assert made._publish([static("map", "lidar")], static=True) is False
    assert ["the session is closed" in str(error) for error in errors] == [True]


def test_a_session_that_does_not_close_in_time_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    made, _ = carrier()
    errors: list[Exception] = []
    made._report = SendReport(errors.append)
    late = TimeoutError("it goes on")

    async def wait(_: object) -> TimeoutError:
        return late

    monkeypatch.setattr(rmw_zenoh_link, "wait_until_closed", wait)
    anyio.run(made.close)
    assert errors == [late]


def test_a_carrier_that_never_opened_closes() -> None:
    made, _ = carrier()
    errors: list[Exception] = []
    made._report = SendReport(errors.append)
    anyio.run(made.close)
    assert errors == []
