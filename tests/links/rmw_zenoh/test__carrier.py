from types import SimpleNamespace
from typing import Any

import anyio
import zenoh
from support.samples import moving, static

from tfbus.links._carrier import Carrier, SendReport
from tfbus.links._receive_queue import Received
from tfbus.links.rmw_zenoh._carrier import RmwZenohCarrier
from tfbus.links.rmw_zenoh._wire import Attachment, pack
from tfbus.links.ros._carrier import MAX_SIZE, RosMessage
from tfbus.links.ros.settings import settings_of
from tfbus.tf_message import MalformedMessageError, encode

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


def test_what_cannot_be_sent_is_not_counted_as_sent() -> None:
    made, _ = carrier()
    assert made._publish([static("map", "lidar")], static=True) is False


def test_a_carrier_that_never_opened_closes() -> None:
    made, _ = carrier()
    anyio.run(made.close)
