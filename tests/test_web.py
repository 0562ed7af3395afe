import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated, Any

import anyio
import pytest

from tfbus import (
    Buffer,
    Bus,
    BusClosedError,
    ClockResetError,
    Transform,
    TransformBroadcaster,
    TransformError,
    TransformStamped,
)
from tfbus.web import close_on_signal, status_of

pytestmark = pytest.mark.anyio


@pytest.mark.parametrize(
    ("source", "at", "timeout", "status"),
    [
        ("nowhere", 2_000, 0.0, 404),
        ("nowhere", 2_000, None, 404),
        ("island", 2_000, 0.0, 409),
        ("base_link", 1, 0.0, 410),
        ("base_link", 3_000, 0.0, 504),
        ("base_link", 3_000, None, 504),
        ("base_link", 2**63, 0.0, 422),
        ("base_link", 2_000, -1.0, 422),
    ],
)
async def test_each_question_without_an_answer_has_its_status(
    source: str, at: int, timeout: float | None, status: int
) -> None:
    with Bus() as bus, Buffer(bus) as buffer:
        broadcaster = TransformBroadcaster(bus)
        broadcaster.send("map", "base_link", Transform(), at=2_000)
        broadcaster.send("sea", "island", Transform(), at=2_000)
        with pytest.raises((TransformError, ValueError)) as caught:
            if timeout is None:
                buffer.lookup_nowait("map", source, at)
            await buffer.lookup("map", source, at, timeout=timeout)
    assert status_of(caught.value) == status


def test_the_end_of_a_bus_is_a_503_and_a_fault_of_the_service_a_500() -> None:
    closed = [BusClosedError("the buffer is closed"), ClockResetError(before=2, after=1)]
    assert [status_of(error) for error in closed] == [503, 503]
    assert status_of(KeyError("pose")) == 500


@contextmanager
def handler_of_a_server(number: int) -> Iterator[list[int]]:
    """Handle a signal as a server does; the signals that came."""
    came: list[int] = []
    before = signal.signal(number, lambda number, _: came.append(number))
    try:
        yield came
    finally:
        signal.signal(number, before)


@pytest.mark.every_loop
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
async def test_a_signal_ends_waits_and_streams_and_reaches_the_server(number: int) -> None:
    with handler_of_a_server(number) as came, Bus() as bus, Buffer(bus) as buffer, anyio.fail_after(30):
        TransformBroadcaster(bus).send_static("map", "base_link", Transform())
        server = signal.getsignal(number)
        with close_on_signal(buffer):
            with buffer.watch("map", "base_link") as watch:
                assert (await anext(watch)).child == "base_link"
                # Not by the loop, which sleeps when the signal comes.
                threading.Timer(0.05, signal.pthread_kill, (threading.main_thread().ident, number)).start()
                assert [found async for found in watch] == []
            with pytest.raises(BusClosedError):
                await buffer.lookup("map", "nowhere")
            assert came == [number]
            # The tasks that send go on.
            TransformBroadcaster(bus).send_static("map", "base_link", Transform())
        assert signal.getsignal(number) is server


async def test_a_signal_without_a_handler_is_left_alone() -> None:
    before = signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        with Bus() as bus, Buffer(bus) as buffer, close_on_signal(buffer):
            assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    finally:
        signal.signal(signal.SIGTERM, before)


def test_in_another_thread_as_under_a_test_client_signals_are_left_alone() -> None:
    handlers: list[Any] = []

    async def serve() -> None:
        with Bus() as bus, Buffer(bus) as buffer, close_on_signal(buffer):
            handlers.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=anyio.run, args=(serve,))
    thread.start()
    thread.join()
    assert handlers == [signal.getsignal(signal.SIGINT)]


async def test_a_route_takes_and_gives_transforms_by_their_types() -> None:
    fastapi = pytest.importorskip("fastapi", reason='pip install "tfbus[web]"')
    httpx = pytest.importorskip("httpx")
    with Bus() as bus, Buffer(bus) as buffer:
        app = fastapi.FastAPI()

        async def publish(sample: Annotated[TransformStamped, fastapi.Body()]) -> None:
            bus.publish(sample)

        async def look_up(target: str, source: str) -> TransformStamped:
            return buffer.lookup_nowait(target, source)

        app.post("/transforms")(publish)
        app.get("/transforms")(look_up)
        sample = TransformStamped("map", "cart", 1_764_300_000_123_456_789, Transform((0.1, 0.2, 0.3)), "odometry")
        async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://test") as client:
            assert (await client.post("/transforms", json=sample.to_dict())).status_code == 200
            found = await client.get("/transforms", params={"target": "map", "source": "cart"})
            wrong = {**sample.to_dict(), "transform": {"translation": [0, 0, 0], "rotation": [0, 0, 0, 9]}}
            refused = await client.post("/transforms", json=wrong)
            schema = (await client.get("/openapi.json")).json()["components"]["schemas"]["TransformStamped"]
        assert TransformStamped.from_dict(found.json()) == buffer.lookup_nowait("map", "cart")
        assert refused.status_code == 422
        assert "0.0, 0.0, 0.0, 9.0" in refused.text or "quaternion" in refused.text
        assert {"parent", "child", "stamp", "transform"} <= schema["properties"].keys()
