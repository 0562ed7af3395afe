import anyio
import pytest

pytest.importorskip("cbor2", reason='pip install "tfbus[rosbridge]"')

from support.processes import until
from support.rosbridge import rosbridge_server

from tfbus.links._carrier import Carrier, SendReport
from tfbus.links._receive_queue import Presence, Received
from tfbus.links.ros.settings import settings_of
from tfbus.links.rosbridge import _carrier
from tfbus.links.rosbridge._carrier import RosbridgeCarrier

AS_A_CARRIER: type[Carrier] = RosbridgeCarrier
"""That it fits the protocol, mypy says."""

pytestmark = pytest.mark.anyio


async def test_a_server_that_falls_silent_is_left_and_asked_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_carrier, "SILENCE", 0.2)
    monkeypatch.setattr(_carrier, "FIRST_PAUSE", 0.01)
    items: list[Received] = []
    errors: list[Exception] = []
    async with rosbridge_server() as server:
        carrier = RosbridgeCarrier(server.url, settings_of({}))
        await carrier.open(items.append, SendReport(errors.append))
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(carrier.run)
            await until(lambda: len(server.operations("subscribe")) == 2)
            server.silent = True
            await until(lambda: len(items) == 2)
            server.silent = False
            await until(lambda: len(items) == 3)
            tasks.cancel_scope.cancel()
        await carrier.close()
    assert [item.content for item in items] == [Presence.JOINED, Presence.LEFT, Presence.JOINED]
    assert "nothing has come for 0.2 s" in str(errors[0])


async def test_a_carrier_that_never_opened_closes() -> None:
    await RosbridgeCarrier("ws://127.0.0.1:1", settings_of({})).close()
