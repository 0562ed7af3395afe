from typing import Any

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


async def test_attempts_to_come_back_are_ever_further_apart_up_to_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    pauses: list[float] = []

    class Refused(RosbridgeCarrier):
        async def _connect(self) -> None:
            if len(pauses) < 8:
                raise OSError("refused")
            self._socket = found

    async def sleep(seconds: float) -> None:
        pauses.append(seconds)

    found: Any = object()
    carrier = Refused("ws://127.0.0.1:1", settings_of({}))
    carrier._report = SendReport(lambda _: None)
    monkeypatch.setattr(anyio, "sleep", sleep)
    await carrier._come_back()
    # Each is between a half of it and the whole, so that not all clients of a server come in one instant.
    for pause, longest in zip(pauses, [0.25, 0.5, 1.0, 2.0, 4.0, 5.0, 5.0, 5.0], strict=True):
        assert longest / 2 <= pause <= longest
    assert len(set(pauses[5:])) == 3
