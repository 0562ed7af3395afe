import logging
from collections.abc import Callable

import pytest

pytest.importorskip("cbor2", reason='pip install "tfbus[rosbridge]"')

from support.processes import until
from support.rosbridge import RosbridgeServer, rosbridge_server
from support.samples import static

from tfbus import Bus
from tfbus.links.rosbridge import RosbridgeLink, rosbridge_link

pytestmark = pytest.mark.anyio


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rosbridge_link, "CONFIRM_TIME", 0.05)


def published(server: RosbridgeServer) -> Callable[[int], bool]:
    return lambda times: server.operations("publish").count("/tf_static") >= times


async def test_static_frames_that_a_server_refuses_without_a_word_are_told_and_sent_until_it_takes_them(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with rosbridge_server() as server:
        server.refuses.add("/tf_static")
        with Bus() as bus:
            bus.publish([static("map", "camera"), static("map", "lidar")])
            async with RosbridgeLink(bus, server.url) as link:
                await until(lambda: published(server)(3))
                assert link.statistics().not_sent == {"not confirmed": 2}
                (line,) = [record.getMessage() for record in caplog.records]
                assert "has not given back 2 static frames, such as 'camera'" in line
                assert server.url in line
                server.refuses.clear()
                await until(lambda: len(caplog.records) == 2)
                assert "has taken all static frames now" in caplog.records[1].getMessage()
                # It was advertised each time, for the first time may have been refused too.
                assert len(server.operations("advertise")) >= 3
                # The next change is one message again.
                before = len(server.operations("advertise"))
                bus.publish(static("map", "arm"))
                await until(lambda: link.statistics().duplicates >= 5)
                assert len(server.operations("advertise")) == before
                assert link.statistics().not_sent == {"not confirmed": 2}


@pytest.mark.parametrize(
    "other", [static("map", "lidar", 2.0, 3), static("odom", "lidar", 1.0, 3), static("map", "lidar", 1.0, 4)]
)
async def test_a_static_frame_of_somebody_else_confirms_nothing(other: object) -> None:
    async with rosbridge_server() as server:
        server.refuses.add("/tf_static")
        server.latched["/tf_static"] = (other,)  # type: ignore[assignment]
        with Bus() as bus:
            bus.publish(static("map", "lidar", 1.0, 3))
            async with RosbridgeLink(bus, server.url) as link:
                await until(lambda: link.statistics().not_sent == {"not confirmed": 1})


async def test_what_comes_back_is_sent_once(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
    async with rosbridge_server() as server:
        with Bus() as bus:
            async with RosbridgeLink(bus, server.url, prefix="r1/", tf_static="/r1/tf_static") as link:
                bus.publish(static("r1/base", "r1/lidar", 0.5, 7))
                await until(lambda: link.statistics().received_messages >= 1)
                # Later than a message that does not come back would have been sent again.
                bus.publish(static("r1/base", "r1/camera", 0.25, 8))
                await until(lambda: server.operations("publish") == ["/r1/tf_static"] * 2)
                await until(lambda: link.statistics().received_messages == 2)
            assert link.statistics().not_sent == {}
        assert server.operations("advertise") == ["/r1/tf_static"]
        latched = [request.get("latch") for request in server.requests if request["op"] in ("advertise", "publish")]
        assert latched == [True] * 3, "else a server of ROS 2 warns each time"
    assert caplog.records == []


async def test_after_a_break_what_the_former_publisher_left_at_a_server_of_ros_2_confirms_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name, value in (("FIRST_PAUSE", 0.01), ("LINGER_TIME", 0.3)):
        monkeypatch.setattr(rosbridge_link, name, value)
    async with rosbridge_server() as server:
        lidar = static("map", "lidar", 1.0, 3)
        with Bus() as bus:
            bus.publish(lidar)
            async with RosbridgeLink(bus, server.url, encoding="cbor-raw") as link:
                await until(lambda: link.statistics().duplicates == 1)
                server.latched["/tf_static"], server.refuses = (lidar,), {"/tf_static"}
                await server.cut()
                await until(lambda: link.statistics().not_sent == {"not confirmed": 1})
                server.refuses.clear()
                before = link.statistics().duplicates
                await until(lambda: link.statistics().duplicates > before)
